"""What a campaign found, in plain sentences made of its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.evaluation.correlation import Correlation, PairedDifference
from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.maps.heatmap import VALUE_TITLES, Value
from ds_orchestrator.store.store import Execution

_CHANCE = 0.05
"""p-value from which a correlation is called compatible with chance (paper 4.3.1)."""


@dataclass(frozen=True, kw_only=True)
class Findings:
    """A campaign in words.

    Attributes:
        headline: the most important thing, one sentence or two.
        details: further sentences.
    """

    headline: str
    details: list[str]


def summarise(
    config: CampaignConfig,
    maps: Mapping[str, FeatureMap],
    correlations: Sequence[Correlation],
    executions: Sequence[Execution],
    *,
    tests: int,
    paired_differences: Sequence[PairedDifference] = (),
) -> Findings:
    """Say what a campaign found, finished or not.

    Args:
        config: as run.
        maps: as `ds_orchestrator.maps.campaign_maps.build_maps` names them.
        correlations: with the twin, empty without one.
        executions: every one that is known.
        tests: how many tests there are.
        paired_differences: of merging, over each sibling; without them the merged map is not held against the siblings.
    """
    if not executions:
        return Findings(headline="Nothing was driven yet, so there is nothing to report.", details=[])
    verdicts = [e for e in executions if e.outcome.is_verdict]
    details = [_coverage(config, len(verdicts), tests), _failures(config, verdicts)]
    if config.twin and maps["merged"].cells:
        details.append(_foretold(config, maps))
    values: tuple[Value, ...] = ("probability", "quality_loss")
    for value in values:
        compared = [c for c in correlations if c.value == value]
        if compared:
            details.append(_comparison(config, compared, [g for g in paired_differences if g.value == value], value))
    if not config.twin:
        details.append("No twin took part in this campaign, so the maps are compared with nothing.")
    return Findings(headline=f"{_agreement(config, maps)} {_key_number(config, correlations)}".strip(), details=details)


def count(number: int, thing: str, plural: str = "") -> str:
    """`1 cell`, `2 cells`."""
    return f"{number} {thing if number == 1 else plural or thing + 's'}"


def _listed(parts: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def _agreement(config: CampaignConfig, maps: Mapping[str, FeatureMap]) -> str:
    shared = maps["merged"].cells
    unions = [maps[f"union_{name}"].cells for name in config.siblings]
    failing = sum(all(union[cell].probability > 0 for union in unions) for cell in shared)
    passing = sum(all(union[cell].probability == 0 for union in unions) for cell in shared)
    if not shared:
        return "The siblings have no cell of the feature map in common yet, so the merged map is empty."
    cells = count(len(shared), "cell")
    if len(unions) == 1:
        return f"{config.siblings[0]}, the only sibling, sees failures in {failing} of {cells}."
    return (
        f"Of {cells} that all siblings fill, they agree on failure in {failing}, agree on no failure in {passing} and "
        f"disagree in {len(shared) - failing - passing}."
    )


def _key_number(config: CampaignConfig, correlations: Sequence[Correlation]) -> str:
    found = {c.name: c for c in correlations if c.value == "probability"}
    merged = found.get("merged")
    if merged is None:
        return ""
    if merged.r is None:
        return f"How well their merged map foretells the twin cannot be said: {merged.reason}."
    siblings = [f"{name} {_r(found[f'union_{name}'])}" for name in config.siblings]
    return (
        f"Their merged map correlates with the failures of the twin {config.twin} with r = {merged.r:.2f} "
        f"({_listed(siblings)})."
    )


def _r(correlation: Correlation) -> str:
    return "undefined" if correlation.r is None else f"{correlation.r:.2f}"


def _coverage(config: CampaignConfig, verdicts: int, tests: int) -> str:
    expected = tests * len(config.simulators)
    roles = _listed([*config.siblings, *([f"the twin {config.twin}"] if config.twin else [])])
    text = f"The driver {config.driver} was given {count(tests, 'road')} to drive on {roles}"
    if verdicts == expected:
        return f"{text}: {count(verdicts, 'run')}, each with a verdict."
    return (
        f"{text}; {verdicts} of {count(expected, 'run')} have a verdict. What is missing was not driven yet or ended "
        "in an error, and enters no map."
    )


def _failures(config: CampaignConfig, verdicts: Sequence[Execution]) -> str:
    parts = []
    for name in config.simulators:
        mine = [e for e in verdicts if e.simulator == name]
        failed = sum(e.outcome.is_failure for e in mine)
        share = f" ({100 * failed / len(mine):.0f} %)" if mine else ""
        parts.append(f"{failed} of {len(mine)}{share} on {name}")
    return f"It failed {_listed(parts)}."


def _foretold(config: CampaignConfig, maps: Mapping[str, FeatureMap]) -> str:
    """How the merged map's failing cells look on the twin."""
    twin = maps[f"twin_{config.twin}"].cells
    merged = maps["merged"].cells
    both = [cell for cell in merged if cell in twin]
    alarms = [cell for cell in both if merged[cell].probability > 0]
    right = sum(twin[cell].probability > 0 for cell in alarms)
    missed = sum(twin[cell].probability > 0 for cell in both) - right
    return (
        f"Of {count(len(alarms), 'cell')} in which the merged map expects failures, the twin fails in {right}; of "
        f"{count(len(both) - len(alarms), 'cell')} in which it expects none, the twin fails in {missed}."
    )


def _comparison(
    config: CampaignConfig,
    correlations: Sequence[Correlation],
    paired_differences: Sequence[PairedDifference],
    value: Value,
) -> str:
    """The correlations of one value in words, and whether merging helped."""
    found = {c.name: c for c in correlations}
    merged = found["merged"]
    subject = f"By {VALUE_TITLES[value]}"
    if merged.r is None:
        return f"{subject}, the merged map cannot be compared with the twin: {merged.reason}."
    chance = (
        f" With p = {merged.p:.2f} over {count(merged.cells, 'cell')}, this may be chance."
        if merged.p is not None and merged.p >= _CHANCE
        else ""
    )
    if any(found[f"union_{name}"].r is None for name in config.siblings):
        return f"{subject}, the merged map has r = {merged.r:.2f}; not every sibling can be compared.{chance}"
    if len(config.siblings) == 1:
        return f"{subject}, the only sibling's map has r = {merged.r:.2f}, and the merged map is the same.{chance}"
    if merged.r <= 0:
        verdict = ": no positive correlation, so it does not foretell the twin's failures"
    else:
        verdict = f": {_against_siblings(paired_differences)}" if paired_differences else ""
    return f"{subject}, the merged map has r = {merged.r:.2f}{verdict}.{chance}"


def _against_siblings(paired_differences: Sequence[PairedDifference]) -> str:
    """Better, worse, or neither: only a difference whose 95 % interval leaves 0 out is called one."""
    groups: dict[str, list[str]] = {"better than": [], "worse than": [], "not to be told apart from": []}
    better, worse, open_ = groups.values()
    for gain in paired_differences:
        low, high = gain.r_interval or (0.0, 0.0)
        (better if low > 0 else worse if high < 0 else open_).append(gain.over.removeprefix("union_"))
    return _listed([f"{how} {_listed(names)} alone" for how, names in groups.items() if names])
