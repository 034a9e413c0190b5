# SPDX-License-Identifier: Apache-2.0
"""Tests and how they ended on several simulators: what every analysis of outcomes reads, whatever they come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

import ds_road
from ds_analysis.common.driven_road import DrivenRoad, lateral_profile, places_along
from ds_analysis.common.statistics import Array, Bools, Indices, families_of
from ds_base.bounded_file import load_json
from ds_base.errors import InputError
from ds_base.folder_files import StoreError, read_file
from ds_orchestrator.search.features import DEFAULT_AXES, Cell, Feature, cell_of, feature_of
from ds_road import Road
from ds_road.geometry import direction_coverage
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, share_of
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_orchestrator.campaign.folder import CampaignData
    from ds_orchestrator.store.model import Execution, Test

SIBLINGS, SIBLINGS_VERSION = "siblings.json", 1
"""File of `ds siblings compare --out`, and the version of its format."""
STUDY = "outcomes.parquet"
"""File of `ds outcomes import`."""
MOST_TESTS = 20_000
"""Tests of a comparison; chosen: far more than a fit of the population can take in minutes."""
MOST_ANALYSED = 2_000
"""Tests of a campaign from which statistics are computed; chosen: more hardly narrow an interval over simulators."""
_SAMPLE_SEED = 22
"""Seed of the sample of families; any number does."""
ROAD_FEATURES: Mapping[str, Callable[[Road], float]] = {
    "length": lambda road: road.length,
    "turns_count": lambda road: float(road.turns_count),
    "curvature": lambda road: road.curvature,
    "direction_coverage": lambda road: direction_coverage(road.points),
    "lane_curvature_max_right": lambda road: road.lane_curvature_max_right,
    "lane_curvature_max_left": lambda road: road.lane_curvature_max_left,
}
"""Features of a road alone that predict failures, without those of the maps that repeat one of them."""


class State(IntEnum):
    """What is known of a test on a simulator."""

    MISSING = 0
    COMPLETED = 1
    FAILED = 2
    EXCLUDED = 3
    ERROR = 4


class OutcomeTableError(InputError):
    """Outcomes that allow no prediction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OutcomeTable:
    """Tests of one driver, one row each; a column per simulator, the siblings in order, then the twin if there is one.

    Attributes:
        twin: simulator whose failures are predicted, if any was driven.
        cells: (tests,) cell of the map over the axes; None for a test without one.
        states: (tests, simulators) values of `State`.
        lateral: (tests, simulators) largest absolute lateral position, m, at most half a lane; 0 without a verdict. Of
            imported outcomes whatever tells how close a run came to its limit; NaN if only the verdict is known.
        limits: (tests, simulators) lateral position at which a test fails: half a lane, m.
        features: (tests, features) known before anything is driven.
        families: (tests,) number of the family: tests of one resemble each other.
        left_out: tests of the campaign that are not in this sample.
    """

    test_ids: tuple[str, ...]
    siblings: tuple[SimulatorName, ...]
    twin: SimulatorName | None
    axes: tuple[Feature, ...]
    cells: tuple[Cell | None, ...]
    states: NDArray[np.int8]
    lateral: Array
    limits: Array
    feature_names: tuple[str, ...]
    features: Array
    families: Indices
    left_out: int = 0

    PER_TEST: ClassVar[tuple[str, ...]] = ("test_ids", "cells", "states", "lateral", "limits", "features", "families")
    PER_SIMULATOR: ClassVar[tuple[str, ...]] = ("states", "lateral", "limits")

    def __len__(self) -> int:
        return len(self.test_ids)

    @property
    def simulators(self) -> tuple[SimulatorName, ...]:
        """Siblings, then the twin if there is one."""
        return (*self.siblings, *([self.twin] if self.twin else []))

    @cached_property
    def rows(self) -> Mapping[str, int]:
        """Test -> its row."""
        return {test_id: row for row, test_id in enumerate(self.test_ids)}

    @property
    def sample_note(self) -> str:
        """Describe the sample in one sentence; "" for a whole campaign."""
        if not self.left_out:
            return ""
        return f"Computed from a sample of whole families; {self.left_out:,} tests of this large campaign are left out."

    def column(self, simulator: SimulatorName) -> int:
        """Index of a simulator's column."""
        return self.simulators.index(simulator)

    def known(self, simulator: SimulatorName) -> Bools:
        """(tests,) whether a test ended in a verdict on a simulator; excluded tests and errors never do."""
        return np.isin(self.states[:, self.column(simulator)], (State.COMPLETED, State.FAILED))

    def failed(self, simulator: SimulatorName) -> Bools:
        """(tests,) whether a test failed on a simulator."""
        return np.asarray(self.states[:, self.column(simulator)] == State.FAILED)

    def largest_lateral(self, simulator: SimulatorName) -> Array:
        """(tests,) largest absolute lateral position on a simulator, m."""
        return self.lateral[:, self.column(simulator)]

    def feature(self, name: str) -> Array:
        """(tests,) values of one feature."""
        return self.features[:, self.feature_names.index(name)]

    @property
    def sibling_verdicts(self) -> tuple[Bools, Bools]:
        """(tests, siblings) whether a test has a verdict there, and whether it failed."""
        states = self.states[:, : len(self.siblings)]
        return np.isin(states, (State.COMPLETED, State.FAILED)), np.asarray(states == State.FAILED)

    @property
    def on_siblings(self) -> Bools:
        """(tests,) whether a test has a verdict on every sibling."""
        return np.asarray(self.sibling_verdicts[0].all(axis=1))

    @property
    def on_a_sibling(self) -> Bools:
        """(tests,) whether a test has a verdict on some sibling."""
        return np.asarray(self.sibling_verdicts[0].any(axis=1))

    def select(self, rows: Bools | Indices) -> Self:
        """Keep some tests, with the features and families that they have among all."""
        kept = np.arange(len(self))[rows]
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.PER_TEST}
        kept_columns: dict[str, Any] = {
            name: tuple(values[row] for row in kept) if isinstance(values, tuple) else values[kept]
            for name, values in columns.items()
        }
        return replace(self, **kept_columns)

    def judged(self) -> Self:
        """Keep the tests with a verdict on every simulator."""
        return self.select(np.all([self.known(name) for name in self.simulators], axis=0))

    def as_population(self) -> Self:
        """Let a twin that was driven be one more sibling, to predict a car; one that was not is left out."""
        if self.twin is None or not self.known(self.twin).any():
            return self.with_twin(None)
        return replace(self, siblings=self.simulators, twin=None)

    def with_twin(self, name: SimulatorName | None) -> Self:
        """Let another simulator play the twin, and all others the siblings; None leaves the twin out.

        `OutcomeTableError` if there is no such simulator, or it leaves no sibling.
        """
        if name is not None and name not in self.simulators:
            raise OutcomeTableError(f"no simulator {name!r:.60}, expected one of {', '.join(self.simulators)}")
        siblings = self.siblings if name is None else tuple(s for s in self.simulators if s != name)
        if not siblings:
            raise OutcomeTableError(f"{name} is the only simulator: expected a sibling beside it")
        order = [self.column(s) for s in (*siblings, *([name] if name else []))]
        columns = {key: getattr(self, key)[:, order] for key in self.PER_SIMULATOR}
        return replace(self, siblings=siblings, twin=name, **columns)


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadTable(OutcomeTable):
    """Tests of roads that this project drove.

    Their features are those of the road, `ROAD_FEATURES`, then the conditions that differ between tests, each as a
    share of its range on its scale; a family is all that descend from one root of mutation.
    """

    roads: tuple[Road, ...]
    conditions: tuple[Conditions, ...]
    drives: NDArray[np.object_]  # (tests, simulators) recorded drives, or None; see `profiles`
    PER_TEST: ClassVar[tuple[str, ...]] = (*OutcomeTable.PER_TEST, "roads", "conditions", "drives")
    PER_SIMULATOR: ClassVar[tuple[str, ...]] = (*OutcomeTable.PER_SIMULATOR, "drives")

    @classmethod
    def of(
        cls,
        roads: Sequence[Road],
        states: NDArray[np.int8],
        lateral: Array,
        *,
        siblings: Sequence[SimulatorName],
        twin: SimulatorName | None = None,
        test_ids: Sequence[str] | None = None,
        conditions: Sequence[Conditions] | None = None,
        axes: Sequence[Feature] = DEFAULT_AXES,
        cells: Sequence[Cell | None] | None = None,
        drives: Sequence[Sequence[DrivenRoad | Execution | None]] | None = None,
    ) -> RoadTable:
        """Make a table, with the features and families of its tests, from (tests, simulators) arrays.

        By default, tests have the ids of their roads, the default conditions, and the cells of the paper's maps. Drives
        are of verdicts only.
        """
        conditions = [DEFAULT] * len(roads) if conditions is None else conditions
        half = np.array([road.lane_width / 2 for road in roads], np.float64)
        limits = np.repeat(half[:, None], states.shape[1], axis=1)
        return cls(
            test_ids=tuple(road.road_id for road in roads) if test_ids is None else tuple(test_ids),
            siblings=tuple(siblings),
            twin=twin,
            roads=tuple(roads),
            conditions=tuple(conditions),
            axes=tuple(axes),
            cells=tuple(map(cell_of, roads)) if cells is None else tuple(cells),
            states=states,
            lateral=np.minimum(lateral, limits),
            limits=limits,
            drives=np.array(drives, object).reshape(states.shape) if drives else np.full(states.shape, None),
            **_known_undriven(roads, conditions),
        )

    @cached_property
    def profiles(self) -> Mapping[str, Sequence[Array]]:
        """Simulator -> lateral positions every `GRID` m along the lane, m, of every test; decoded when first asked."""
        return {
            name: [_profile(road, one) for road, one in zip(self.roads, self.drives[:, k], strict=True)]
            for k, name in enumerate(self.simulators)
        }

    def judged(self) -> RoadTable:
        """Keep the tests with a verdict on every simulator; features and families are those among these alone."""
        kept = super().judged()
        return replace(kept, **_known_undriven(kept.roads, kept.conditions))


