"""A campaign's tests as one table: undriven features, conditions, families, and an outcome per simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.families import families_of
from ds_analysis.siblings.outcomes import ROAD_FEATURES, Outcomes, condition_columns
from ds_orchestrator.store.folder_files import read_file
from ds_orchestrator.store.sqlite_file import StoreError
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions

if TYPE_CHECKING:
    from ds_orchestrator.campaign.folder import CampaignData
    from ds_orchestrator.search.features import Cell

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
MOST_TESTS = 20_000
"""Tests of a comparison; chosen: far more than a fit of the population can take in minutes."""


class State(IntEnum):
    """What is known of a test on a simulator."""

    MISSING = 0
    COMPLETED = 1
    FAILED = 2
    EXCLUDED = 3
    ERROR = 4


class OutcomeTableError(ValueError):
    """Outcomes that allow no prediction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OutcomeTable:
    """Tests of a campaign, one row each; a column per simulator, the siblings in order, then the twin if there is one.

    Attributes:
        test_ids: (tests,) ids.
        siblings: names of the siblings.
        twin: name of the simulator whose failures are predicted; None if no such simulator was driven.
        roads: (tests,) roads.
        conditions: (tests,) operating conditions.
        cells: (tests,) cell of the feature map; None for a test without one.
        feature_names: names of the features' columns.
        features: (tests, features) what is known of a test before anything is driven: `ROAD_FEATURES` of the road, then
            the conditions that differ between tests, each as a share of its range on its scale.
        states: (tests, simulators) values of `State`.
        lateral: (tests, simulators) largest absolute lateral position, m, at most half a lane; 0 without a verdict.
        families: (tests,) number of the family: the root of mutation from which a test descends.
    """

    test_ids: tuple[str, ...]
    siblings: tuple[str, ...]
    twin: str | None
    roads: tuple[Road, ...]
    conditions: tuple[Conditions, ...]
    cells: tuple[Cell | None, ...]
    feature_names: tuple[str, ...]
    features: Array
    states: NDArray[np.int8]
    lateral: Array
    families: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.test_ids)

    @property
    def simulators(self) -> tuple[str, ...]:
        """Siblings, then the twin if there is one."""
        return (*self.siblings, *([self.twin] if self.twin else []))

    @cached_property
    def half_lanes(self) -> Array:
        """(tests,) half the width of a lane, m."""
        return np.array([road.lane_width / 2 for road in self.roads])

    def column(self, simulator: str) -> int:
        """Index of a simulator's column."""
        return self.simulators.index(simulator)

    def known(self, simulator: str) -> Bools:
        """(tests,) whether a test ended in a verdict on a simulator; excluded tests and errors never do."""
        return np.isin(self.states[:, self.column(simulator)], (State.COMPLETED, State.FAILED))

    def failed(self, simulator: str) -> Bools:
        """(tests,) whether a test failed on a simulator."""
        return np.asarray(self.states[:, self.column(simulator)] == State.FAILED)

    @property
    def on_siblings(self) -> Bools:
        """(tests,) whether a test has a verdict on every sibling."""
        return np.all([self.known(name) for name in self.siblings], axis=0)

    def select(self, rows: Bools | NDArray[np.intp]) -> OutcomeTable:
        """Keep some tests."""
        kept = np.arange(len(self))[rows]
        return replace(
            self,
            test_ids=tuple(self.test_ids[k] for k in kept),
            roads=tuple(self.roads[k] for k in kept),
            conditions=tuple(self.conditions[k] for k in kept),
            cells=tuple(self.cells[k] for k in kept),
            features=self.features[kept],
            states=self.states[kept],
            lateral=self.lateral[kept],
            families=self.families[kept],
        )

    def with_twin(self, name: str | None) -> OutcomeTable:
        """Let another simulator play the twin, and all others the siblings; None leaves the twin out.

        Raises:
            OutcomeTableError: there is no such simulator, or it leaves no sibling.
        """
        if name is not None and name not in self.simulators:
            raise OutcomeTableError(f"no simulator {name!r:.60}, expected one of {', '.join(self.simulators)}")
        siblings = self.siblings if name is None else tuple(s for s in self.simulators if s != name)
        if not siblings:
            raise OutcomeTableError(f"{name} is the only simulator: expected a sibling beside it")
        order = [self.column(s) for s in (*siblings, *([name] if name else []))]
        return replace(self, siblings=siblings, twin=name, states=self.states[:, order], lateral=self.lateral[:, order])


