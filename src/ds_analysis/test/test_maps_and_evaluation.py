# SPDX-License-Identifier: Apache-2.0
"""Union, merge and correlation of a campaign of twelve tests on three siblings by hand, and names of maps."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_executions import made_execution
from scipy.stats import beta
from sklearn.metrics import average_precision_score
from statsmodels.stats.proportion import proportion_confint

from ds_analysis.common.statistics import Array, auc_prc
from ds_analysis.paper.correlation import RobustnessCheck, check_robustness, correlate, paired_differences
from ds_base.intervals import jeffreys_interval
from ds_orchestrator.maps import algebra
from ds_orchestrator.maps.algebra import OPERATORS, apply, merge, merged_interval, union
from ds_orchestrator.maps.campaign_maps import MapPlan, build_maps, cells_of, elites_of
from ds_orchestrator.maps.feature_map import (
    FeatureMap,
    MapCell,
    MapId,
    compared_ids,
    map_ids,
    maps_frame,
    slices_of,
    to_json,
)
from ds_orchestrator.search.features import DEFAULT_AXES, Cell, feature_of
from ds_orchestrator.store.model import DriveArrays, Execution, Origin, Test
from ds_road import generate
from ds_sim import SimulatorName
from ds_sim.gates.gate import Gate, GateState
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

ON_A, ON_B, ON_C = SIBLINGS = list(map(SimulatorName, "abc"))
TWIN = SimulatorName("twin")
M = MapId.merged()
"""Identity of maps in tests that do not depend on it."""
ROADS = {road.turns_count: road for road in (generate(np.random.default_rng(s), max_angle=200) for s in range(40))}
CELLS: dict[int, Cell] = {turns: (turns, int(100 * road.curvature)) for turns, road in ROADS.items()}
X, Y = sorted(ROADS)[:2]


def make_test(test_id: str, sibling: str, turns: int) -> Test:
    return Test(test_id, Scenario(ROADS[turns], seed=1), Origin(SimulatorName(sibling), 0, 0))


def make_execution(test_id: str, simulator: str, lateral: float, outcome: Outcome | None = None) -> Execution:
    verdict = outcome or (Outcome.OUT_OF_BOUNDS if lateral > 2.0 else Outcome.COMPLETED)
    return made_execution(test_id, simulator, verdict, lateral)


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
    maps = build_maps(SIBLINGS, TWIN, TESTS, EXECUTIONS)
    x, y = CELLS[X], CELLS[Y]
    # a on its own three tests in X: only a0 fails.
    assert probabilities(maps[MapId.search(ON_A)]) == {x: (3, pytest.approx(1 / 3)), y: (1, 0.0)}
    # b's tests on a: b0 fails in X, none in Y.
    assert probabilities(maps[MapId.migration(ON_B, ON_A)]) == {x: (3, pytest.approx(1 / 3)), y: (1, 0.0)}
    # Nine tests of X on a: a0, b0, c0 fail; three of Y: c3.
    assert probabilities(maps[MapId.union(ON_A)]) == {x: (9, pytest.approx(3 / 9)), y: (3, pytest.approx(1 / 3))}
    assert probabilities(maps[MapId.union(ON_B)]) == {x: (9, pytest.approx(4 / 9)), y: (3, pytest.approx(1 / 3))}
    assert probabilities(maps[MapId.union(ON_C)]) == {x: (9, pytest.approx(2 / 9)), y: (3, 0.0)}
    merged = probabilities(maps[MapId.merged()])
    assert merged == {x: (9, pytest.approx(3 / 9 * 4 / 9 * 2 / 9)), y: (3, 0.0)}
    assert probabilities(maps[MapId.twin(TWIN)]) == {x: (9, pytest.approx(2 / 9)), y: (3, 0.0)}
    # Quality over the range 0.5 to 2.5: 2.5 -> 1, 2.1 -> 0.8. Cell X on a: (1 + 0.8 + 0.8) / 9, on c: (0.8 + 0.8) / 9.
    assert maps[MapId.union(ON_A)].cells[x].quality_loss == pytest.approx(2.6 / 9)
    assert maps[MapId.union(ON_C)].cells[x].quality_loss == pytest.approx(1.6 / 9)
    assert maps[MapId.merged()].cells[x].quality_loss == pytest.approx(1.6 / 9)
    assert maps[MapId.merged()].cells[x].failures is None and maps[MapId.union(ON_A)].cells[x].failures == 3


def test_errors_enter_no_map_and_an_empty_cell_is_not_zero() -> None:
    lost = [
        make_execution(e.test_id, e.simulator, 0.5, Outcome.DRIVER_SILENT)
        if e.simulator == "b" and e.test_id[1] == "3"
        else e
        for e in EXECUTIONS
    ]
    maps = build_maps(SIBLINGS, None, TESTS, lost)
    assert CELLS[Y] not in maps[MapId.union(ON_B)].cells and CELLS[Y] not in maps[MapId.merged()].cells
    assert CELLS[Y] in maps[MapId.union(ON_A)].cells
    assert not any(map_id.kind == "twin" for map_id in maps)
    json.dumps(to_json(maps), allow_nan=False)


def test_excluded_tests_are_counted_apart_and_in_no_probability() -> None:
    """`a0` is excluded on its own sibling `a`, `b1` on `c` and on the twin."""
    valid, out = Gate(state=GateState.VALID), Gate(state=GateState.OUT_OF_ODD)
    excluded = {("a0", ON_A), ("b1", ON_C), ("b1", TWIN)}
    gates = {(e.test_id, e.simulator): valid for e in EXECUTIONS} | dict.fromkeys(excluded, out)
    done = [e for e in EXECUTIONS if (e.test_id, e.simulator) not in excluded]
    maps = build_maps(SIBLINGS, TWIN, TESTS, done, gates=gates)
    x = CELLS[X]
    searched = [MapId.search(ON_A), MapId.migration(ON_B, ON_C), MapId.migration(ON_B, TWIN)]
    once = [*searched, MapId.union(ON_A), MapId.union(ON_C), MapId.twin(TWIN)]
    found = {map_id: feature_map.excluded for map_id, feature_map in maps.items() if feature_map.excluded}
    assert found == {**dict.fromkeys(once, {x: 1}), M: {x: 2}}
    assert probabilities(maps[MapId.union(ON_A)])[x] == (8, pytest.approx(2 / 8))
    document = json.loads(json.dumps(to_json(maps), allow_nan=False))
    assert document[M.name]["excluded"] == [{"turns_count": x[0], "curvature": x[1], "tests": 2}]
    assert "excluded" not in document[MapId.search(ON_B).name]
    frame = maps_frame(maps)
    row = frame[(frame["map"] == M.name) & (frame["turns_count"] == x[0])]
    assert row["excluded"].tolist() == [2] and frame["excluded"].sum() == 8
    without = build_maps(SIBLINGS, TWIN, TESTS, EXECUTIONS, gates=dict.fromkeys(gates, valid))
    assert to_json(without) == to_json(build_maps(SIBLINGS, TWIN, TESTS, EXECUTIONS))


def test_the_measured_contrast_of_lines_is_that_of_the_sibling_that_searched() -> None:
    axes = ("turns_count", "visible_contrast")
    gates = {
        ("a0", ON_A): Gate(state=GateState.VALID, outcome=Outcome.COMPLETED, visible_contrast=0.85),  # 0.05 x 2^4 = 0.8
        ("a0", ON_B): Gate(state=GateState.VALID, outcome=Outcome.COMPLETED, visible_contrast=9.0),
        ("a1", ON_A): Gate(state=GateState.OUT_OF_ODD, outcome=Outcome.COMPLETED, visible_contrast=0.0),
        ("a2", ON_A): Gate(state=GateState.NOT_APPLICABLE),
    }
    cells = cells_of(TESTS, EXECUTIONS, features=axes, gates=gates)
    assert cells == {"a0": (X, 4), "a1": (X, 0)}
    assert [feature_of("visible_contrast").label(k) for k in (0, 4)] == ["0.05", "0.8"]


cells = st.dictionaries(
    st.tuples(st.integers(0, 4), st.integers(4, 9)),
    st.builds(
        lambda tests, share, quality: MapCell(
            tests=tests, failures=round(share * tests), probability=round(share * tests) / tests, quality_loss=quality
        ),
        st.integers(1, 9),
        st.floats(0, 1),
        st.floats(0, 1),
    ),
    max_size=8,
)
feature_maps = cells.map(lambda c: FeatureMap(id=M, cells={(*cell,): value for cell, value in c.items()}))


@settings(deadline=None)  # the first example imports SciPy
@given(st.lists(feature_maps, min_size=1, max_size=4), st.randoms())
def test_merge_does_not_depend_on_order_and_never_exceeds_any_sibling(maps: list[FeatureMap], random: object) -> None:
    shuffled = list(maps)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    one, other = merge(M, maps), merge(M, shuffled)
    assert set(one.cells) == set(other.cells) == set.intersection(*(set(m.cells) for m in maps))
    for cell, value in one.cells.items():
        assert value.probability == pytest.approx(other.cells[cell].probability)
        assert value.probability <= min(m.cells[cell].probability for m in maps) + 1e-12
        assert value.quality_loss == min(m.cells[cell].quality_loss for m in maps)


@settings(deadline=None)  # the first example imports SciPy
@given(feature_maps)
def test_one_sibling_gives_itself_back(feature_map: FeatureMap) -> None:
    assert merge(M, [feature_map]).cells == feature_map.cells
    alone = union(M, [feature_map])
    assert probabilities(alone) == probabilities(feature_map)
    for cell, value in alone.cells.items():
        assert value.quality_loss == feature_map.cells[cell].quality_loss == pytest.approx(value.pooled_quality_loss)


@settings(deadline=None)  # the first example imports SciPy
@given(st.lists(feature_maps, min_size=1, max_size=4), st.randoms())
def test_a_union_adds_up_and_does_not_depend_on_order(maps: list[FeatureMap], random: object) -> None:
    shuffled = list(maps)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    one = union(M, maps)
    assert one == union(M, shuffled)
    assert set(one.cells) == set().union(*(m.cells for m in maps))
    for cell, value in one.cells.items():
        parts = [m.cells[cell] for m in maps if cell in m.cells]
        assert value.tests == sum(p.tests for p in parts) and value.failures == sum(p.failures or 0 for p in parts)
        qualities = [p.quality_loss for p in parts]
        assert min(qualities) - 1e-12 <= value.quality_loss <= max(qualities) + 1e-12
        assert value.interval is not None and value.interval[0] <= value.probability <= value.interval[1]


def test_both_qualities_of_a_union_with_unequal_counts() -> None:
    """Nine tests of 0.1 and one of 0.9: the paper's mean of the maps' means is 0.5, maxitwo's mean of tests 0.18."""
    many = FeatureMap(id=M, cells={(1, 5): MapCell(tests=9, failures=0, probability=0.0, quality_loss=0.1)})
    one = FeatureMap(
        id=MapId.union(ON_B),
        cells={
            (1, 5): MapCell(tests=1, failures=1, probability=1.0, quality_loss=0.9),
            (2, 5): MapCell(tests=1, failures=1, probability=1.0, quality_loss=0.9),
        },
    )
    paper, pooled = union(M, [many, one]), union(M, [many, one], pooled_quality_loss=True)
    assert (paper.cells[1, 5].quality_loss, paper.cells[1, 5].pooled_quality_loss) == pytest.approx((0.5, 0.18))
    assert pooled.cells[1, 5].quality_loss == pytest.approx(0.18)
    # A cell that is empty in one map takes the other's values: empty is not 0.
    assert paper.cells[2, 5].quality_loss == pooled.cells[2, 5].quality_loss == 0.9
    assert paper.cells[1, 5].probability == pytest.approx(1 / 10)