def table_of_runs(
    runs: Mapping[SimulatorName, Sequence[DrivenRoad]], *, conditions: Sequence[Conditions] | None = None
) -> RoadTable:
    """Collect runs of the same tests in the same order on siblings; conditions of the tests are the default if None."""
    rows = list(zip(*runs.values(), strict=True))
    roads = [row[0].road for row in rows]
    return RoadTable.of(roads, *_measured(rows, len(runs)), siblings=tuple(runs), conditions=conditions, drives=rows)


def table_of_campaign(data: CampaignData, *, most: int | None = None) -> RoadTable:
    """Collect the tests of a campaign, finished or not; a road and conditions that it drove twice count once.

    Of more than `most` tests, a sample of whole families is taken.

    Raises:
        OutcomeTableError: no test has a verdict yet.
    """
    data = data.distinct
    names = data.config.simulators
    tests = data.tests if most is None else _sample_of(data.tests, most)
    done = {(one.test_id, one.simulator): one for one in data.verdicts}
    drives = [[done.get((test.test_id, name)) for name in names] for test in tests]
    states, lateral = _measured(drives, len(names))
    tried = {(test_id, simulator) for test_id, simulator, *_ in data.errors}
    for row, column in np.argwhere(states == State.MISSING).tolist():
        key = tests[row].test_id, names[column]
        if key in data.excluded or key in tried:
            states[row, column] = State.EXCLUDED if key in data.excluded else State.ERROR
    table = _with_verdicts(
        RoadTable.of(
            [test.road for test in tests],
            states,
            lateral,
            siblings=data.config.siblings,
            twin=data.config.twin,
            test_ids=[test.test_id for test in tests],
            conditions=[test.conditions for test in tests],
            axes=[feature_of(name) for name in data.config.features],
            cells=[data.cells.get(test.test_id) for test in tests],
            drives=drives,
        )
    )
    return replace(table, left_out=len(data.tests) - len(tests))