def table_of_campaign(data: CampaignData) -> OutcomeTable:
    """Collect the tests of a campaign, finished or not.

    Raises:
        OutcomeTableError: no test has a verdict yet.
    """
    names = tuple(data.config.simulators)
    column = {name: k for k, name in enumerate(names)}
    row = {test.test_id: k for k, test in enumerate(data.tests)}
    states = np.zeros((len(row), len(names)), np.int8)
    lateral = np.zeros((len(row), len(names)))
    for test_id, simulator, *_ in data.errors:
        if test_id in row and simulator in column:
            states[row[test_id], column[simulator]] = State.ERROR
    for test_id, simulator in data.excluded:
        states[row[test_id], column[simulator]] = State.EXCLUDED
    for one in data.executions:
        at = row[one.test_id], column[one.simulator]
        if one.outcome.is_verdict:
            states[at] = State.FAILED if one.outcome.is_failure else State.COMPLETED
            lateral[at] = one.max_lateral_position
        else:
            states[at] = State.ERROR
    return _table(
        [test.test_id for test in data.tests],
        tuple(data.config.siblings),
        data.config.twin,
        [test.road for test in data.tests],
        [test.conditions for test in data.tests],
        [data.cells.get(test.test_id) for test in data.tests],
        states,
        lateral,
    )


def table_of_outcomes(outcomes: Outcomes, *, twin: str | None = None) -> OutcomeTable:
    """Collect outcomes on the same roads, such as those of `ds siblings compare`; cells are those of the paper's maps.

    Args:
        outcomes: outcomes of one driver on all simulators.
        twin: simulator that plays the twin; None if all are siblings.
    """
    from ds_orchestrator.search.features import cell_of

    table = _table(
        [road.road_id for road in outcomes.roads],
        outcomes.simulators,
        None,
        outcomes.roads,
        outcomes.conditions or [DEFAULT] * len(outcomes.roads),
        [cell_of(road) for road in outcomes.roads],
        np.where(outcomes.failed, State.FAILED, State.COMPLETED).astype(np.int8),
        outcomes.lateral,
    )
    return table.with_twin(twin)


def table_of_comparison(folder: Path, *, twin: str | None = None) -> OutcomeTable:
    """Read what `ds siblings compare --out` wrote; see `table_of_outcomes`.

    Raises:
        OutcomeTableError: the folder holds no comparison.
    """
    import json

    import ds_road

    try:
        document = json.loads(read_file(folder, "comparison.json"))
        rows, names = document["outcomes"], tuple(document["simulators"])
        roads = {road.road_id: road for road in ds_road.read_roads(read_file(folder, "roads.json").decode())}
        shape = len(rows), len(names)
        if shape[0] > MOST_TESTS or not all(isinstance(name, str) for name in names):
            raise ValueError
        outcomes = Outcomes(
            simulators=names,
            roads=tuple(roads[row["road_id"]] for row in rows),
            failed=np.array([[row["failed"][name] for name in names] for row in rows], np.bool_).reshape(shape),
            lateral=np.array([[row["max_lateral_position"][n] for n in names] for row in rows], float).reshape(shape),
            profiles={},
        )
        if not (np.isfinite(outcomes.lateral).all() and (outcomes.lateral >= 0.0).all()):
            raise ValueError
    except StoreError:
        raise
    except (OSError, ValueError, KeyError, TypeError, ArithmeticError, RecursionError):
        raise OutcomeTableError(f"{folder} holds no comparison: expected the --out of `ds siblings compare`") from None
    return table_of_outcomes(outcomes, twin=twin)


def _table(
    test_ids: Sequence[str],
    siblings: tuple[str, ...],
    twin: str | None,
    roads: Sequence[Road],
    conditions: Sequence[Conditions],
    cells: Sequence[Cell | None],
    states: NDArray[np.int8],
    lateral: Array,
) -> OutcomeTable:
    if not np.isin(states, (State.COMPLETED, State.FAILED)).any():
        raise OutcomeTableError("no test has a verdict yet: drive some tests first")
    of_road = {road.road_id: [of(road) for of in ROAD_FEATURES.values()] for road in roads}
    of_conditions = condition_columns(conditions)
    half_lanes = np.array([road.lane_width / 2 for road in roads])
    features = np.array([of_road[road.road_id] for road in roads], np.float64).reshape(len(roads), -1)
    return OutcomeTable(
        test_ids=tuple(test_ids),
        siblings=siblings,
        twin=twin,
        roads=tuple(roads),
        conditions=tuple(conditions),
        cells=tuple(cells),
        feature_names=(*ROAD_FEATURES, *of_conditions),
        features=np.column_stack((features, *of_conditions.values())),
        states=states,
        lateral=np.minimum(lateral, half_lanes[:, None]),
        families=families_of(roads),
    )
