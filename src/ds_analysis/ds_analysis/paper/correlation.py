# SPDX-License-Identifier: Apache-2.0
"""Comparison of the siblings' maps with the twin's failures, in the paper's way and in others (paper 3.6, 4.3.2)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, product
from typing import Any, Literal

import numpy as np
from scipy.integrate import trapezoid
from scipy.stats import NearConstantInputWarning, pearsonr

from ds_analysis.common.statistics import (
    RESAMPLES,
    Array,
    auc_prc,
    auc_prc_or_nan,
    auc_prc_or_reason,
    bootstrap_interval,
    caution_of,
    has_both_outcomes,
    r_or_nan,
    ranks,
)
from ds_orchestrator.maps.algebra import OPERATORS, merge
from ds_orchestrator.maps.feature_map import FeatureMap, MapId
from ds_orchestrator.search.features import Cell
from ds_sim.registry import SimulatorName

QUESTIONS: tuple[Literal["probability", "quality_loss"], ...] = ("probability", "quality_loss")
"""RQ2 and RQ3: values of the siblings' maps that are compared with the twin's failure probability."""
FEWEST_CELLS = 3
"""Cells needed for r; with two, every r is 1 or -1."""


def _values(m: FeatureMap, cells: Sequence[Cell], value: str) -> Array:
    values = [getattr(m.cells[cell], value) for cell in cells]
    return np.array([np.nan if v is None else v for v in values], np.float64)


def values_over_shared_cells(maps: Sequence[FeatureMap], truth: FeatureMap, value: str) -> tuple[Array, ...]:
    """Collect a value of several maps, then the failure probability of another, over the cells that all fill."""
    cells = sorted(set(truth.cells).intersection(*(m.cells for m in maps)))
    predicted, against = [_values(m, cells, value) for m in maps], _values(truth, cells, "probability")
    in_all = ~np.isnan(predicted).any(axis=0)
    return tuple(values[in_all] for values in (*predicted, against))


def pearson_or_reason(predicted: Array, truth: Array, value: str) -> tuple[float | None, float | None, str]:
    """Compute r and p, or the reason why they are undefined."""
    reason = ""
    if len(predicted) < FEWEST_CELLS:
        reason = f"{len(predicted)} cells in common, expected {FEWEST_CELLS} or more"
    elif np.ptp(truth) == 0:
        reason = f"the twin's failure probability is {truth[0]:g} in every cell"
    elif np.ptp(predicted) == 0:
        reason = f"the map's {value.replace('_', ' ')} is {predicted[0]:g} in every cell"
    if reason:
        return None, None, reason
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearConstantInputWarning)
        result = pearsonr(predicted, truth)
    return float(result.statistic), float(result.pvalue), ""


def auc_roc(predicted: Array, truth: Array) -> float:
    """Compute the area under the receiver operating characteristic; same bits as `sklearn.metrics.roc_auc_score`."""
    hits, misses = _counts(predicted, truth)
    if len(hits) > 2:
        corners = np.pad((np.diff(misses, 2) != 0.0) | (np.diff(hits, 2) != 0.0), 1, constant_values=True)
        hits, misses = hits[corners], misses[corners]
    return float(trapezoid(np.append(0.0, hits / hits[-1]), np.append(0.0, misses / misses[-1])))


def auc_prc_by_trapezoids(predicted: Array, truth: Array) -> float:
    """Compute the AUC-PRC by the trapezoidal rule, which interpolates between points and so is optimistic."""
    hits, misses = _counts(predicted, truth)
    precision, recall = hits / (hits + misses), hits / hits[-1]
    return -float(trapezoid(np.append(precision[::-1], 1.0), np.append(recall[::-1], 0.0)))


def _counts(predicted: Array, truth: Array) -> tuple[Array, Array]:
    """Failures, and other cells, among the cells with the largest predictions, for each number that is told apart."""
    order, ends = ranks(predicted)
    hits = np.cumsum(truth[order] > 0.0)[ends].astype(np.float64)
    return hits, ends + 1.0 - hits


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Comparison of one map with the twin's failures, over the cells that both fill.

    Attributes:
        value: value of the map: `probability` (RQ2) or `quality_loss` (RQ3).
        r: Pearson correlation with the twin's failure probability; None if undefined, by `reason`.
        r_interval: 95% bootstrap interval over cells, of resamples in which r is defined; None if cells are too few.
        auc: AUC-PRC, the average precision with which the map's value predicts that the twin fails in a cell; None if
            undefined, by `auc_reason`.
        baseline: share of cells in which the twin fails: the AUC-PRC of a map without information.
        failing: number of the compared cells in which the twin fails, or None in results of earlier versions.
    """

    map: MapId
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
    failing: int | None = None

    @property
    def caution(self) -> str:
        """Reason why the numbers allow no conclusion, or ""; see `ds_analysis.common.statistics.caution_of`."""
        return "" if self.failing is None else caution_of(self.cells, self.failing)

    def document(self) -> dict[str, Any]:
        """Convert to plain JSON values."""
        values = asdict(self)
        del values["map"]
        return {"name": self.map.name, **values, "conclusive": not self.caution, "caution": self.caution}