def test_maps_of_different_features_do_not_mix() -> None:
    other = FeatureMap(id=MapId.union(ON_B), cells={}, features=DEFAULT_AXES[::-1])
    for combine in (union, merge):
        with pytest.raises(ValueError, match="different features"):
            combine(M, [FeatureMap(id=MapId.union(ON_A), cells={}), other])
        with pytest.raises(ValueError, match="no maps"):
            combine(M, [])


# Elites of the table: a0 and a3; b0, which failed before b1, and b3; c2, which failed while c0 did not, and c3.
ELITES = {"a0", "a3", "b0", "b3", "c2", "c3"}


def test_elites_of_the_hand_worked_campaign() -> None:
    assert elites_of(TESTS, EXECUTIONS, cells_of(TESTS, EXECUTIONS)) == ELITES
    # A search that continued without the outcome of a0 kept a1, the first of two equal ones.
    assert elites_of(TESTS, EXECUTIONS, cells_of(TESTS, EXECUTIONS), ignored={"a0"}) == ELITES - {"a0"} | {"a1"}


def test_migrated_elites_and_the_published_way() -> None:
    x, y = CELLS[X], CELLS[Y]
    chosen = build_maps(SIBLINGS, TWIN, TESTS, EXECUTIONS, MapPlan(elites_only=True))
    assert probabilities(chosen[MapId.search(ON_A)]) == {x: (3, pytest.approx(1 / 3)), y: (1, 0.0)}
    # a0 and b0 fail on a, c2 does not; of a3, b3 and c3 only c3 does.
    assert probabilities(chosen[MapId.union(ON_A)]) == {x: (3, pytest.approx(2 / 3)), y: (3, pytest.approx(1 / 3))}
    assert probabilities(chosen[MapId.union(ON_B)]) == {x: (3, pytest.approx(2 / 3)), y: (3, pytest.approx(1 / 3))}
    assert probabilities(chosen[MapId.twin(TWIN)]) == {x: (3, pytest.approx(2 / 3)), y: (3, 0.0)}
    assert probabilities(chosen[MapId.merged()])[x] == (3, pytest.approx(2 / 3 * 2 / 3 * 2 / 3))
    plan = MapPlan(elites_only=True, maxitwo_compatible=True, quality_loss="maximum")
    on_a = build_maps(SIBLINGS, TWIN, TESTS, EXECUTIONS, plan)[MapId.search(ON_A)].cells
    assert all(value.tests == 1 for value in on_a.values())
    assert on_a.keys() <= {(r.turns_count_maxitwo, int(100 * r.curvature)) for r in ROADS.values()}