def _sample_of(tests: Sequence[Test], most: int) -> Sequence[Test]:
    """Draw whole families at random, in the campaign's order; single tests where every family is too large."""
    if len(tests) <= most:
        return tests
    families = families_of([test.road for test in tests])
    drawn = np.random.default_rng(_SAMPLE_SEED).permutation(families.max() + 1)
    kept = drawn[np.cumsum(np.bincount(families)[drawn]) <= most]
    rows = np.flatnonzero(np.isin(families, kept)) if len(kept) else np.linspace(0, len(tests) - 1, most).astype(int)
    return [tests[row] for row in rows]


def siblings_file(folder: Path) -> str:
    """Name of the file of `ds siblings compare --out` in a folder: until 0.2 that of `ds compare`, too."""
    return SIBLINGS if (folder / SIBLINGS).exists() else "comparison.json"


def is_study(folder: Path) -> bool:
    """Whether a folder holds imported outcomes."""
    return (folder / STUDY).exists()


def table_of_comparison(folder: Path, *, twin: SimulatorName | None = None) -> RoadTable:
    """Read what `ds siblings compare --out` wrote, without profiles; all but the twin are siblings.

    Raises:
        OutcomeTableError: the folder holds no comparison, or one without a verdict.
    """
    try:
        document = load_json(read_file(folder, siblings_file(folder)))
        if document.get("version", SIBLINGS_VERSION) != SIBLINGS_VERSION:
            raise OutcomeTableError(f"{folder} was written by another version of ds: compare the siblings again")
        rows, names = document["outcomes"], tuple(document["simulators"])
        roads = {road.road_id: road for road in ds_road.read_roads(read_file(folder, "roads.json").decode())}
        shape = len(rows), len(names)
        if shape[0] > MOST_TESTS or not all(isinstance(name, str) for name in names):
            raise ValueError
        failed = np.array([[row["failed"][name] for name in names] for row in rows], np.bool_).reshape(shape)
        lateral = np.array([[row["max_lateral_position"][n] for n in names] for row in rows], float).reshape(shape)
        if not (np.isfinite(lateral).all() and (lateral >= 0.0).all()):
            raise ValueError
        states = np.where(failed, State.FAILED, State.COMPLETED).astype(np.int8)
        table = RoadTable.of(
            [roads[row["road_id"]] for row in rows], states, lateral, siblings=tuple(map(SimulatorName, names))
        )
    except (StoreError, OutcomeTableError):
        raise
    except (OSError, ValueError, KeyError, AttributeError, TypeError, ArithmeticError):
        raise OutcomeTableError(f"{folder} holds no comparison: expected the --out of `ds siblings compare`") from None
    return _with_verdicts(table).with_twin(twin)


