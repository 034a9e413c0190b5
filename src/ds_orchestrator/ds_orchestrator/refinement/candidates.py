"""Makes new tests for a cell: mutants of the tests that it has."""

from __future__ import annotations

import hashlib
from collections import Counter

import numpy as np

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.refined_data import PREFIX
from ds_orchestrator.search.features import Cell, cell_of, feature_of
from ds_orchestrator.siblings.families import families_of
from ds_orchestrator.store.model import Test
from ds_road import MutationError, Road, mutate
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import format_conditions

TRIES = 200
"""Mutants that are tried for one test; chosen: the paper's mutation moves one coordinate by up to 6 m, which rarely
leaves a cell, so that this many without one show that there is hardly any."""


class Candidates:
    """Makes tests for cells, the same ones for the same tests and numbers.

    Mutation is that of the search: a searched condition with its probability, or else the road. Parents are tests of
    the cell, families with the fewest tests in it first, so that new tests depend as little on each other as they can.
    A cell over features of the run is not known before a test is driven: any mutant of the cell's tests is taken.

    Args:
        data: the campaign with its refinement.
    """

    def __init__(self, data: CampaignData) -> None:
        self._config = data.config
        self._families = dict(
            zip((t.test_id for t in data.tests), families_of([t.road for t in data.tests]).tolist(), strict=True)
        )
        self._of_cell: dict[Cell, list[Test]] = {}
        for test in data.tests:
            if test.test_id in data.cells:
                self._of_cell.setdefault(data.cells[test.test_id], []).append(test)
        self._taken = {_content(test.road, test.conditions) for test in data.tests}
        self._foreseen = all(
            (feature.of_road or feature.of_conditions) is not None
            for feature in (feature_of(name) for name in data.config.features)
        )

    def new_test(self, cell: Cell, number: int) -> Test | None:
        """Make a test; None if no mutant lies in the cell.

        Args:
            cell: cell of the test.
            number: of the test among those of the refinement; decides every random choice.
        """
        config, rng = self._config, np.random.default_rng([self._config.seed, number])
        parents = self._parents(cell, rng)
        for attempt in range(TRIES if parents else 0):
            parent = parents[attempt % len(parents)]
            try:
                road, conditions = _mutant(config, parent, rng)
            except MutationError:
                continue
            content = _content(road, conditions)
            if content in self._taken or (self._foreseen and self._cell(road, conditions) != cell):
                continue
            self._taken.add(content)
            made = Test(
                test_id=f"{PREFIX}{number:04d}",
                sibling=parent.sibling,
                run=0,
                number=number,
                road=road,
                seed=_seed(config.seed, number),
                conditions=conditions,
            )
            self._families[made.test_id] = self._families[parent.test_id]
            self._of_cell[cell].append(made)
            return made
        return None

    def _parents(self, cell: Cell, rng: np.random.Generator) -> list[Test]:
        tests = self._of_cell.get(cell, [])
        count = Counter(self._families[test.test_id] for test in tests)
        order = rng.permutation(len(tests))
        return sorted((tests[k] for k in order), key=lambda test: count[self._families[test.test_id]])

    def _cell(self, road: Road, conditions: Conditions) -> Cell | None:
        config = self._config
        return cell_of(
            road, features=config.features, maxitwo_compatible=config.maxitwo_compatible, conditions=conditions
        )


def _mutant(config: CampaignConfig, parent: Test, rng: np.random.Generator) -> tuple[Road, Conditions]:
    space = config.settings.conditions
    if space and rng.random() < config.search.mutate_conditions:
        return parent.road, space.mutated(parent.conditions, rng)
    road = mutate(parent.road, rng, extent=config.search.extent, maxitwo_compatible=config.maxitwo_compatible)
    return road, parent.conditions


def _content(road: Road, conditions: Conditions) -> tuple[str, str]:
    return road.road_id, format_conditions(conditions)


def _seed(seed: int, number: int) -> int:
    """Seed of a test's executions; 32 bits, as those of the campaign."""
    return int.from_bytes(hashlib.sha256(f"{seed}/refine/{number}".encode()).digest()[:4], "little")