@pytest.mark.parametrize(
    ("operator", "expected"),
    [("product", 0.02), ("minimum", 0.1), ("maximum", 0.5), ("mean", 1 / 3), ("weighted_mean", 0.32)],
)
def test_operators(operator: str, expected: float) -> None:
    """Values 0.5, 0.1 and 0.4 of 4, 4 and 2 tests; weighted (2 + 0.4 + 0.8) / 10 = 0.32."""
    assert apply(operator, [0.5, 0.1, 0.4], [4, 4, 2]) == pytest.approx(expected)
    assert apply(operator, [0.4, 0.5, 0.1], [2, 4, 4]) == apply(operator, [0.5, 0.1, 0.4], [4, 4, 2])


def test_jeffreys_interval_is_that_of_statsmodels() -> None:
    for failures, tests in ((1, 3), (5, 9), (30, 170), (2, 4)):
        assert jeffreys_interval(failures, tests) == pytest.approx(
            proportion_confint(failures, tests, method="jeffreys")
        )
    assert jeffreys_interval(0, 5)[0] == 0.0 and jeffreys_interval(5, 5)[1] == 1.0
    assert jeffreys_interval(0, 5)[1] == pytest.approx(proportion_confint(0, 5, method="jeffreys")[1])


def test_the_interval_of_a_product_is_that_of_its_distribution() -> None:
    """Against the distribution function of the product, integrated: P(A B <= z) = E[F_B(z / A)]."""
    counts = [(3, 9), (4, 9)]
    a, b = (beta(f + 0.5, n - f + 0.5) for f, n in counts)
    grid = (np.arange(20_000) + 0.5) / 20_000
    quantiles = a.ppf(grid)
    low, high = merged_interval("product", counts)
    for end, tail in ((low, 0.025), (high, 0.975)):
        assert float(np.mean(b.cdf(end / quantiles))) == pytest.approx(tail, abs=0.004)
    # Multiplying the ends of the siblings' intervals would give a far wider interval.
    assert high < jeffreys_interval(3, 9)[1] * jeffreys_interval(4, 9)[1] - 0.1
    assert merged_interval("product", counts[::-1]) == (low, high)
    assert merged_interval("product", [(0, 3), (2, 3)])[0] == 0.0
    assert merged_interval("product", [(3, 3), (3, 3)])[1] == 1.0


