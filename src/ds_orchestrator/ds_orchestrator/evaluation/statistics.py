"""Statistics of two maps over the cells that both fill: correlation, precision-recall and their bootstrap intervals."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ConstantInputWarning, DegenerateDataWarning, NearConstantInputWarning, bootstrap, pearsonr

from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.maps.merge_operators import LEVEL
from ds_orchestrator.search.features import Cell

Array = NDArray[np.float64]

RESAMPLES = 1000
"""Resamples of a bootstrap; chosen: ends of an interval are right to about a tenth of its width, in a second."""

_NO_WIDTH = 1e-9
"""Width below which an interval is a single point; chosen: far above rounding errors, far below three digits."""

FEWEST_CELLS = 3
"""With two, every r is 1 or -1."""

FEWEST_OF_EACH_KIND = 10
"""Cells in which the twin fails, and cells in which it does not, that a conclusion needs.

Ten events per predictor: with fewer, estimates are biased and intervals do not hold what they promise (Peduzzi,
Concato, Kemper, Holford, Feinstein, J. Clin. Epidemiol. 1996, 49(12), for logistic regression on one outcome). A map
predicts one outcome, whether the twin fails in a cell, and the rarer outcome is the event.
"""


def caution_of(cells: int, failing: int) -> str:
    """Say why a comparison of maps cannot carry a conclusion; "" if it can.

    Args:
        cells: number of cells compared.
        failing: number of them in which the twin fails.
    """
    if min(failing, cells - failing) >= FEWEST_OF_EACH_KIND:
        return ""
    return (
        f"the twin fails in {failing} of {cells} cells; a conclusion needs {FEWEST_OF_EACH_KIND} cells that fail and "
        f"{FEWEST_OF_EACH_KIND} that do not"
    )


def _values(m: FeatureMap, cells: Sequence[Cell], value: str) -> Array:
    found = [getattr(m.cells[cell], value) for cell in cells]
    return np.array([np.nan if v is None else v for v in found], np.float64)


def _paired(m: FeatureMap, truth: FeatureMap, value: str = "probability") -> tuple[Array, Array]:
    """Collect a value of one map and the failure probability of another over the cells that both fill."""
    ours, against = _over_shared_cells([m], truth, value)
    return ours, against


def _over_shared_cells(maps: Sequence[FeatureMap], truth: FeatureMap, value: str) -> tuple[Array, ...]:
    """Collect a value of several maps, and last the failure probability of another, over the cells that all fill."""
    cells = sorted(set(truth.cells).intersection(*(m.cells for m in maps)))
    ours, against = [_values(m, cells, value) for m in maps], _values(truth, cells, "probability")
    known = ~np.isnan(ours).any(axis=0)
    return tuple(values[known] for values in (*ours, against))


def _pearson(ours: Array, truth: Array, value: str) -> tuple[float | None, float | None, str]:
    """Compute r and p, or say why there is none."""
    reason = ""
    if len(ours) < FEWEST_CELLS:
        reason = f"{len(ours)} cells in common, expected {FEWEST_CELLS} or more"
    elif np.ptp(truth) == 0:
        reason = f"the twin's failure probability is {truth[0]:g} in every cell"
    elif np.ptp(ours) == 0:
        reason = f"the map's {value.replace('_', ' ')} is {ours[0]:g} in every cell"
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
    """Compute the AUC-PRC, or say why there is none."""
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


def _interval(
    samples: tuple[Array, ...], statistic: Callable[..., float], resamples: int
) -> tuple[float, float] | None:
    """Estimate a percentile interval by a bootstrap over cells; the same values give the same interval.

    None without resamples, and where the statistic hardly varies over them at the end of its range (r or AUC-PRC of 1):
    such an interval has no width because the sample is degenerate, not because the estimate is precise.
    """
    if not resamples:
        return None
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
    if high - low < _NO_WIDTH and abs(abs(high) - 1.0) < _NO_WIDTH:
        return None
    return float(low), float(high)
