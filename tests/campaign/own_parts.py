# SPDX-License-Identifier: Apache-2.0
"""Parts of the method that a user could bring: a search, a feature, a merge operator."""

import numpy as np

from ds_orchestrator.maps.algebra import MergeOperator
from ds_orchestrator.search.algorithms import Search
from ds_orchestrator.search.features import Feature
from ds_road import Road, generate
from ds_sim.conditions.model import Conditions

MEDIAN = MergeOperator(combine=lambda values, weights: np.asarray(np.median(values, axis=0)), seed=100)
EASTING = Feature(name="easting", title="easting of the end, m", value=lambda run: run.road.control_points[-1][0])
NOTHING = "no part at all"


class StraightSearch(Search):
    """Draws roads that hardly bend, whatever the outcomes."""

    def _next(self) -> tuple[Road, Conditions]:
        return self._random_road(), self._settings.conditions.draw(self._rng)

    def _random_road(self) -> Road:
        return generate(self._rng, max_angle=20)
