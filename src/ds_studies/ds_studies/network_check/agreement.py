# SPDX-License-Identifier: Apache-2.0
"""How well a network's answers agree with the autopilot's steering, and which number among its outputs agrees best."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import OutputSpec
from ds_driver.networks.pilot import DriverError
from ds_studies.network_check.recording import AutopilotDrives

AGREES = 0.5
"""Correlation from which a network answers with the road at all; chosen: chance gives it once in a thousand times."""
FOUND = 0.8
"""Correlation that a network, or another description of it, must reach; chosen: below what shipped networks have that
drive, 0.93 at least, and above what chance gives on one of four simulators, 0.55 in 96 tries with random weights."""
CHANCE = 0.01 / 60
"""Probability that chance alone lets one description be ahead so far that evidence decides; chosen: one in a hundred
for the best of the 60 that are tried. Four drives on one simulator need 19 standard errors for it, 16 need 4.6."""
GAIN = 0.5
"""Part of the unexplained variance that another description may leave at most; chosen: it has to halve."""
MOST_NUMBERS = 64
"""Numbers among the outputs that are tried as steering."""
FEWEST_BINS = 5
"""Size of an output from which it may be scores of bins; chosen: Donkey Car has 15, and three are a colour."""


@dataclass(frozen=True)
class Agreement:
    """Answers n of a network against the autopilot's steering a, by the regression n = slope * a + offset."""

    correlation: float  # over all images; 0 for a constant answer
    slope: float
    offset: float
    by_simulator: tuple[float, ...]  # correlation on each simulator alone
    # (drives,) size of the correlation without one drive each, as Fisher's z.
    without: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1), compare=False, repr=False)

    @property
    def unexplained(self) -> float:
        """Part of the variance that the autopilot's steering does not explain."""
        return 1.0 - self.correlation**2

    def beats(self, other: Agreement) -> bool:
        """Whether this one is so much better that it cannot be chance; see `FOUND` and `GAIN`."""
        pairs = zip(self.by_simulator, other.by_simulator, strict=True)
        return (
            abs(self.correlation) >= FOUND
            and self.unexplained <= GAIN * other.unexplained
            and all(abs(mine) > abs(its) for mine, its in pairs)
        )

    def surely_above(self, other: Agreement) -> bool:
        """Whether its correlation, by size, is higher beyond `CHANCE`: Student's t of leaving out one drive each."""
        if len(self.without) != len(other.without):
            return abs(self.correlation) > abs(other.correlation)  # the other refused the images
        gains, count = self.without - other.without, len(self.without)
        error = np.sqrt((count - 1) * gains.var())
        needed = max(float(t.ppf(1.0 - CHANCE, count - 1) * error), 1e-9)
        return _fisher(self.correlation) - _fisher(other.correlation) > needed


def agreement(answers: NDArray[np.float64], recordings: Sequence[AutopilotDrives]) -> Agreement:
    """Compare (images,) finite answers to all images, in their order, with the autopilot's steering."""
    wanted = np.concatenate([one.steering for one in recordings])
    ends = np.cumsum([len(one.steering) for one in recordings])[:-1]
    parts = zip(np.split(answers, ends), (one.steering for one in recordings), strict=True)
    slope = float(np.cov(answers, wanted)[0, 1] / wanted.var(ddof=1))
    offset = float(answers.mean() - slope * wanted.mean())
    drives = np.repeat(np.arange(len(recordings)), [len(one.steering) for one in recordings]) * len(wanted)
    drives += np.concatenate([one.drives for one in recordings])
    without = [_fisher(_correlation(answers[kept], wanted[kept])) for kept in (drives != k for k in np.unique(drives))]
    by_simulator = tuple(_correlation(*part) for part in parts)
    return Agreement(_correlation(answers, wanted), slope, offset, by_simulator, np.array(without))


def _fisher(correlation: float) -> float:
    return float(np.arctanh(min(abs(correlation), 0.999999)))


def _correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    spread = float(one.std() * other.std())
    # Rounding makes the spread of a constant some 1e-17, not 0.
    return 0.0 if spread < 1e-12 else float(np.mean((one - one.mean()) * (other - other.mean())) / spread)


def readings(
    pilot: DescribedNetworkPilot, recordings: Sequence[AutopilotDrives]
) -> Iterator[tuple[OutputSpec, NDArray[np.float64]]]:
    """Yield what could be the steering with its value for every image: the described one, every number, highest bins.

    Nothing is yielded where the network refuses its input or answers NaN.
    """
    try:
        rows = [pilot.outputs_once(frame) for one in recordings for frame in one.frames]
    except DriverError:
        return
    stacked = [np.stack([row[k].reshape(-1) for row in rows]) for k in range(len(rows[0]))]
    if not all(np.isfinite(output).all() for output in stacked):
        return
    described = pilot.description.outputs.steering
    place = described.output if isinstance(described.output, int) else pilot.output_names.index(described.output)
    specs = [(place, described)]
    for k, output in enumerate(stacked):
        name = described.output if k == place else k
        if output.shape[1] >= FEWEST_BINS:
            specs.append((k, OutputSpec(output=name, bins=(-1.0, 1.0))))
        specs += [(k, OutputSpec(output=name, index=i)) for i in range(output.shape[1])][:MOST_NUMBERS]
    for k, spec in specs:
        yield spec, np.array([spec.value(row) for row in stacked[k]])