def test_the_authors_rules_on_the_same_counts() -> None:
    """Against the authors' rules by pandas: pooled unions, merges, -2 in empty cells, average precision."""
    rng = np.random.default_rng(3)
    names, where = ["a", "b", "twin"], [(i, j) for i in range(4) for j in range(5, 9)]
    rows: list[tuple[Any, ...]] = []
    for origin in "ab":
        for place in rng.choice(len(where), 9, replace=False):
            repeats, rate = range(rng.integers(1, 5)), rng.random()
            rows += [(origin, on, where[place], rng.random() < rate, rng.random()) for on in names for _ in repeats]
    drives = pd.DataFrame(rows, columns=["origin", "on", "cell", "failed", "quality"])

    def feature_map(origin: str, on: str) -> FeatureMap:
        cells: dict[Cell, MapCell] = {}
        for cell, group in drives[(drives.origin == origin) & (drives.on == on)].groupby("cell"):
            n, q = int(group.failed.sum()), float(group.quality.mean())
            cells[cell] = MapCell(
                tests=len(group), failures=n, probability=n / len(group), quality_loss=q, pooled_quality_loss=q
            )
        return FeatureMap(id=M, cells=cells)

    unions = {}
    for on in names:
        parts = [feature_map(origin, on) for origin in "ab"]
        unions[on] = union(MapId.union(SimulatorName(on)), parts, pooled_quality_loss=True)
        pooled = drives[drives.on == on].groupby("cell")[["failed", "quality"]].mean()
        assert {c: v.probability for c, v in unions[on].cells.items()} == pytest.approx(pooled.failed.to_dict())
        assert {c: v.quality_loss for c, v in unions[on].cells.items()} == pytest.approx(pooled.quality.to_dict())
    a, b, twin = (unions[name].cells for name in names)
    assert set(a) == set(b) == set(twin)
    rules = {
        "product": {c: a[c].probability * b[c].probability for c in a},
        "mean": {c: (a[c].probability + b[c].probability) / 2 for c in a},
        "weighted_mean": {
            c: (a[c].tests * a[c].probability + b[c].tests * b[c].probability) / (a[c].tests + b[c].tests) for c in a
        },
    }
    for operator, expected in rules.items():
        merged = merge(MapId.merged(), [unions["a"], unions["b"]], probability=operator)
        assert {c: v.probability for c, v in merged.cells.items()} == pytest.approx(expected)
        assert all(merged.cells[c].quality_loss == min(a[c].quality_loss, b[c].quality_loss) for c in a)
    # Correlation over the cells of both, and over the whole grid with -2 in empty cells.
    merged = merge(MapId.merged(), [unions["a"], unions["b"]])
    score, truth = ([m[c].probability for c in sorted(a)] for m in (merged.cells, twin))
    found = correlate(merged, unions["twin"], "probability")
    assert found.r == pytest.approx(np.corrcoef(score, truth)[0, 1])
    fails = np.array(truth) > 0
    assert found.auc == pytest.approx(average_precision_score(fails, score)) and found.baseline == fails.mean()
    maps = {MapId.union(ON_A): unions["a"], MapId.union(ON_B): unions["b"], MapId.merged(): merged}
    maps |= {MapId.search(SimulatorName(n)): feature_map(n, n) for n in "ab"}
    maps |= {MapId.migration(SimulatorName(n), TWIN): feature_map(n, "twin") for n in "ab"}
    checks = check_robustness({**maps, MapId.twin(TWIN): unions["twin"]}, [ON_A, ON_B], TWIN)

    def of_merged(what: str) -> RobustnessCheck:
        return next(v for v in checks if what in v.what and v.map == MapId.merged() and v.value == "probability")

    low, high = np.min(sorted(a), axis=0), np.max(sorted(a), axis=0)
    grid = [(i, j) for i in range(low[0], high[0] + 1) for j in range(low[1], high[1] + 1)]
    with_fillers = [[m[c].probability if c in m else -2.0 for c in grid] for m in (merged.cells, twin)]
    assert len(grid) > len(a) and of_merged("-2").cells == len(grid)
    assert of_merged("-2").r == pytest.approx(np.corrcoef(with_fillers[0], with_fillers[1])[0, 1])
    assert of_merged("above 0").cells == sum(s > 0 and t > 0 for s, t in zip(score, truth, strict=True))
    means = [rules["mean"][c] for c in sorted(a)]
    assert of_merged("merged by mean").r == pytest.approx(np.corrcoef(means, truth)[0, 1])


