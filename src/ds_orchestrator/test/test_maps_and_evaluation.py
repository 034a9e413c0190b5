"""Union, merge and correlation against a campaign of twelve tests on three siblings, worked by hand."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ds_orchestrator.evaluation import correlate, evaluate
from ds_orchestrator.features import Cell
from ds_orchestrator.maps import FeatureMap, MapCell, campaign_maps, merge, to_json
from ds_orchestrator.store import Execution, Test
from ds_road import Road, generate
from ds_sim.simulator import Outcome

SIBLINGS = ["a", "b", "c"]
ROADS = {road.turns_count: road for road in (generate(np.random.default_rng(s), max_angle=200) for s in range(40))}
CELLS: dict[int, Cell] = {turns: (turns, road.curvature_bin) for turns, road in ROADS.items()}
X, Y = sorted(ROADS)[:2]


def make_test(test_id: str, sibling: str, turns: int) -> Test:
    return Test(test_id=test_id, sibling=sibling, run=0, number=0, road=ROADS[turns], seed=1)


def make_execution(test_id: str, simulator: str, lateral: float, outcome: Outcome | None = None) -> Execution:
    verdict = outcome or (Outcome.OUT_OF_BOUNDS if lateral > 2.0 else Outcome.COMPLETED)
    return Execution(
        test_id=test_id, simulator=simulator, outcome=verdict, message="", fitness=2.0 - lateral,
        max_lateral_position=lateral, steps=1, simulated_seconds=0.05, trajectory_sha256="",
        trajectory=np.zeros((1, 5)),
    )  # fmt: skip


# Four tests per sibling: three in cell X, one in cell Y; the maximum lateral position of each on a, b, c and the twin.
TABLE = {
    "a0": (X, 2.5, 2.1, 0.5, 2.2), "a1": (X, 0.5, 2.1, 0.5, 0.5), "a2": (X, 0.5, 0.5, 0.5, 0.5),
    "a3": (Y, 0.5, 0.5, 0.5, 0.5), "b0": (X, 2.1, 2.5, 2.1, 2.1), "b1": (X, 0.5, 2.1, 0.5, 0.5),
    "b2": (X, 0.5, 0.5, 0.5, 0.5), "b3": (Y, 0.5, 2.1, 0.5, 0.5), "c0": (X, 2.1, 0.5, 0.5, 0.5),
    "c1": (X, 0.5, 0.5, 0.5, 0.5), "c2": (X, 0.5, 0.5, 2.1, 0.5), "c3": (Y, 2.1, 0.5, 0.5, 0.5),
}  # fmt: skip
TESTS = [make_test(name, name[0], row[0]) for name, row in TABLE.items()]
EXECUTIONS = [
    make_execution(name, simulator, row[1 + index])
    for name, row in TABLE.items()
    for index, simulator in enumerate([*SIBLINGS, "twin"])
]


def probabilities(feature_map: FeatureMap) -> dict[Cell, Any]:
    return {cell: (value.tests, value.probability) for cell, value in feature_map.cells.items()}


def test_maps_of_the_hand_worked_campaign() -> None:
    maps = campaign_maps(SIBLINGS, "twin", TESTS, EXECUTIONS)
    x, y = CELLS[X], CELLS[Y]
    # a on its own three tests in X: only a0 fails.
    assert probabilities(maps["search_a"]) == {x: (3, pytest.approx(1 / 3)), y: (1, 0.0)}
    # b's tests on a: b0 fails in X, none in Y.
    assert probabilities(maps["migration_b_to_a"]) == {x: (3, pytest.approx(1 / 3)), y: (1, 0.0)}
    # Nine tests of X on a: a0, b0, c0 fail; three of Y: c3.
    assert probabilities(maps["union_a"]) == {x: (9, pytest.approx(3 / 9)), y: (3, pytest.approx(1 / 3))}
    assert probabilities(maps["union_b"]) == {x: (9, pytest.approx(4 / 9)), y: (3, pytest.approx(1 / 3))}
    assert probabilities(maps["union_c"]) == {x: (9, pytest.approx(2 / 9)), y: (3, 0.0)}
    merged = probabilities(maps["merged"])
    assert merged == {x: (9, pytest.approx(3 / 9 * 4 / 9 * 2 / 9)), y: (3, 0.0)}
    assert probabilities(maps["twin_twin"]) == {x: (9, pytest.approx(2 / 9)), y: (3, 0.0)}
    # Quality over the range 0.5 to 2.5: 2.5 -> 1, 2.1 -> 0.8. Cell X on a: (1 + 0.8 + 0.8) / 9, on c: (0.8 + 0.8) / 9.
    assert maps["union_a"].cells[x].quality == pytest.approx(2.6 / 9)
    assert maps["union_c"].cells[x].quality == pytest.approx(1.6 / 9)
    assert maps["merged"].cells[x].quality == pytest.approx(1.6 / 9)
    assert maps["merged"].cells[x].failures is None and maps["union_a"].cells[x].failures == 3


def test_errors_enter_no_map_and_an_empty_cell_is_not_zero() -> None:
    lost = [
        make_execution(e.test_id, e.simulator, 0.5, Outcome.DRIVER_SILENT) if e.simulator == "b" and e.test_id[1] == "3"
        else e
        for e in EXECUTIONS
    ]  # fmt: skip
    maps = campaign_maps(SIBLINGS, None, TESTS, lost)
    assert CELLS[Y] not in maps["union_b"].cells and CELLS[Y] not in maps["merged"].cells
    assert CELLS[Y] in maps["union_a"].cells
    assert not any(name.startswith("twin") for name in maps)
    json.dumps(to_json(maps), allow_nan=False)


def test_stuck_and_timeout_are_failures() -> None:
    tests = [make_test("a0", "a", X), make_test("a1", "a", X)]
    done = [make_execution("a0", "a", 0.1, Outcome.STUCK), make_execution("a1", "a", 0.1, Outcome.TIMEOUT)]
    assert campaign_maps(["a"], None, tests, done)["union_a"].cells[CELLS[X]].probability == 1.0


cells = st.dictionaries(
    st.tuples(st.integers(0, 4), st.integers(4, 9)),
    st.builds(
        lambda tests, share, quality: MapCell(
            tests=tests, failures=round(share * tests), probability=round(share * tests) / tests, quality=quality
        ),
        st.integers(1, 9), st.floats(0, 1), st.floats(0, 1),
    ),
    max_size=8,
)  # fmt: skip
feature_maps = cells.map(lambda c: FeatureMap(name="m", cells={(*cell,): value for cell, value in c.items()}))


@given(st.lists(feature_maps, min_size=1, max_size=4), st.randoms())
def test_merge_does_not_depend_on_order_and_never_exceeds_any_sibling(maps: list[FeatureMap], random: object) -> None:
    shuffled = list(maps)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    one, other = merge("m", maps), merge("m", shuffled)
    assert set(one.cells) == set(other.cells) == set.intersection(*(set(m.cells) for m in maps))
    for cell, value in one.cells.items():
        assert value.probability == pytest.approx(other.cells[cell].probability)
        assert value.probability <= min(m.cells[cell].probability for m in maps) + 1e-12
        assert value.quality == min(m.cells[cell].quality for m in maps)


@given(feature_maps)
def test_one_sibling_gives_itself_back(feature_map: FeatureMap) -> None:
    assert merge("m", [feature_map]).cells == feature_map.cells


def test_counts_add_up_over_origins() -> None:
    maps = campaign_maps(SIBLINGS, "twin", TESTS, EXECUTIONS)
    for sibling in SIBLINGS:
        parts = [maps[f"search_{sibling}"], *(maps[f"migration_{o}_to_{sibling}"] for o in SIBLINGS if o != sibling)]
        for cell, value in maps[f"union_{sibling}"].cells.items():
            assert value.tests == sum(p.cells[cell].tests for p in parts if cell in p.cells)
            assert value.failures == sum(p.cells[cell].failures or 0 for p in parts if cell in p.cells)


def row(values: list[float]) -> FeatureMap:
    cells: dict[Cell, MapCell] = {
        (i, 5): MapCell(tests=1, failures=0, probability=v, quality=1 - v) for i, v in enumerate(values)
    }
    return FeatureMap(name="m", cells=cells)


def test_pearson_equals_the_textbook_formula() -> None:
    ours, truth = [0.0, 0.25, 0.5, 1.0, 0.0], [0.0, 0.5, 0.5, 1.0, 0.25]
    mx, my = sum(ours) / 5, sum(truth) / 5
    covariance = sum((a - mx) * (b - my) for a, b in zip(ours, truth, strict=True))
    r = covariance / math.sqrt(sum((a - mx) ** 2 for a in ours) * sum((b - my) ** 2 for b in truth))
    found = correlate(row(ours), row(truth), "probability")
    assert found.r == pytest.approx(r) and found.cells == 5 and found.p is not None and 0 < found.p < 1
    assert correlate(row(ours), row(truth), "quality").r == pytest.approx(-r)


@pytest.mark.parametrize(
    ("ours", "truth", "reason"),
    [([0.1, 0.2], [0.0, 1.0], "2 cells"), ([0.0, 0.5, 1.0], [0.0] * 3, "twin"), ([0.5] * 3, [0.0, 1.0, 0.0], "map")],
)
def test_a_correlation_that_is_not_defined_says_why(ours: list[float], truth: list[float], reason: str) -> None:
    found = correlate(row(ours), row(truth), "probability")
    assert found.r is None and found.p is None and reason in found.reason


def test_every_sibling_and_the_merge_are_compared_with_the_twin() -> None:
    found = evaluate(campaign_maps(SIBLINGS, "twin", TESTS, EXECUTIONS), SIBLINGS, "twin", resamples=20)
    names = ["union_a", "union_b", "union_c", "merged"]
    assert [(c.name, c.value) for c in found] == [(n, v) for v in ("probability", "quality") for n in names]


def test_roads_for_the_table_exist() -> None:
    assert isinstance(ROADS[X], Road) and CELLS[X] != CELLS[Y]
