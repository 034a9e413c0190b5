# SPDX-License-Identifier: Apache-2.0
"""Pictures of a report: of drives, equal to the simulator's images, and of feature maps, with reproducible bytes."""

from __future__ import annotations

import base64
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from report_campaigns import make_execution, road

from ds_base.palette import FAIL, PASS, rgb
from ds_driver.control.autopilot import Autopilot
from ds_orchestrator.campaign.executor import execution_of
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId, map_ids
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Origin, Test
from ds_report.camera_pictures import SIZE, drive_pictures, moments, plan_pictures, telling_tests
from ds_report.heatmap import EMPTY, Value, bounds_of, draw_map, write_maps
from ds_sim import SimulatorName
from ds_sim.registry import BULLET, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import Session

TEST = Test("t", Scenario(road(0), seed=1), Origin(BULLET, 0, 0))


def test_pictures_are_what_the_simulator_has_shown() -> None:
    """Rendered from the path alone, they equal the frames of the drive except for noise and the body's small tilts."""
    session = Session(make_simulator("bullet"))
    autopilot = Autopilot(session.simulator.spec.autopilot)
    seen = session.start(TEST.scenario)
    assert seen is not None
    images = [seen.image]
    while session.driving and seen.step < 120:
        seen = session.advance(autopilot.command(seen.lane.preview_lateral_position, seen.vehicle.speed))
        assert seen is not None
        images.append(seen.image)
    assert session.run is not None
    execution = execution_of(TEST.test_id, BULLET, session.run)
    nowhere = SimulatorName("nowhere:A")
    frames = {("t", BULLET): moments(execution), ("t", nowhere): [0]}
    driven = [execution, make_execution(TEST, nowhere, 1.0)]
    drives, again = (drive_pictures([BULLET, nowhere], [TEST], driven, frames=frames) for _ in range(2))
    drive, none = drives["t"]
    assert drive is not None and none is not None and "not shipped" in none.note and not none.frames
    assert drives == again
    assert drive.times == tuple(step / 20 for step in moments(execution)) and drive.strip == (0, 1, 2, 3, 4)
    for (text, words), step in zip(drive.frames, moments(execution), strict=True):
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        shown = picture[..., ::-1].astype(float)
        real = cv2.resize(images[step], SIZE, interpolation=cv2.INTER_AREA)
        other = cv2.resize(images[(step + 60) % len(images)], SIZE, interpolation=cv2.INTER_AREA)
        error = np.abs(shown - real).mean()
        assert error < 8 and error < np.abs(shown - other).mean() / 1.5, (step, error)
        assert words.startswith(f"{step / 20:.1f} s, ")


def test_moments_cover_a_drive_or_lead_to_its_failure() -> None:
    completed, failed = make_execution(TEST, "bullet", 1.0), make_execution(TEST, "bullet", 2.5)
    last = len(completed.trajectory) - 1
    assert moments(completed) == [0, *(round(last * k / 4) for k in (1, 2, 3)), last]
    end = len(failed.trajectory) - 1
    assert moments(failed) == [end - 80, end - 60, end - 40, end - 20, end]


def test_the_worst_of_every_cell_comes_first() -> None:
    tests = [Test(f"t{k}", Scenario(road(0), seed=1), Origin(SimulatorName("A"), 0, k)) for k in range(6)]
    cells = {"t0": (1,), "t1": (1,), "t2": (2,), "t3": (1,), "t4": (3,)}
    offsets = {"t0": 0.5, "t1": 2.2, "t2": 0.3, "t3": 2.4, "t4": 1.0, "t5": 2.5}
    driven = [make_execution(test, "A", offsets[test.test_id]) for test in tests]
    driven.append(make_execution(tests[1], "B", 2.1))

    def chosen(most: int) -> list[str]:
        return [test.test_id for test in telling_tests(tests, driven, cells, most=most)]

    # t1 fails on two simulators, t4 comes closer to the edge than t2, t3 failed too; t5 has no cell.
    order = ["t1", "t4", "t2", "t3"]
    for most in (0, 1, 2, 3, 4, 9):
        assert chosen(most) == sorted(order[:most])