def test_what_merging_adds_is_a_difference_over_the_same_cells() -> None:
    """Against numbers and resamples drawn here; a cell that only one sibling fills does not count."""
    rng = np.random.default_rng(12)
    truth = np.round(rng.random(50) * (rng.random(50) < 0.5), 2)
    good, bad = (np.clip(truth + rng.normal(0, noise, 50), 0, 1) for noise in (0.2, 0.6))
    a, b, t = MapId.union(ON_A), MapId.union(ON_B), MapId.twin(TWIN)
    values = {a: [*good.tolist(), 1.0], b: bad.tolist(), t: [*truth.tolist(), 0.0]}
    unions = {map_id: replace(row(of_cells), id=map_id) for map_id, of_cells in values.items()}
    maps = {**unions, MapId.merged(): merge(M, [unions[a], unions[b]], probability="product")}
    over_a, over_b = (
        g for g in paired_differences(maps, [ON_A, ON_B], TWIN, resamples=400) if g.value == "probability"
    )
    merged = good * bad
    assert (over_a.over, over_b.over, over_a.cells, over_b.cells) == (a, b, 50, 50)

    def more(theirs: Array, k: Any = slice(None)) -> float:
        one, other = (np.corrcoef(m[k], truth[k])[0, 1] for m in (merged, theirs))
        return float(one - other)

    drawn = rng.integers(50, size=(4000, 50))
    for gain, theirs in ((over_a, good), (over_b, bad)):
        assert gain.r == pytest.approx(more(theirs))
        assert gain.r_interval == pytest.approx(np.quantile([more(theirs, k) for k in drawn], [0.025, 0.975]), abs=0.05)
        precisions = [average_precision_score(truth > 0, m) for m in (merged, theirs)]
        assert gain.auc == pytest.approx(precisions[0] - precisions[1])
    assert over_a.r is not None and over_b.r is not None and over_a.r < over_b.r
    # One sibling: no differences. A twin without failures: both numbers are undefined.
    assert paired_differences(maps, [ON_A], TWIN) == []
    safe = {**maps, MapId.twin(TWIN): row([0.0] * 50)}
    assert {(g.r, g.r_interval, g.auc, g.auc_interval) for g in paired_differences(safe, [ON_A, ON_B], TWIN)} == {
        (None,) * 4
    }


