"""Where a driver fails: one threshold on bend radius, number of turns, or an operating condition (a decision stump).

The rule was fixed before it was applied to any campaign:

1. A road fails if it fails on the twin. Without a twin's outcomes, it fails if it fails on every sibling.
2. For the largest curvature of a road, its turns count, and every condition that varies between tests, every threshold
   between two different values splits the tests into easier and harder ones; a condition that is hard at both ends is
   split in both directions. The split with the largest Youden index J, the share of failing tests above minus the
   share of passing tests above, is chosen (Youden, Cancer 1950, 3: 32-35); among equal ones curvature before turns
   before conditions, then the harder threshold.
3. The split is reported only if the 95 % intervals (Jeffreys) of both sides' failure probabilities do not overlap,
   since a threshold chosen from the same data always looks better than it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.algebra import jeffreys_interval
from ds_orchestrator.store.model import Test
from ds_sim.conditions.model import FIELDS


@dataclass(frozen=True, kw_only=True)
class Share:
    """Failures of a group of roads.

    Attributes:
        failures: number of failing roads.
        roads: number of roads, at least 1.
    """

    failures: int
    roads: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the failure probability (Jeffreys)."""
        return jeffreys_interval(self.failures, self.roads)


@dataclass(frozen=True, kw_only=True)
class Split:
    """Threshold that separates failing roads from the others.

    Attributes:
        axis: `curvature`, the largest of a road in 1/m, `turns`, or the name of a condition.
        threshold: of the harder roads, the value nearest to the others.
        is_lower_bound: whether the harder roads have the threshold or more, otherwise the threshold or less.
        harder: roads from the threshold on.
        gentler: the other roads.
    """

    axis: str
    threshold: float
    is_lower_bound: bool
    harder: Share
    gentler: Share

    @property
    def is_clear(self) -> bool:
        """Whether the intervals of the two sides do not overlap."""
        return self.harder.interval[0] > self.gentler.interval[1]


@dataclass(frozen=True, kw_only=True)
class RoadOutcomes:
    """Roads and which of them fail.

    Attributes:
        where: simulators that decide, such as `the twin donkey`.
        tests: roads with an outcome on all of these simulators.
        failed: for each test, whether its road fails.
    """

    where: str
    tests: tuple[Test, ...]
    failed: tuple[bool, ...]

    @property
    def share(self) -> Share:
        """Failures over all roads."""
        return Share(failures=sum(self.failed), roads=len(self.tests))

    @property
    def varied_conditions(self) -> tuple[str, ...]:
        """Names of the conditions that differ between tests."""
        return tuple(name for name in FIELDS if len({getattr(test.conditions, name) for test in self.tests}) > 1)


def road_outcomes(data: CampaignData) -> RoadOutcomes:
    """Decide which roads of a campaign fail, by rule 1 of this module."""
    config = data.config
    done = {(e.test_id, e.simulator): e.outcome.is_failure for e in data.verdicts}
    if config.twin and any(simulator == config.twin for _, simulator in done):
        where, judges = f"the twin {config.twin}", [config.twin]
    else:
        where = config.siblings[0] if len(config.siblings) == 1 else "every sibling"
        judges = list(config.siblings)
    tests = tuple(t for t in data.tests if all((t.test_id, name) in done for name in judges))
    return RoadOutcomes(
        where=where, tests=tests, failed=tuple(all(done[t.test_id, name] for name in judges) for t in tests)
    )


def best_split(outcomes: RoadOutcomes) -> Split | None:
    """Find the split with the largest Youden index, clear or not, by rule 2 of this module; None if there is none."""
    total = outcomes.share
    passing = total.roads - total.failures
    if not 0 < total.failures < total.roads:
        return None
    candidates: list[tuple[tuple[int, int, float], Split]] = []
    for order, (axis, values, sign) in enumerate(_axes(outcomes)):
        hardness = [sign * value for value in values]
        for threshold in sorted(set(hardness))[1:]:
            above = [failed for value, failed in zip(hardness, outcomes.failed, strict=True) if value >= threshold]
            harder = Share(failures=sum(above), roads=len(above))
            gentler = Share(failures=total.failures - harder.failures, roads=total.roads - harder.roads)
            # Youden's J times the failing and the passing roads: whole numbers have no rounding errors to break ties.
            youden = harder.failures * passing - (harder.roads - harder.failures) * total.failures
            split = Split(
                axis=axis, threshold=sign * threshold, is_lower_bound=sign > 0, harder=harder, gentler=gentler
            )
            candidates.append(((youden, -order, threshold), split))
    return max(candidates, key=lambda candidate: candidate[0])[1] if candidates else None


def _axes(outcomes: RoadOutcomes) -> Iterator[tuple[str, list[float], int]]:
    """Axes to split on, in order of preference: name, value of each test, and 1 where larger values are harder."""
    yield "curvature", [test.road.curvature for test in outcomes.tests], 1
    yield "turns", [float(test.road.turns_count) for test in outcomes.tests], 1
    for name in outcomes.varied_conditions:
        values = [getattr(test.conditions, name) for test in outcomes.tests]
        if None in values:  # "as the simulator" has no place among numbers
            continue
        if FIELDS[name].stronger in ("high", "both"):
            yield name, values, 1
        if FIELDS[name].stronger in ("low", "both"):
            yield name, values, -1
