"""How well a map of the siblings foretells the twin's failures (paper 3.6, 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.stats import pearsonr

from ds_orchestrator.maps import FeatureMap


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Pearson correlation of one map with the twin's failure probability over the cells that both fill.

    Attributes:
        name: of the map.
        value: which value of the map: `probability` (RQ2) or `quality` (RQ3).
        cells: number of cells compared.
        r: correlation, or None where it is not defined.
        p: its two-sided p-value, or None.
        reason: why there is no r.
    """

    name: str
    value: str
    cells: int
    r: float | None
    p: float | None
    reason: str = ""


def correlate(feature_map: FeatureMap, twin: FeatureMap, value: str) -> Correlation:
    """Compare one map with the twin's; see `Correlation`."""
    cells = sorted(set(feature_map.cells) & set(twin.cells))
    ours = [float(getattr(feature_map.cells[cell], value)) for cell in cells]
    truth = [twin.cells[cell].probability for cell in cells]
    reason = ""
    if len(cells) < 3:
        reason = f"{len(cells)} cells in common, expected 3 or more"
    elif len(set(truth)) == 1:
        reason = f"the twin's failure probability is {truth[0]:g} in every cell"
    elif len(set(ours)) == 1:
        reason = f"the map's {value} is {ours[0]:g} in every cell"
    if reason:
        return Correlation(name=feature_map.name, value=value, cells=len(cells), r=None, p=None, reason=reason)
    result = pearsonr(ours, truth)
    return Correlation(
        name=feature_map.name, value=value, cells=len(cells), r=float(result.statistic), p=float(result.pvalue)
    )


def evaluate(maps: dict[str, FeatureMap], siblings: list[str], twin: str) -> list[Correlation]:
    """Each sibling's union map and the merged map against the twin, by failure probability and by quality."""
    names = [*(f"union_{sibling}" for sibling in siblings), "merged"]
    truth = maps[f"twin_{twin}"]
    return [correlate(maps[name], truth, value) for value in ("probability", "quality") for name in names]
