# SPDX-License-Identifier: Apache-2.0
"""Evidence of a difference between two networks that holds however one stops: bets on one test after the other.

For each difference of the failure probabilities a gambler bets on either side of it, with stakes of equal weights; a
true difference lets his capital grow to 1 / `ALPHA` with a probability of at most `ALPHA`, ever (Ville's inequality;
Waudby-Smith and Ramdas, J. R. Stat. Soc. B 2024). So tests may be looked at after each drive, and drives end as soon as
the answer is sure. It holds for random tests, each drawn without regard to those before.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ds_analysis.common.selection import ALPHA

BATCH = 5
"""Random roads after which a comparison looks whether its answer is sure; chosen: starting workers takes seconds."""
TOLERANCE = 0.1
"""Increase of the failure probability below which a candidate is not worse for `ds compare --stop-early`; chosen."""
_STAKES = np.array([0.2, 0.5, 0.95])
"""Shares of the capital that a bet may lose; chosen, as any below 1 is valid and some fit any difference."""
_MOST = 1e280
"""Capital that is enough; more would overflow."""
_DIFFERENCES = np.linspace(-1.0, 1.0, 201)


@lru_cache(maxsize=4096)
def sequential_evidence(changes: tuple[int, ...]) -> tuple[float, tuple[float, float]]:
    """Return p of no difference, in either direction, and the interval of the difference, both valid at any time.

    Args:
        changes: of each test in the order of the drives: 1 newly fails, -1 is fixed, 0 is as before.

    Examples:
        >>> from ds_analysis.comparison.sequential import sequential_evidence
        >>> p, (low, high) = sequential_evidence((1, 1, 0, 1, 1, 1, 1, 1, 1, 1))
        >>> p < 0.05, low > 0.0, high > 0.9
        (True, True, True)
    """
    mean = np.clip((_DIFFERENCES + 1.0) / 2.0, 1e-9, 1.0 - 1e-9)
    stakes = np.concatenate((_STAKES[:, None] / mean, -_STAKES[:, None] / (1.0 - mean)))
    capital, highest = np.ones_like(stakes), np.ones(len(mean))
    for change in changes:
        capital = np.minimum(capital * (1.0 + stakes * ((change + 1.0) / 2.0 - mean)), _MOST)
        highest = np.maximum(highest, capital.mean(axis=0))
    none = len(mean) // 2
    kept = _DIFFERENCES[highest < 1.0 / ALPHA]
    observed = float(np.mean(changes)) if changes else 0.0
    low, high = (float(kept[0]), float(kept[-1])) if len(kept) else (observed, observed)
    return float(1.0 / highest[none]), (min(low, observed), max(high, observed))