def test_replays_show_failed_drives_first_and_stay_within_their_bound() -> None:
    tests = [Test(f"t{k}", Scenario(road(k), seed=1), Origin(SimulatorName("A"), 0, k)) for k in range(4)]
    cells = {test.test_id: (k,) for k, test in enumerate(tests)}
    offsets = {"A": (2.4, 0.5, 2.2, 0.4), "B": (0.5, 0.6, 2.5, 0.3)}
    driven = [make_execution(test, name, offsets[name][k]) for name in "AB" for k, test in enumerate(tests)]
    frames_of = {(e.test_id, e.simulator): len(e.trajectory) for e in driven}
    failed = [("t2", "A"), ("t2", "B"), ("t0", "A")]
    # Every drive's last frame, those before it at the spacing, and its first one.
    needed = {s: sum(1 + -(-(frames_of[drive] - 1) // s) for drive in failed) for s in (10, 20, 40)}

    plan = plan_pictures(tests, driven, cells, strips=0)
    # With room for all: every drive of a test that fails somewhere, and no other, ten frames apart up to its last one.
    assert set(plan.frames) == {*failed, ("t0", "B")} and (plan.replayed, plan.failed, plan.spacing) == (3, 3, 0.5)
    for drive, frames in plan.frames.items():
        last = frames_of[drive] - 1
        assert set(range(last, -1, -10)) <= set(frames) and frames[-1] == last
    # The bound makes pictures coarser before it leaves drives out.
    assert plan_pictures(tests, driven, cells, strips=0, replays=needed[10]).spacing == 0.5
    coarser = plan_pictures(tests, driven, cells, strips=0, replays=needed[10] - 1)
    assert (coarser.spacing, coarser.replayed) == (1.0, 3)
    least = plan_pictures(tests, driven, cells, strips=0, replays=needed[40] - 1)
    assert (least.spacing, least.replayed, set(least.frames)) == (2.0, 2, {("t2", "A"), ("t2", "B")})
    none = plan_pictures(tests, driven, cells, strips=1, replays=0)
    assert (none.replayed, none.strips) == (0, 1) and set(none.frames) == {("t2", "A"), ("t2", "B")}


A, T = map(SimulatorName, "at")
BOUNDS = range(2, 5), range(17, 14, -1)


def make_map(map_id: MapId, cells: dict[tuple[int, int], tuple[float, float]]) -> FeatureMap:
    made: dict[Cell, MapCell] = {
        cell: MapCell(tests=2, failures=None, probability=probability, quality_loss=quality)
        for cell, (probability, quality) in cells.items()
    }
    return FeatureMap(id=map_id, cells=made)


def pixels_of(image: NDArray[np.uint8], colour: tuple[int, int, int]) -> NDArray[np.intp]:
    """(n, 2) rows and columns."""
    return np.argwhere((image == colour).all(axis=2))


def test_a_cell_stands_where_its_features_say_and_an_empty_one_is_not_zero() -> None:
    def drawn(probability: float, quality: float, value: Value = "probability") -> NDArray[np.uint8]:
        return draw_map(make_map(MapId.merged(), {(2, 15): (probability, quality)}), value, bounds=BOUNDS)

    red, grey = pixels_of(drawn(1.0, 0.0), rgb(FAIL)), pixels_of(drawn(1.0, 0.0), EMPTY)
    assert len(red) > 500 and len(grey) > 8 * 500
    # Fewest turns: the left column. Smallest curvature: the lowest row. The colour bar is further right.
    in_grid = red[red[:, 1] < grey[:, 1].mean()]
    assert in_grid[:, 1].max() < np.percentile(grey[:, 1], 50) and in_grid[:, 0].min() > np.percentile(grey[:, 0], 50)
    assert len(pixels_of(drawn(0.0, 0.0), rgb(PASS))) > 500
    assert len(pixels_of(drawn(0.0, 0.0), EMPTY)) == len(grey)
    assert len(pixels_of(drawn(0.0, 1.0, "quality_loss"), rgb(FAIL))) > 500


def test_excluded_tests_are_written_beside_and_in_cells_of_their_own() -> None:
    plain = make_map(MapId.union(A), {(3, 16): (0.0, 1.0)})
    apart = replace(plain, excluded={(3, 16): 2, (2, 17): 4, (4, 18): 1})
    bounds = bounds_of([apart])
    assert bounds == (range(2, 5), range(18, 15, -1))
    without, drawn = (draw_map(m, "probability", bounds=bounds) for m in (plain, apart))
    without = np.pad(without, ((0, 0), (0, drawn.shape[1] - without.shape[1]), (0, 0)), constant_values=255)
    changed = (without != drawn).any(axis=2)
    # Three cells, below the heading, which says what the numbers are; no colour of a probability changes.
    boxes = cv2.connectedComponents(cv2.dilate(changed[60:].astype(np.uint8), np.ones((9, 25))))[0] - 1
    assert boxes == 3 and changed[:60].any()
    assert pixels_of(drawn, rgb(PASS)).shape[0] > 0.9 * pixels_of(without, rgb(PASS)).shape[0]


def test_write_maps_writes_every_map_and_the_overview_with_equal_bytes(tmp_path: Path) -> None:
    ids = map_ids([A, SimulatorName("my:Sim")], T)
    names = [map_id.name for map_id in ids]
    maps = {map_id: make_map(map_id, {(3, 10 + k): (k / 9, 1 - k / 9)}) for k, map_id in enumerate(ids)}
    for folder in ("one", "two"):
        write_maps(maps, tmp_path / folder)
    written = {path.name: path.read_bytes() for path in (tmp_path / "one").iterdir()}
    files = [n if ":" not in n else f"{n.replace(':', '.')}-{sha256(n.encode()).hexdigest()[:8]}" for n in names]
    expected = {f"{n}_{v}.png" for n in files for v in ("probability", "quality")} | {"overview.png"}
    assert set(written) == expected
    assert written == {path.name: path.read_bytes() for path in (tmp_path / "two").iterdir()}
    single = cv2.imdecode(np.frombuffer(written["merged_quality.png"], np.uint8), cv2.IMREAD_COLOR)
    overview = cv2.imdecode(np.frombuffer(written["overview.png"], np.uint8), cv2.IMREAD_COLOR)
    assert single is not None and overview is not None
    # Two unions, the merge and the twin in two rows.
    assert overview.shape[0] == 2 * single.shape[0] and overview.shape[1] >= 4 * single.shape[1] - 100
    bounds = bounds_of(maps.values())
    drawn = cv2.cvtColor(draw_map(maps[MapId.merged()], "quality_loss", bounds=bounds), cv2.COLOR_RGB2BGR)
    np.testing.assert_array_equal(single, drawn)