@dataclass(frozen=True, kw_only=True)
class PairedDifference:
    """Difference between merged map and one sibling's in predicting the twin's failures, over the cells of all three.

    Every resample has the same cells for both maps, so the interval is narrower than two separate ones suggest.

    Attributes:
        over: the sibling's union map.
        r: Pearson correlation of the merged map minus that of the sibling's; for this and the rest see `Correlation`.
    """

    over: MapId
    value: str
    cells: int
    r: float | None = None
    r_interval: tuple[float, float] | None = None
    auc: float | None = None
    auc_interval: tuple[float, float] | None = None
    failing: int | None = None


def correlate(feature_map: FeatureMap, twin: FeatureMap, value: str, *, resamples: int = 0) -> Correlation:
    """Correlate one map with the twin's; see `Correlation`. Without resamples, there are no intervals."""
    predicted, truth = values_over_shared_cells([feature_map], twin, value)
    failing = int((truth > 0).sum())
    r, p, reason = pearson_or_reason(predicted, truth, value)
    auc, auc_reason = auc_prc_or_reason(predicted, truth)
    if caution_of(len(truth), failing):
        resamples = 0
    return Correlation(
        map=feature_map.id,
        value=value,
        cells=len(truth),
        r=r,
        p=p,
        reason=reason,
        r_interval=None if r is None else bootstrap_interval((predicted, truth), r_or_nan, resamples),
        auc=auc,
        auc_interval=None if auc is None else bootstrap_interval((predicted, truth), auc_prc_or_nan, resamples),
        auc_reason=auc_reason,
        baseline=failing / len(truth) if len(truth) else None,
        failing=failing,
    )


def evaluate(
    maps: Mapping[MapId, FeatureMap], siblings: Sequence[SimulatorName], twin: SimulatorName, *, resamples: int = 0
) -> list[Correlation]:
    """Compare each sibling's union map and the merged map with the twin, by both values; 0 resamples: no intervals."""
    compared = [maps[map_id] for map_id in (*map(MapId.union, siblings), MapId.merged())]
    truth = maps[MapId.twin(twin)]
    return [correlate(one, truth, value, resamples=resamples) for value in QUESTIONS for one in compared]


def paired_differences(
    maps: Mapping[MapId, FeatureMap],
    siblings: Sequence[SimulatorName],
    twin: SimulatorName,
    *,
    resamples: int = RESAMPLES,
) -> list[PairedDifference]:
    """Compare the merged map with each sibling's, by both values; empty with a single sibling."""
    merged, truth = maps[MapId.merged()], maps[MapId.twin(twin)]
    difference_r, difference_auc = _difference(r_or_nan), _difference(auc_prc_or_nan)
    differences = []
    for value, sibling in product(QUESTIONS, siblings if len(siblings) > 1 else ()):
        union = maps[MapId.union(sibling)]
        samples = merged_values, values, against = values_over_shared_cells([merged, union], truth, value)
        failing = int((against > 0).sum())
        drawn = 0 if caution_of(len(against), failing) else resamples
        finite: dict[str, Any] = {}
        if all(pearson_or_reason(one, against, value)[0] is not None for one in (merged_values, values)):
            finite |= {"r": difference_r(*samples), "r_interval": bootstrap_interval(samples, difference_r, drawn)}
        if has_both_outcomes(against):
            finite |= {
                "auc": difference_auc(*samples),
                "auc_interval": bootstrap_interval(samples, difference_auc, drawn),
            }
        differences.append(PairedDifference(over=union.id, value=value, cells=len(against), failing=failing, **finite))
    return differences


