# SPDX-License-Identifier: Apache-2.0
"""Findings of a campaign in plain sentences, derived from its numbers by fixed rules.

Where a driver fails is one threshold on bend radius, number of turns, or an operating condition, if chance would hardly
find one as good (`ds_analysis.common.selection`); where conditions vary, then the best one of the other kind.
docs/evaluation.md has the rules, which were fixed before they were applied to any campaign.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.stats import t

from ds_analysis.common.selection import ALPHA, SEED, Axis, ChosenSplit, Share, choose_split
from ds_analysis.common.statistics import Indices, families_of
from ds_analysis.paper.correlation import QUESTIONS, Correlation, PairedDifference
from ds_analysis.paper.paper_tables import cautions
from ds_base.words import count, listed
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.network_driver import sees_translated
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import FeatureMap, MapId
from ds_orchestrator.store.model import Test
from ds_report.heatmap import Value
from ds_sim.conditions.model import DEFAULT, FIELDS
from ds_sim.conditions.text import conditions_in_words
from ds_sim.registry import NO_SIMULATOR

Kind = Literal["road", "conditions"]
FEW_FAMILIES = 16
"""Random roads below which a clear difference is often not found (docs/claims.md); chosen from that simulation."""


@dataclass(frozen=True, kw_only=True)
class RoadOutcomes:
    """Tests with an outcome on all simulators that decide, `where`, and whether the road of each fails."""

    where: str
    tests: tuple[Test, ...]
    failed: tuple[bool, ...]

    @cached_property
    def families(self) -> Indices:
        """For each test, the number of the random road from which it descends."""
        return families_of([test.road for test in self.tests])

    @property
    def share(self) -> Share:
        """Failures divided by roads, of which there is at least one."""
        return Share.of(np.array(self.failed, np.bool_), self.families)

    @property
    def varied_conditions(self) -> tuple[str, ...]:
        """Names of the conditions that differ between tests."""
        return tuple(name for name in FIELDS if len({getattr(test.conditions, name) for test in self.tests}) > 1)


def road_outcomes(data: CampaignData) -> RoadOutcomes:
    """Decide which roads of a campaign fail: those that fail on the twin, or without its outcomes on every sibling."""
    data = data.distinct
    config = data.config
    done = data.failed
    if config.twin and any(simulator == config.twin for _, simulator in done):
        where, judges = f"the twin {config.twin}", [config.twin]
    else:
        where = config.siblings[0] if len(config.siblings) == 1 else "every sibling"
        judges = list(config.siblings)
    tests = tuple(t for t in data.tests if all((t.test_id, name) in done for name in judges))
    return RoadOutcomes(
        where=where, tests=tests, failed=tuple(all(done[t.test_id, name] for name in judges) for t in tests)
    )


def best_split(outcomes: RoadOutcomes, kind: Kind | None = None) -> ChosenSplit | None:
    """Find the best split, clear or not, on all axes or those of a kind; None without any.

    It has the largest Youden index (Cancer 1950, 3: 32-35); among equal ones curvature comes before turns before
    conditions, then the harder threshold.
    """
    axes = [one for one in _axes(outcomes) if kind in (None, kind_of(one[0]))]
    return choose_split(axes, np.array(outcomes.failed, np.bool_), outcomes.families, np.random.default_rng(SEED))


def kind_of(axis: str) -> Kind:
    """Whether an axis of `best_split` is about the road or a condition."""
    return "conditions" if axis in FIELDS else "road"


def _axes(outcomes: RoadOutcomes) -> Iterator[Axis]:
    """Axes to split on, in order of preference: largest curvature of a road, 1/m, turns, and conditions."""
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


NOTHING_DRIVEN = "Nothing was driven yet, so there is nothing to report."
_CHANCE = 0.05
"""p-value from which a correlation is called compatible with chance (paper 4.3.1)."""
_WORDS = {"probability": "failure probability", "quality_loss": "quality loss"}
NOT_TESTED = (
    "Only the shape of the road varied between tests. Weather, light, traffic, junctions, slopes, road surface, "
    "markings and lane width were not tested"
)
NOT_TESTED_EITHER = "Traffic, junctions, slopes and lane width were not tested"
"""Where operating conditions differ between tests, or from the simulators' own."""
TRANSLATED = (
    "The driver saw translated images, and a generator may undo what a condition does to them, so these results say "
    "nothing about its network on images of a real camera under such conditions. "
)


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Where the driver fails and how sure that is; what was tested and what not; further sentences."""

    headline: str
    limits: str = ""
    details: Sequence[str] = ()


def summarise(
    data: CampaignData,
    maps: Mapping[MapId, FeatureMap],
    correlations: Sequence[Correlation],
    *,
    paired_differences: Sequence[PairedDifference] = (),
) -> Findings:
    """Summarise the findings of a campaign, finished or not; correlations and differences are empty without a twin."""
    config = data.config
    if not data.executions:
        return Findings(headline=NOTHING_DRIVEN)
    outcomes = road_outcomes(data)
    details = [_coverage(data.distinct), _failures(data.distinct), _agreement(config, maps)]
    if config.twin and maps[MapId.merged()].cells:
        details.append(_predicted(config, maps))
    reasons = cautions(correlations)
    if len(reasons) == 1 and all(c.caution for c in correlations):
        details.append(f"No conclusion about how well the siblings predict the twin: {reasons[0]}.")
    else:
        compared = {value: [c for c in correlations if c.value == value] for value in QUESTIONS}
        details += [_comparison(config, of, paired_differences, value) for value, of in compared.items() if of]
    if not config.twin:
        details.append("This campaign has no twin, so there is nothing to compare the maps with.")
    headline = where_it_fails(config.driver, outcomes)
    return Findings(headline=headline, limits=_limits(config.driver, outcomes), details=details)


def where_it_fails(driver: DriverName, outcomes: RoadOutcomes) -> str:
    """State where the driver fails and how sure that is, by the rule of this module."""
    thing = "test" if outcomes.varied_conditions else "road"
    if not outcomes.tests:
        return f"No {thing} has an outcome on {outcomes.where} yet, so where {driver} fails is not known."
    total, all_of = outcomes.share, count(len(outcomes.tests), thing)
    split = best_split(outcomes)
    clear = split is not None and split.is_clear
    conditions = _conditions(outcomes, but=split.axis if split and clear else "")
    where = f"{outcomes.where}, all {thing}s {listed(conditions)}" if conditions else outcomes.where
    if not total.failures:
        none = f"did not fail on the only {thing}" if total.tests == 1 else f"failed on none of {all_of}"
        return f"{driver} {none}, {_percent(total)}, on {where}."
    if total.failures == total.tests:
        every = f"the only {thing}" if total.tests == 1 else f"all {all_of}"
        return f"{driver} failed on {every}, {_percent(total)}, on {where}; no gentler {thing} was driven."
    if split is None or not clear:
        axes = ("the tightest bend", "the number of turns", *outcomes.varied_conditions)
        none = f"Neither {' nor '.join(axes)} separates" if len(axes) == 2 else f"None of {listed(axes)} separates"
        return (
            f"{driver} failed on {total.failures} of {all_of}, {_percent(total)}, on {where}. {none} these "
            f"{thing}s clearly from the others.{_few(outcomes, thing)}"
        )
    first = f"On {where}, {driver} fails {_harder_than(split, thing)}: {_sides(split, outcomes.failed, thing)}"
    second = best_split(outcomes, "road" if kind_of(split.axis) == "conditions" else "conditions")
    if second is None or not second.is_clear:
        return first
    return f"{first} It also fails more often {_harder_than(second, thing)}: {_sides(second, outcomes.failed, thing)}"


def _few(outcomes: RoadOutcomes, thing: str) -> str:
    """Say that there are too few random roads to find even a clear difference, if that is so."""
    roots = int(outcomes.families.max()) + 1
    if roots >= FEW_FAMILIES:
        return ""
    tests = f"{len(outcomes.tests)} {thing}s"
    start = f"There are {tests}" if roots == len(outcomes.tests) else f"The {tests} vary {count(roots, 'random road')}"
    return (
        f" {start}, which is few: from {FEW_FAMILIES} random roads on (`population`), a clear difference is mostly "
        "found."
    )


def _sides(split: ChosenSplit, failed: Sequence[bool], thing: str) -> str:
    """State how often the tests on both sides of a split fail: counts, and what is left of them on other tests."""
    harder, lost = split.harder, np.array(failed, np.bool_)
    rates = " fail, against ".join(_percent(share) for share in split.apart or ())
    return (
        f"{int(lost[harder].sum())} of {int(harder.sum())} such {thing}s failed, and "
        f"{int(lost[~harder].sum()) or 'none'} of the {int((~harder).sum())} others. Among {thing}s that did not "
        f"choose this threshold, {rates}."
    )


def radius(curvature: float) -> str:
    """Write the radius of a curvature in 1/m: `5.6 m`, or `straight`."""
    return f"{1.0 / curvature:.1f} m" if curvature > 0 else "straight"


def _harder_than(split: ChosenSplit, thing: str) -> str:
    if split.axis in FIELDS:
        return conditions_in_words(split.axis, split.threshold, side="or more" if split.is_lower_bound else "or less")
    if split.axis == "turns":
        return f"on {thing}s with {split.threshold:.0f} turns or more"
    bend = f"a bend of {radius(split.threshold)} radius or tighter (curvature {split.threshold:.3f} 1/m or more)"
    return f"on {thing}s with {bend}"


def _percent(share: Share) -> str:
    """Write a share with its interval: `75% (95% interval 28 to 97%)`."""
    low, high = (100 * end for end in share.interval)
    return f"{100 * share.failures / share.tests:.0f}% (95% interval {low:.0f} to {high:.0f}%)"


def _limits(driver: DriverName, outcomes: RoadOutcomes) -> str:
    """State which roads were tested, and what was not tested."""
    if not outcomes.tests:
        return f"{NOT_TESTED}."
    curvatures = [test.road.curvature for test in outcomes.tests]
    turns = [test.road.turns_count for test in outcomes.tests]
    low, high = min(curvatures), max(curvatures)
    tightest = f"of {radius(high)} radius" if low == high else f"from {radius(low)} down to {radius(high)} radius"
    number = count(min(turns), "turn") if min(turns) == max(turns) else f"{min(turns)} to {max(turns)} turns"
    conditions = f"Conditions: {', '.join(named)}." if (named := _conditions(outcomes)) else ""
    translated = TRANSLATED if conditions and sees_translated(driver) else ""
    rest = f"{conditions} {translated}{NOT_TESTED_EITHER}" if conditions else NOT_TESTED
    roads, roots = len({test.road.road_id for test in outcomes.tests}), int(outcomes.families.max()) + 1
    tests = f" in {count(len(outcomes.tests), 'test')}" if roads < len(outcomes.tests) else ""
    return (
        f"Tested: {count(roads, 'road')}{tests} with {number}, the tightest bend of each {tightest} ({low:.3f} to "
        f"{high:.3f} 1/m). {rest}. Intervals count mutants of one road together: there are "
        f"{count(roots, 'family', 'families')}."
    )


def _conditions(outcomes: RoadOutcomes, but: str = "") -> list[str]:
    """Name the conditions other than the simulators' own, with their ranges, leaving out one."""
    named = []
    for name in FIELDS:
        values = {getattr(test.conditions, name) for test in outcomes.tests}
        numbers = [value for value in values if value is not None]
        if values == {getattr(DEFAULT, name)} or not numbers or name == but:
            continue
        named.append(conditions_in_words(name, min(numbers), max(numbers)))
    return named


