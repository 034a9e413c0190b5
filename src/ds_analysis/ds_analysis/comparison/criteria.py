"""Pass criteria of a CI job: which outcomes make a command exit with status 3."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from ds_orchestrator.campaign.config import ConfigError

FailOn = Literal["failure", "regression", "worse"]


@dataclass(frozen=True, kw_only=True)
class MaxFailures:
    """Largest number or share of tests that may fail on each simulator.

    Attributes:
        count: number of tests, or None.
        share: share in [0, 1], or None.

    Examples:
        >>> from ds_analysis import MaxFailures
        >>> [MaxFailures.parse(text).allows(failures=1, tests=10) for text in ("5%", "10%", "3")]
        [False, True, True]
    """

    count: int | None = None
    share: float | None = None

    @classmethod
    def parse(cls, text: str) -> MaxFailures:
        """Parse `5%` or `3`.

        Raises:
            ConfigError: it is neither a share from 0 to 100 % nor a number of tests.
        """
        if re.fullmatch(r"\d{1,3}(\.\d{1,6})?%", text) and float(text[:-1]) <= 100.0:
            return cls(share=float(text[:-1]) / 100.0)
        if re.fullmatch(r"\d{1,9}", text):
            return cls(count=int(text))
        raise ConfigError(f"--max-failures {text!r:.40}: expected a share from 0% to 100%, or a number of tests, as 3")

    def allows(self, failures: int, tests: int) -> bool:
        """Whether so many failures are within the limit."""
        return failures <= (self.count if self.count is not None else (self.share or 0.0) * tests)

    def __str__(self) -> str:
        return str(self.count) if self.count is not None else f"{100 * (self.share or 0.0):g} %"


@dataclass(frozen=True, kw_only=True)
class Criteria:
    """Pass criteria.

    Attributes:
        fail_on: `failure`, any test fails; `regression`, any test newly fails; `worse`, the candidate is significantly
            worse on some simulator. None: nothing of these.
        max_failures: limit for each simulator, or None.
    """

    fail_on: FailOn | None = None
    max_failures: MaxFailures | None = None

    def unmet(
        self,
        tally: Mapping[str, tuple[int, int]],
        *,
        newly_failing: int | None = None,
        worse: Sequence[str] = (),
    ) -> list[str]:
        """Say which criteria are not met, one sentence each.

        Args:
            tally: simulator -> failures and tests.
            newly_failing: number of drives that newly fail; None if there is nothing to compare with.
            worse: simulators on which the candidate is significantly worse.

        Raises:
            ConfigError: the criterion needs a comparison, and there is none.
        """
        self.check(has_reference=newly_failing is not None)
        found = []
        failing = {name: failures for name, (failures, _) in tally.items() if failures}
        if self.fail_on == "failure" and failing:
            found.append("tests fail: " + ", ".join(f"{n} on {name}" for name, n in failing.items()))
        if self.fail_on == "regression" and newly_failing:
            found.append(f"{newly_failing} {'drive newly fails' if newly_failing == 1 else 'drives newly fail'}")
        if self.fail_on == "worse" and worse:
            found.append(f"significantly worse on {', '.join(worse)}")
        if self.max_failures is not None:
            found += [
                f"{failures} of {tests} tests fail on {name}, expected {self.max_failures} at most"
                for name, (failures, tests) in tally.items()
                if not self.max_failures.allows(failures, tests)
            ]
        return found

    def check(self, *, has_reference: bool) -> None:
        """Refuse a criterion that needs a comparison where there is none.

        Raises:
            ConfigError: it does.
        """
        if self.fail_on in ("regression", "worse") and not has_reference:
            raise ConfigError(
                f"--fail-on {self.fail_on} needs outcomes to compare with: use it with `ds campaign compare` or "
                "`ds suite run`, or choose --fail-on failure"
            )
