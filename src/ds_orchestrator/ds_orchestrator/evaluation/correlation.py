"""How well a map of the siblings foretells the twin's failures (paper 3.6, 4.3.2: RQ2 and RQ3).

The main numbers are the paper's: Pearson's r and AUC-PRC over the cells that both maps fill. Where the authors' package
computes something else, or where what it computes can be questioned, `robustness_checks` has both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from ds_orchestrator.evaluation.statistics import (
    RESAMPLES,
    Array,
    _average_precision,
    _decided,
    _interval,
    _over_shared_cells,
    _paired,
    _pearson,
    _resampled_auc,
    _resampled_r,
)
from ds_orchestrator.maps.feature_map import FeatureMap

QUESTIONS: tuple[Literal["probability", "quality_loss"], ...] = ("probability", "quality_loss")
"""RQ2 compares failure probabilities, RQ3 lack of driving quality with them."""


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """One map against the twin's failures, over the cells that both fill.

    Attributes:
        name: of the map.
        value: which value of the map: `probability` (RQ2) or `quality_loss` (RQ3).
        cells: number of cells compared.
        r: Pearson correlation with the twin's failure probability, or None where it is not defined.
        p: its two-sided p-value, or None.
        reason: why there is no r.
        r_interval: 95 % bootstrap interval of r over cells; resamples in which r is not defined are left out.
        auc: AUC-PRC as average precision, of the map's value as a prediction that the twin fails in a cell at all.
        auc_interval: 95 % bootstrap interval of the AUC-PRC over cells.
        auc_reason: why there is no AUC-PRC.
        baseline: share of cells in which the twin fails: what a map that knows nothing has as AUC-PRC.
    """

    name: str
    value: str
    cells: int
    r: float | None
    p: float | None
    reason: str = ""
    r_interval: tuple[float, float] | None = None
    auc: float | None = None
    auc_interval: tuple[float, float] | None = None
    auc_reason: str = ""
    baseline: float | None = None


@dataclass(frozen=True, kw_only=True)
class PairedDifference:
    """How much better the merged map foretells the twin's failures than one sibling's, over the cells of all three.

    Both maps see the same cells in every resample, so an interval here is narrower than two intervals side by side.

    Attributes:
        over: the sibling's union map.
        value: of both maps.
        cells: number of cells compared.
        r: Pearson correlation of the merged map less that of the sibling's, or None where one is not defined.
        r_interval: its 95 % bootstrap interval over cells.
        auc: AUC-PRC of the merged map less that of the sibling's, or None.
        auc_interval: its 95 % bootstrap interval over cells.
    """

    over: str
    value: str
    cells: int
    r: float | None = None
    r_interval: tuple[float, float] | None = None
    auc: float | None = None
    auc_interval: tuple[float, float] | None = None


def correlate(feature_map: FeatureMap, twin: FeatureMap, value: str, *, resamples: int = 0) -> Correlation:
    """Compare one map with the twin's; see `Correlation`.

    Args:
        feature_map: of the siblings.
        twin: its map.
        value: `probability` or `quality_loss`.
        resamples: of the bootstrap; 0 leaves the intervals out.
    """
    ours, truth = _paired(feature_map, twin, value)
    r, p, reason = _pearson(ours, truth, value)
    auc, auc_reason = _average_precision(ours, truth)
    return Correlation(
        name=feature_map.name,
        value=value,
        cells=len(ours),
        r=r,
        p=p,
        reason=reason,
        r_interval=None if r is None or not resamples else _interval((ours, truth), _resampled_r, resamples),
        auc=auc,
        auc_interval=None if auc is None or not resamples else _interval((ours, truth), _resampled_auc, resamples),
        auc_reason=auc_reason,
        baseline=float(np.mean(truth > 0)) if len(truth) else None,
    )


def evaluate(
    maps: Mapping[str, FeatureMap], siblings: Sequence[str], twin: str, *, resamples: int = 0
) -> list[Correlation]:
    """Each sibling's union map and the merged map against the twin, by failure probability and by quality.

    `resamples` is for the bootstrap intervals, which take most of the time: `RESAMPLES` is enough, 0 leaves them out.
    """
    names = [*(f"union_{sibling}" for sibling in siblings), "merged"]
    truth = maps[f"twin_{twin}"]
    return [correlate(maps[name], truth, value, resamples=resamples) for value in QUESTIONS for name in names]


def paired_differences(
    maps: Mapping[str, FeatureMap], siblings: Sequence[str], twin: str, *, resamples: int = RESAMPLES
) -> list[PairedDifference]:
    """The merged map against each sibling's, by failure probability and by quality; none with a single sibling."""
    merged, truth = maps["merged"], maps[f"twin_{twin}"]
    more_r, more_auc = _more(_resampled_r), _more(_resampled_auc)
    found = []
    for value, sibling in product(QUESTIONS, siblings if len(siblings) > 1 else ()):
        union = maps[f"union_{sibling}"]
        samples = ours, theirs, against = _over_shared_cells([merged, union], truth, value)
        known: dict[str, Any] = {}
        if all(_pearson(one, against, value)[0] is not None for one in (ours, theirs)):
            known |= {"r": more_r(*samples), "r_interval": _interval(samples, more_r, resamples)}
        if _decided(against):
            known |= {"auc": more_auc(*samples), "auc_interval": _interval(samples, more_auc, resamples)}
        found.append(PairedDifference(over=union.name, value=value, cells=len(against), **known))
    return found


def _more(statistic: Callable[[Array, Array], float]) -> Callable[[Array, Array, Array], float]:
    """How much higher a statistic is for the first map than for the second."""
    return lambda ours, theirs, truth: statistic(ours, truth) - statistic(theirs, truth)
