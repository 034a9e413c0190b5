"""Robustness checks of RQ2 and RQ3: the same comparisons as the authors' package or other methods compute them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from ds_analysis.common.statistics import (
    Array,
    auc_prc,
    auc_prc_by_trapezoids,
    auc_roc,
    has_both_outcomes,
    paired_values,
    pearson_or_reason,
)
from ds_analysis.paper.correlation import QUESTIONS
from ds_orchestrator.maps.algebra import OPERATORS, merge
from ds_orchestrator.maps.feature_map import FeatureMap, MapId

EMPTY = -2.0
"""Value that maxitwo puts into empty cells before it correlates over all cells."""


@dataclass(frozen=True, kw_only=True)
class RobustnessCheck:
    """Comparison of two maps computed in another way.

    Attributes:
        what: difference from the main number.
        map: first map.
        against: map with which it is compared.
        value: compared value of the first map.
        cells: number of cells compared.
        r: Pearson correlation, or None.
        p: its two-sided p-value, or None.
        auc: area under a curve, as `what` says, or None.
    """

    what: str
    map: MapId
    against: MapId
    value: str
    cells: int
    r: float | None = None
    p: float | None = None
    auc: float | None = None


def check_robustness(maps: Mapping[MapId, FeatureMap], siblings: Sequence[str], twin: str) -> list[RobustnessCheck]:
    """Compute RQ2 and RQ3 in other ways, the authors' package first (its compute_mapelites_correlation)."""
    unions = [maps[MapId.union(sibling)] for sibling in siblings]
    compared, truth = [*unions, maps[MapId.merged()]], maps[MapId.twin(twin)]
    found = []
    for value, m in product(QUESTIONS, compared):
        found.append(_check("all cells of the bounds, empty ones as -2 (maxitwo)", *_filled(m, truth, value)))
    for value, m in product(QUESTIONS, compared):
        values, against = paired_values(m, truth, value)
        both = (values > 0) & (against > 0)
        found.append(_check("only cells above 0 in both (maxitwo)", m, truth, value, values[both], against[both]))
    for value, m in product(QUESTIONS, compared):
        found.append(_check("AUC of ROC (maxitwo)", m, truth, value, *paired_values(m, truth, value), curve=auc_roc))
    for value, m in product(QUESTIONS, compared):
        what = "AUC-PRC by trapezoids"
        found.append(_check(what, m, truth, value, *paired_values(m, truth, value), curve=auc_prc_by_trapezoids))
    for m in compared:
        values, against = paired_values(m, truth, "pooled_quality_loss")
        what = "quality as mean over a union's tests (maxitwo)"
        found.append(_check(what, m, truth, "quality_loss", values, against, curve=auc_prc))
    for value, sibling in product(QUESTIONS, siblings):
        m, against_own = maps[MapId.search(sibling)], maps[MapId.migration(sibling, twin)]
        what = "a sibling's own search, without migration (maxitwo)"
        found.append(_check(what, m, against_own, value, *paired_values(m, against_own, value), curve=auc_prc))
    if len(unions) > 1:
        for value, operator in product(QUESTIONS, OPERATORS):
            m = merge(MapId.merged(), unions, probability=operator, quality_loss=operator)
            what = f"merged by {operator.replace('_', ' ')}"
            found.append(_check(what, m, truth, value, *paired_values(m, truth, value), curve=auc_prc))
    for one, other in combinations(unions, 2):
        found.append(_check("sibling against sibling (maxitwo)", one, other, "probability", *paired_values(one, other)))
    return found


def _filled(m: FeatureMap, truth: FeatureMap, value: str) -> tuple[FeatureMap, FeatureMap, str, Array, Array]:
    """Fill both maps over their common bounds, with `EMPTY` in cells without tests."""
    filled = set(m.cells) | set(truth.cells)
    axes = [range(min(axis), max(axis) + 1) for axis in zip(*filled, strict=True)]
    cells = list(product(*axes)) if filled else []
    values = [EMPTY if cell not in m.cells else float(getattr(m.cells[cell], value)) for cell in cells]
    against = [EMPTY if cell not in truth.cells else truth.cells[cell].probability for cell in cells]
    return m, truth, value, np.array(values, np.float64), np.array(against, np.float64)


def _check(
    what: str,
    m: FeatureMap,
    against: FeatureMap,
    value: str,
    predicted: Array,
    truth: Array,
    *,
    curve: Callable[[Array, Array], float] | None = None,
) -> RobustnessCheck:
    r, p, _ = pearson_or_reason(predicted, truth, value)
    auc = curve(predicted, truth) if curve is not None and has_both_outcomes(truth) else None
    found = {"cells": len(predicted), "r": r, "p": p, "auc": auc}
    return RobustnessCheck(what=what, map=m.id, against=against.id, value=value, **found)  # type: ignore[arg-type]
