"""How well a map of the siblings foretells the twin's failures (paper 3.6, 4.3.2: RQ2 and RQ3).

The main numbers are the paper's: Pearson's r and AUC-PRC over the cells that both maps fill. Where the authors' package
computes something else, or where what it computes can be questioned, `variants` has both.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ConstantInputWarning, DegenerateDataWarning, NearConstantInputWarning, bootstrap, pearsonr

from ds_orchestrator.features import Cell
from ds_orchestrator.maps import FeatureMap, merge
from ds_orchestrator.operators import LEVEL, OPERATORS

Array = NDArray[np.float64]
QUESTIONS: tuple[Literal["probability", "quality"], ...] = ("probability", "quality")
"""RQ2 compares failure probabilities, RQ3 lack of driving quality with them."""
RESAMPLES = 1000
"""Of a bootstrap; chosen: ends of an interval are right to about a tenth of its width, in a second."""
FEWEST_CELLS = 3
"""With two, every r is 1 or -1."""
EMPTY = -2.0
"""What maxitwo puts into empty cells before it correlates over all of them."""


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """One map against the twin's failures, over the cells that both fill.

    Attributes:
        name: of the map.
        value: which value of the map: `probability` (RQ2) or `quality` (RQ3).
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
class Gain:
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


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The same question asked in another way.

    Attributes:
        what: how it differs from the main number.
        name: of the map.
        against: of the map that it is compared with.
        value: of the first map.
        cells: number of cells compared.
        r: Pearson correlation, or None.
        p: its two-sided p-value, or None.
        auc: area under a curve, as `what` says, or None.
    """

    what: str
    name: str
    against: str
    value: str
    cells: int
    r: float | None = None
    p: float | None = None
    auc: float | None = None


def correlate(feature_map: FeatureMap, twin: FeatureMap, value: str, *, resamples: int = 0) -> Correlation:
    """Compare one map with the twin's; see `Correlation`.

    Args:
        feature_map: of the siblings.
        twin: its map.
        value: `probability` or `quality`.
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


def gains(
    maps: Mapping[str, FeatureMap], siblings: Sequence[str], twin: str, *, resamples: int = RESAMPLES
) -> list[Gain]:
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
        found.append(Gain(over=union.name, value=value, cells=len(against), **known))
    return found


def variants(maps: Mapping[str, FeatureMap], siblings: Sequence[str], twin: str) -> list[Variant]:
    """The same questions in other ways, those of the authors' package first (its compute_mapelites_correlation)."""
    unions = [maps[f"union_{sibling}"] for sibling in siblings]
    compared, truth = [*unions, maps["merged"]], maps[f"twin_{twin}"]
    found = []
    for value, m in product(QUESTIONS, compared):
        found.append(_variant("all cells of the bounds, empty ones as -2 (maxitwo)", *_filled(m, truth, value)))
    for value, m in product(QUESTIONS, compared):
        ours, against = _paired(m, truth, value)
        both = (ours > 0) & (against > 0)
        found.append(_variant("only cells above 0 in both (maxitwo)", m, truth, value, ours[both], against[both]))
    for value, m in product(QUESTIONS, compared):
        found.append(_variant("AUC of ROC (maxitwo)", m, truth, value, *_paired(m, truth, value), curve=_roc))
    for value, m in product(QUESTIONS, compared):
        what = "AUC-PRC by trapezoids"
        found.append(_variant(what, m, truth, value, *_paired(m, truth, value), curve=_trapezoids))
    for m in compared:
        ours, against = _paired(m, truth, "pooled_quality")
        what = "quality as mean over a union's tests (maxitwo)"
        found.append(_variant(what, m, truth, "quality", ours, against, curve=_ap))
    for value, sibling in product(QUESTIONS, siblings):
        m, against_own = maps[f"search_{sibling}"], maps[f"migration_{sibling}_to_{twin}"]
        what = "a sibling's own search, without migration (maxitwo)"
        found.append(_variant(what, m, against_own, value, *_paired(m, against_own, value), curve=_ap))
    if len(unions) > 1:
        for value, operator in product(QUESTIONS, OPERATORS):
            m = merge("merged", unions, probability=operator, quality=operator)
            what = f"merged by {operator.replace('_', ' ')}"
            found.append(_variant(what, m, truth, value, *_paired(m, truth, value), curve=_ap))
    for one, other in combinations(unions, 2):
        found.append(_variant("sibling against sibling (maxitwo)", one, other, "probability", *_paired(one, other)))
    return found


def _values(m: FeatureMap, cells: Sequence[Cell], value: str) -> Array:
    found = [getattr(m.cells[cell], value) for cell in cells]
    return np.array([np.nan if v is None else v for v in found], np.float64)


def _paired(m: FeatureMap, truth: FeatureMap, value: str = "probability") -> tuple[Array, Array]:
    """A value of one map and the failure probability of another over the cells that both fill."""
    ours, against = _over_shared_cells([m], truth, value)
    return ours, against