def _difference(statistic: Callable[[Array, Array], float]) -> Callable[[Array, Array, Array], float]:
    """Create the difference of a statistic between two maps, the first minus the second."""
    return lambda first, second, truth: statistic(first, truth) - statistic(second, truth)


EMPTY = -2.0
"""Value that maxitwo puts into empty cells before it correlates over all cells."""


@dataclass(frozen=True, kw_only=True)
class RobustnessCheck:
    """Comparison of a value of one map with another's failures in another way; `what` says which, and which curve."""

    what: str
    map: MapId
    against: MapId
    value: str
    cells: int
    r: float | None = None
    p: float | None = None
    auc: float | None = None


def check_robustness(
    maps: Mapping[MapId, FeatureMap], siblings: Sequence[SimulatorName], twin: SimulatorName
) -> list[RobustnessCheck]:
    """Compute RQ2 and RQ3 in other ways, the authors' package first (its compute_mapelites_correlation)."""
    unions = [maps[MapId.union(sibling)] for sibling in siblings]
    compared, truth = [*unions, maps[MapId.merged()]], maps[MapId.twin(twin)]
    checks = []

    def add(
        what: str,
        m: FeatureMap,
        against: FeatureMap,
        value: str,
        values: tuple[Array, ...] | None = None,
        curve: Callable[[Array, Array], float] | None = None,
    ) -> None:
        """Compare by values of both maps, those of the cells that both fill if None."""
        predicted, of_against = values or values_over_shared_cells([m], against, value)
        r, p, _ = pearson_or_reason(predicted, of_against, value)
        auc = curve(predicted, of_against) if curve is not None and has_both_outcomes(of_against) else None
        cells = len(predicted)
        checks.append(
            RobustnessCheck(what=what, map=m.id, against=against.id, value=value, cells=cells, r=r, p=p, auc=auc)
        )

    for value, m in product(QUESTIONS, compared):
        add("all cells of the bounds, empty ones as -2 (maxitwo)", m, truth, value, _filled(m, truth, value))
    for value, m in product(QUESTIONS, compared):
        predicted, failures = values_over_shared_cells([m], truth, value)
        both = (predicted > 0) & (failures > 0)
        add("only cells above 0 in both (maxitwo)", m, truth, value, (predicted[both], failures[both]))
    for value, m in product(QUESTIONS, compared):
        add("AUC of ROC (maxitwo)", m, truth, value, curve=auc_roc)
    for value, m in product(QUESTIONS, compared):
        add("AUC-PRC by trapezoids", m, truth, value, curve=auc_prc_by_trapezoids)
    for m in compared:
        pooled = values_over_shared_cells([m], truth, "pooled_quality_loss")
        add("quality as mean over a union's tests (maxitwo)", m, truth, "quality_loss", pooled, auc_prc)
    for value, sibling in product(QUESTIONS, siblings):
        own = maps[MapId.search(sibling)], maps[MapId.migration(sibling, twin)]
        add("a sibling's own search, without migration (maxitwo)", *own, value, curve=auc_prc)
    if len(unions) > 1:
        for value, operator in product(QUESTIONS, OPERATORS):
            m = merge(MapId.merged(), unions, probability=operator, quality_loss=operator)
            add(f"merged by {operator.replace('_', ' ')}", m, truth, value, curve=auc_prc)
    for one, other in combinations(unions, 2):
        add("sibling against sibling (maxitwo)", one, other, "probability")
    return checks


def _filled(m: FeatureMap, truth: FeatureMap, value: str) -> tuple[Array, Array]:
    """Values of both maps over their common bounds, `EMPTY` in cells without tests."""
    filled = set(m.cells) | set(truth.cells)
    axes = [range(min(axis), max(axis) + 1) for axis in zip(*filled, strict=True)]
    cells = list(product(*axes)) if filled else []
    values = [EMPTY if cell not in m.cells else float(getattr(m.cells[cell], value)) for cell in cells]
    against = [EMPTY if cell not in truth.cells else truth.cells[cell].probability for cell in cells]
    return np.array(values, np.float64), np.array(against, np.float64)