def _agreement(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> str:
    shared = maps[MapId.merged()].cells
    unions = [maps[MapId.union(name)].cells for name in config.siblings]
    failing = sum(all(union[cell].probability > 0 for union in unions) for cell in shared)
    passing = sum(all(union[cell].probability == 0 for union in unions) for cell in shared)
    if not shared:
        return "The siblings have no cell of the feature map in common yet, so the merged map is empty."
    cells = count(len(shared), "cell")
    if len(unions) == 1:
        return f"{config.siblings[0]}, the only sibling, has failures in {failing} of {cells}."
    return (
        f"Of {cells} that all siblings fill, they agree on failure in {failing}, agree on no failure in {passing} and "
        f"disagree in {len(shared) - failing - passing}."
    )


def _coverage(data: CampaignData) -> str:
    config, verdicts = data.config, len(data.verdicts)
    expected = len(data.tests) * len(config.simulators)
    roads, tests = len({test.road.road_id for test in data.tests}), count(len(data.tests), "test")
    tests_and_roads = count(roads, "road") if roads == len(data.tests) else f"{tests} on {count(roads, 'road')}"
    roles = listed([*config.siblings, *([f"the twin {config.twin}"] if config.twin else [])])
    text = f"The driver {config.driver} was given {tests_and_roads} to drive on {roles}"
    if verdicts == expected:
        return f"{text}: {count(verdicts, 'run')}, each with a verdict."
    excluded = len(data.excluded)
    gated = f" {excluded} {'is' if excluded == 1 else 'are'} excluded by the gates." if excluded else ""
    some = f"{text}; {verdicts} of {count(expected, 'run')} have a verdict.{gated}"
    if verdicts + excluded == expected:
        return f"{some} They enter no map." if excluded > 1 else f"{some} It enters no map."
    return f"{some} The others were not driven yet or ended in an error, and enter no map."


def _failures(data: CampaignData) -> str:
    parts = []
    for name, failed in data.failures.items():
        share = "" if failed.rate is None else f" ({100 * failed.rate:.0f}%)"
        parts.append(f"{failed.failures} of {failed.tests}{share} on {name}")
    return f"It failed {listed(parts)}."


def _predicted(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> str:
    """State in how many of the merged map's failing cells the twin fails."""
    twin, merged = maps[MapId.twin(config.twin or NO_SIMULATOR)].cells, maps[MapId.merged()].cells
    both = [cell for cell in merged if cell in twin]
    alarms = [cell for cell in both if merged[cell].probability > 0]
    right = sum(twin[cell].probability > 0 for cell in alarms)
    missed = sum(twin[cell].probability > 0 for cell in both) - right
    return (
        f"Of {count(len(alarms), 'cell')} in which the merged map predicts failures, the twin fails in {right}; of "
        f"{count(len(both) - len(alarms), 'cell')} in which it predicts none, the twin fails in {missed}."
    )


def _comparison(
    config: CampaignConfig,
    correlations: Sequence[Correlation],
    paired_differences: Sequence[PairedDifference],
    value: Value,
) -> str:
    """State how the maps of one value correlate with the twin's failures, and whether merging helped."""
    of_map = {c.map: c for c in correlations}
    merged, unions = of_map[MapId.merged()], [of_map[MapId.union(name)] for name in config.siblings]
    subject = f"By {_WORDS[value]}"
    if merged.r is None:
        return f"{subject}, the merged map cannot be compared with the twin: {merged.reason}."
    if merged.caution:
        return f"{subject}, no conclusion about how well the siblings predict the twin: {merged.caution}."
    siblings = listed([f"{c.map.simulator} {'undefined' if c.r is None else f'{c.r:.2f}'}" for c in unions])
    numbers = (
        f"{subject}, the merged map correlates with the failures of the twin {config.twin} with r = {merged.r:.2f}"
    )
    chance = (
        f" With p = {merged.p:.2f} over {count(merged.cells, 'cell')}, this may be chance."
        if merged.p is not None and merged.p >= _CHANCE
        else ""
    )
    if any(c.r is None for c in unions):
        return f"{numbers}; not every sibling can be compared.{chance}"
    if len(unions) == 1:
        return f"{numbers}; with a single sibling, its map and the merged map are the same.{chance}"
    if merged.r <= 0:
        verdict = ": no positive correlation, so it does not predict the twin's failures"
    else:
        own = [one for one in paired_differences if one.value == value]
        verdict = f": {_against_siblings(own, len(paired_differences))}" if own else ""
    return f"{numbers} ({siblings}){verdict}.{chance}"


def _against_siblings(paired_differences: Sequence[PairedDifference], among: int) -> str:
    """Call the merged map better or worse than a sibling only if the difference is shown among so many."""
    groups: dict[str, list[str]] = {"better than": [], "worse than": [], "not distinguishable from": []}
    better, worse, open_ = groups.values()
    for difference in paired_differences:
        side = side_shown(difference, among)
        (better if side > 0 else worse if side < 0 else open_).append(difference.over.simulator)
    return listed([f"{how} {listed(names)} alone" for how, names in groups.items() if names])


def side_shown(difference: PairedDifference, among: int) -> int:
    """1 or -1 if the interval excludes 0, widened by Student's t for few cells and for the comparisons (Bonferroni)."""
    if difference.r is None or difference.r_interval is None:
        return 0
    wider = t.ppf(1.0 - ALPHA / 2.0 / among, max(difference.cells - 2, 1)) / t.ppf(1.0 - ALPHA / 2.0, np.inf)
    low, high = (difference.r + wider * (end - difference.r) for end in difference.r_interval)
    return int(low > 0.0) - int(high < 0.0)