def _with_verdicts(table: RoadTable) -> RoadTable:
    if not np.isin(table.states, (State.COMPLETED, State.FAILED)).any():
        raise OutcomeTableError("no test has a verdict yet: drive some tests first")
    return table


def _measured(
    drives: Sequence[Sequence[DrivenRoad | Execution | None]], simulators: int
) -> tuple[NDArray[np.int8], Array]:
    """(tests, simulators) states and largest lateral positions, m, of drives."""
    states = [[_state(one) for one in row] for row in drives]
    lateral = [[one.max_lateral_position if one and one.outcome.is_verdict else 0.0 for one in row] for row in drives]
    shape = len(drives), simulators
    return np.array(states, np.int8).reshape(shape), np.array(lateral, np.float64).reshape(shape)


def _state(one: DrivenRoad | Execution | None) -> State:
    if one is None or not one.outcome.is_verdict:
        return State.MISSING if one is None else State.ERROR
    return State.FAILED if one.outcome.is_failure else State.COMPLETED


def _known_undriven(roads: Sequence[Road], conditions: Sequence[Conditions]) -> dict[str, Any]:
    """Features and families of tests; features of a road that several tests drive are computed once."""
    of_road = {road.road_id: [of(road) for of in ROAD_FEATURES.values()] for road in roads}
    features = np.array([of_road[road.road_id] for road in roads], np.float64).reshape(len(roads), len(ROAD_FEATURES))
    of_conditions = {}
    for name, field in FIELDS.items():
        values = [getattr(one, name) for one in conditions]
        # A condition that a simulator chooses itself cannot be compared, and is left out.
        if len(set(values)) > 1 and None not in values:
            of_conditions[name] = np.array([share_of(name, field.low, field.high, value) for value in values])
    return {
        "feature_names": (*ROAD_FEATURES, *of_conditions),
        "features": np.column_stack((features, *of_conditions.values())),
        "families": families_of(roads),
    }


def _profile(road: Road, one: DrivenRoad | Execution | None) -> Array:
    """Lateral positions along the lane; () if nobody recorded them."""
    if one is None or isinstance(one, DrivenRoad):
        return np.empty(0) if one is None else one.profile
    return lateral_profile(places_along(road, one.trajectory), one.trajectory[:, 4], road.lane_width / 2)