def test_a_feature_of_the_run_takes_the_run_on_the_sibling_that_generated_the_test() -> None:
    """The cell is the same on every simulator, whatever the steering there; without that run there is no cell."""

    def steered(test_id: str, simulator: str, commands: list[float]) -> Execution:
        execution = make_execution(test_id, simulator, 0.5)
        return replace(execution, drive=DriveArrays(np.full((3, 5), -0.257), np.array(commands)))

    tests = [make_test("a0", "a", X), make_test("b0", "b", X)]
    done = [steered("a0", "a", [0.5, -0.5]), steered("a0", "b", [0.1, 0.1]), steered("b0", "a", [0.2, -0.2])]
    plan = MapPlan(features=("steering_deviation", "mean_lateral_position:10", "turns_count"))
    maps = build_maps([ON_A, ON_B], None, tests, done, plan)
    cell = (50, 2, X)  # deviation 0.5; 25 cm in steps of ten
    assert set(maps[MapId.search(ON_A)].cells) == set(maps[MapId.migration(ON_A, ON_B)].cells) == {cell}
    assert set(maps[MapId.union(ON_A)].cells) == set(maps[MapId.union(ON_B)].cells) == {cell}
    assert not maps[MapId.search(ON_B)].cells and not maps[MapId.migration(ON_B, ON_A)].cells
    (sliced,) = slices_of(maps[MapId.union(ON_A)])
    assert sliced.features == tuple(map(feature_of, plan.features[:2])) and set(sliced.cells) == {(50, 2)}


def row(values: list[float]) -> FeatureMap:
    cells: dict[Cell, MapCell] = {
        (i, 5): MapCell(tests=1, failures=0, probability=v, quality_loss=1 - v) for i, v in enumerate(values)
    }
    return FeatureMap(id=M, cells=cells)


def test_auc_prc_has_the_bits_of_scikit_learn() -> None:
    rng = np.random.default_rng(1)
    for decimals in (1, 8):  # with equal predictions, and without
        for _ in range(50):
            predicted, truth = rng.random(60).round(decimals), np.maximum(rng.random(60) - 0.5, 0.0)
            assert auc_prc(predicted, truth) == average_precision_score(truth > 0.0, predicted)


