# SPDX-License-Identifier: Apache-2.0
"""Shares of failures, and intervals of probabilities."""

from __future__ import annotations

from typing import NamedTuple

from scipy.special import betaincinv

LEVEL = 0.95
"""Coverage of intervals; chosen: the usual one, matching the paper's alpha of 0.05."""
PRIOR = 0.5
"""Both parameters of Jeffreys' prior of a probability, a Beta distribution."""


class FailureCount(NamedTuple):
    """Number of failures among tests with a verdict."""

    failures: int
    tests: int

    @property
    def rate(self) -> float | None:
        """Share of tests that failed; None without tests."""
        return self.failures / self.tests if self.tests else None


def jeffreys_interval(failures: int, tests: int) -> tuple[float, float]:
    """Estimate a 95% interval of a failure probability: equal tails of its Beta posterior under Jeffreys' prior.

    Without failures the lower end is 0, without successes the upper end is 1, so that the interval contains the
    observed share (Brown, Cai, DasGupta, Statistical Science 2001, section 4.1.2).

    Examples:
        >>> from ds_base.intervals import jeffreys_interval
        >>> [round(end, 3) for end in jeffreys_interval(failures=0, tests=10)]
        [0.0, 0.217]
    """
    tail = (1.0 - LEVEL) / 2.0
    posterior = failures + PRIOR, tests - failures + PRIOR
    return (
        0.0 if failures == 0 else float(betaincinv(*posterior, tail)),
        1.0 if failures == tests else float(betaincinv(*posterior, 1.0 - tail)),
    )