def _over_shared_cells(maps: Sequence[FeatureMap], truth: FeatureMap, value: str) -> tuple[Array, ...]:
    """A value of several maps, and last the failure probability of another, over the cells that all fill."""
    cells = sorted(set(truth.cells).intersection(*(m.cells for m in maps)))
    ours, against = [_values(m, cells, value) for m in maps], _values(truth, cells, "probability")
    known = ~np.isnan(ours).any(axis=0)
    return tuple(values[known] for values in (*ours, against))


def _filled(m: FeatureMap, truth: FeatureMap, value: str) -> tuple[FeatureMap, FeatureMap, str, Array, Array]:
    """Both maps over their common bounds, with a number that means nothing where nothing is known."""
    filled = set(m.cells) | set(truth.cells)
    axes = [range(min(axis), max(axis) + 1) for axis in zip(*filled, strict=True)]
    cells = list(product(*axes)) if filled else []
    ours = [EMPTY if cell not in m.cells else float(getattr(m.cells[cell], value)) for cell in cells]
    against = [EMPTY if cell not in truth.cells else truth.cells[cell].probability for cell in cells]
    return m, truth, value, np.array(ours, np.float64), np.array(against, np.float64)


def _variant(
    what: str,
    m: FeatureMap,
    against: FeatureMap,
    value: str,
    ours: Array,
    truth: Array,
    *,
    curve: Callable[[Array, Array], float] | None = None,
) -> Variant:
    r, p, _ = _pearson(ours, truth, value)
    auc = curve(ours, truth) if curve is not None and _decided(truth) else None
    found = {"cells": len(ours), "r": r, "p": p, "auc": auc}
    return Variant(what=what, name=m.name, against=against.name, value=value, **found)  # type: ignore[arg-type]


def _pearson(ours: Array, truth: Array, value: str) -> tuple[float | None, float | None, str]:
    """r, p, and why there is none."""
    reason = ""
    if len(ours) < FEWEST_CELLS:
        reason = f"{len(ours)} cells in common, expected {FEWEST_CELLS} or more"
    elif np.ptp(truth) == 0:
        reason = f"the twin's failure probability is {truth[0]:g} in every cell"
    elif np.ptp(ours) == 0:
        reason = f"the map's {value} is {ours[0]:g} in every cell"
    if reason:
        return None, None, reason
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearConstantInputWarning)
        result = pearsonr(ours, truth)
    return float(result.statistic), float(result.pvalue), ""


def _decided(truth: Array) -> bool:
    """Whether some cells fail and some do not (paper 4.3.2: a cell fails when its probability is above 0)."""
    return bool((truth > 0).any() and not (truth > 0).all())


def _average_precision(ours: Array, truth: Array) -> tuple[float | None, str]:
    """AUC-PRC, and why there is none."""
    if _decided(truth):
        return _ap(ours, truth), ""
    if not len(truth):
        return None, "no cells in common"
    return None, f"the twin fails in {'every cell' if (truth > 0).all() else 'no cell'}"


# scikit-learn is imported where it is used: it takes a second, and most verbs do not need it.
def _ap(ours: Array, truth: Array) -> float:
    from sklearn.metrics import average_precision_score

    return float(average_precision_score(truth > 0, ours))


def _roc(ours: Array, truth: Array) -> float:
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(truth > 0, ours))


def _trapezoids(ours: Array, truth: Array) -> float:
    from sklearn.metrics import auc, precision_recall_curve

    precision, recall, _ = precision_recall_curve(truth > 0, ours)
    return float(auc(recall, precision))


def _resampled_r(ours: Array, truth: Array) -> float:
    return float(pearsonr(ours, truth).statistic)  # NaN where one of them is constant


def _resampled_auc(ours: Array, truth: Array) -> float:
    return _ap(ours, truth) if _decided(truth) else float("nan")


def _more(statistic: Callable[[Array, Array], float]) -> Callable[[Array, Array, Array], float]:
    """How much higher a statistic is for the first map than for the second."""
    return lambda ours, theirs, truth: statistic(ours, truth) - statistic(theirs, truth)


def _interval(
    samples: tuple[Array, ...], statistic: Callable[..., float], resamples: int
) -> tuple[float, float] | None:
    """Percentile interval of a bootstrap over cells; the same values give the same interval."""
    from sklearn import config_context

    # The values were checked already, and checking them takes most of the time.
    with warnings.catch_warnings(), config_context(assume_finite=True, skip_parameter_validation=True):
        warnings.simplefilter("ignore", ConstantInputWarning)
        warnings.simplefilter("ignore", NearConstantInputWarning)
        warnings.simplefilter("ignore", DegenerateDataWarning)
        found = bootstrap(
            samples,
            statistic,
            paired=True,
            vectorized=False,
            n_resamples=resamples,
            method="percentile",
            rng=np.random.default_rng(len(samples[0])),
        )
    defined = found.bootstrap_distribution[~np.isnan(found.bootstrap_distribution)]
    if not len(defined):
        return None
    low, high = np.quantile(defined, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)