@pytest.mark.parametrize(
    ("ours", "truth", "r", "auc"),
    [
        ([], [], "0 cells", "no cells"),
        ([0.1, 0.2], [0.0, 1.0], "2 cells", None),
        ([0.0, 0.5, 1.0], [0.0] * 3, "twin", "no cell"),
        ([0.1, 0.2, 0.3], [0.5, 1.0, 0.2], None, "every cell"),
        ([0.5] * 3, [0.0, 1.0, 0.0], "map", None),
    ],
)
def test_what_is_not_defined_says_why(ours: list[float], truth: list[float], r: str | None, auc: str | None) -> None:
    found = correlate(row(ours), row(truth), "probability")
    assert (found.r is None) is (found.p is None) is (r is not None) and (r or "") in found.reason
    assert (found.auc is None) is (auc is not None) and (auc or "") in found.auc_reason


T, TRICKY = map(SimulatorName, ("t", "path_to_x:Sim"))


def test_every_map_of_a_campaign_has_an_identity_of_its_own() -> None:
    ids = map_ids([SimulatorName("a"), SimulatorName("b")], T, ["mean"])
    migrations = "migration_a_to_b migration_a_to_t migration_b_to_a migration_b_to_t"
    names = f"search_a search_b {migrations} union_a union_b merged merged_mean twin_t"
    assert [map_id.name for map_id in ids] == names.split()
    assert len(set(ids)) == len(ids)
    assert [map_id.name for map_id in compared_ids(ids)] == ["union_a", "union_b", "merged", "twin_t"]


def test_an_interval_does_not_depend_on_the_order_of_the_operators(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean of 3 of 9 and 4 of 9 keeps the seed of the first version, its position in the list."""
    counts = [(3, 9), (4, 9)]
    before = {name: merged_interval(name, counts) for name in OPERATORS}
    algebra._merged_interval.cache_clear()
    monkeypatch.setattr(algebra, "OPERATORS", dict(reversed(list(OPERATORS.items()))))
    assert {name: merged_interval(name, counts) for name in OPERATORS} == before
    assert len({operator.seed for operator in OPERATORS.values()}) == len(OPERATORS)
    rng = np.random.default_rng([3, 3, 9, 4, 9])
    draws = rng.beta([[3.5], [4.5]], [[6.5], [5.5]], (2, algebra.DRAWS)).mean(axis=0)
    assert before["mean"] == pytest.approx(tuple(np.quantile(draws, [0.025, 0.975])), rel=1e-12)


def test_maps_as_a_frame() -> None:
    full = MapCell(tests=4, failures=1, probability=0.25, quality_loss=0.5, interval=(0.1, 0.6))
    bare = MapCell(tests=2, failures=None, probability=0.0, quality_loss=0.0)
    maps = {
        one.id: one
        for one in (
            FeatureMap(id=MapId.migration(TRICKY, T), cells={(3, 12): full, (2, 9): bare}, excluded={(3, 12): 2}),
            FeatureMap(id=MapId.merged(), cells={(2, 9): bare}),
            FeatureMap(id=MapId.twin(T), cells={}),
        )
    }
    frame = maps_frame(maps)
    columns = "map kind simulator origin operator turns_count curvature tests failures probability"
    assert list(frame.columns) == f"{columns} interval_low interval_high quality_loss excluded".split()
    places = frame[["kind", "turns_count", "curvature"]].to_numpy().tolist()
    assert places == [["migration", 2, 9], ["migration", 3, 12], ["merged", 2, 9]]
    row = frame.iloc[1]
    assert (row.origin, row.simulator, row.failures, row.interval_high) == (TRICKY, "t", 1, 0.6)
    assert frame.failures.isna().tolist() == [True, False, True] and frame.interval_low.isna().tolist()[0]
    assert frame.excluded.tolist() == [0, 2, 0]
    assert len(maps_frame({})) == 0
    other = FeatureMap(id=MapId.merged("mean"), cells={}, features=DEFAULT_AXES[::-1])
    with pytest.raises(ValueError, match="maps of different features"):
        maps_frame({**maps, other.id: other})
