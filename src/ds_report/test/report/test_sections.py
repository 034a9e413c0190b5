# SPDX-License-Identifier: Apache-2.0
"""The report's first screen, sections and pictures, and the page of imported outcomes."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from prediction_tables import real_drive
from report_campaigns import NOWHERE, campaign_data, make_execution, make_map, results, road

from ds_analysis.failures import FailureReason
from ds_analysis.outcomes.columns import Columns
from ds_analysis.outcomes.study import import_outcomes, write_study
from ds_analysis.real.records import write_drives
from ds_base.installation import ds_command
from ds_base.palette import FAIL, PASS, rgb
from ds_driver.control.autopilot import Autopilot
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_orchestrator.campaign.executor import execution_of
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import MapId, map_ids
from ds_orchestrator.search.features import feature_of
from ds_orchestrator.store.model import Origin, Test
from ds_report.build import write_report
from ds_report.camera_pictures import SIZE, drive_pictures, moments, plan_pictures, telling_tests
from ds_report.first_screen import first_screen
from ds_report.heatmap import EMPTY, Value, bounds_of, draw_map, write_maps
from ds_report.pages import render
from ds_report.sections import AnswerSection, answer_section, failure_section
from ds_report.study_page import write_study_page
from ds_sim import SOFTBODY, SimulatorName
from ds_sim.registry import BULLET, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Outcome


def data_of(folder: Path, config: CampaignConfig = NOWHERE, per_sibling: int = 8) -> CampaignData:
    return campaign_data(folder, config, per_sibling, roads=64)


def rows_of(section: AnswerSection) -> list[dict[str, Any]]:
    assert section.cells is not None
    return list(section.cells.document()["rows"])


def test_real_drives_are_marked_and_change_the_answer(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    before = answer_section(tmp_path, data)
    cells = rows_of(before)
    assert sum(cell["tests"] for cell in cells) == len(data.tests) == 16 and not any(cell["driven"] for cell in cells)
    counted = {name: sum(cell["verdict"] == name for cell in cells) for name in ("fails", "safe", "disputed")}
    said = re.findall(r"(\d+) (?:fails?,|(?:is|are) (?:safe|disputed))", before.sentence)
    assert [int(n) for n in said] == [*counted.values()]
    assert "a:One, b:Two and c:Three without a real drive" in before.sentence and "Framed" not in before.reading
    chosen = data.tests[3].test_id
    write_drives(tmp_path, [real_drive(chosen, failed=True)])
    after = answer_section(tmp_path, data)
    (marked,) = (cell for cell in rows_of(after) if cell["driven"])
    labels = [feature_of(name).label(bin_) for name, bin_ in zip(NOWHERE.features, data.cells[chosen], strict=True)]
    assert [marked[name] for name in NOWHERE.features] == labels and after.picture != before.picture
    assert "The car drove 1 test and failed 1" in after.sentence
    (same,) = (cell for cell in cells if [cell[name] for name in NOWHERE.features] == labels)
    assert marked["failure rate"] > same["failure rate"]


def test_the_page_has_the_car_after_the_maps(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    write_drives(tmp_path, [real_drive(data.tests[0].test_id, failed=False)])
    section = answer_section(tmp_path, data)
    html = write_report(tmp_path, data, *results(data), answer=section).read_text()
    assert html.index('id="finding"') < html.index('id="maps"') < html.index('id="answer"')
    part = html[html.index('id="answer"') : html.index('id="comparison"')]
    assert section.picture in part and part.count("<tr>") == len(rows_of(section)) + 1


def test_a_campaign_without_a_twin_has_an_answer(tmp_path: Path) -> None:
    data = data_of(tmp_path, NOWHERE.model_copy(update={"twin": None}))
    section = answer_section(tmp_path, data)
    assert section.picture and "predicted from a:One and b:Two without" in section.sentence
    html = write_report(tmp_path, data, *results(data), answer=section).read_text()
    command = ds_command("real", "propose", tmp_path)
    assert f"`{command}`" in section.reading and f"<code>{command}</code>" in html
    assert "`" not in html[html.index('id="answer"') : html.index('id="comparison"')]


@pytest.mark.parametrize("what", ["few", "damaged", "foreign"])
def test_without_an_answer_the_section_says_why(tmp_path: Path, what: str) -> None:
    data = data_of(tmp_path, per_sibling=2 if what == "few" else 8)
    if what == "damaged":
        write_drives(tmp_path, [])
        (tmp_path / "real" / "drives.json").write_text("{")
    if what == "foreign":
        write_drives(tmp_path, [real_drive("panda-0-0000", failed=True)])
    section = answer_section(tmp_path, data)
    problem = {"few": "expected at least 10", "damaged": "drives.json", "foreign": "of no test here"}[what]
    assert not section.picture and problem in section.sentence and section.sentence.startswith("No prediction")
    assert section.sentence[:30] in write_report(tmp_path, data, *results(data), answer=section).read_text()


def test_groups_count_every_failure_once_and_link_to_a_test_of_their_own(tmp_path: Path) -> None:
    config = CampaignConfig(siblings=[BULLET, SOFTBODY], twin=None, driver=AUTOPILOT)
    data = campaign_data(tmp_path, config, 6, roads=12)
    section = failure_section(data)
    assert section is not None
    failed = {(e.test_id, e.simulator) for e in data.executions if e.outcome.is_failure}
    sizes = [failures for failures, *_ in section.groups]
    assert sum(sizes) == len(failed) and sizes == sorted(sizes, reverse=True)
    assert f"{sizes[0]} of {len(failed)} failures" in section.sentences[0]
    for failures, where, worst, address in section.groups:
        assert (worst.test_id, worst.simulator) in failed
        assert sum(int(words.split()[0]) for words in where.split(", ")) == failures
        assert "-".join(map(str, data.cells[worst.test_id])) in address
    html = render("failures.html.j2", failures=section)
    linked = re.findall(r'href="#cell=[-\d]+&amp;test=([^"]+)"', html)
    assert linked == [worst.test_id for _, _, worst, _ in section.groups]


@pytest.mark.parametrize(("wide", "said"), [(14, "Most often (14 of 16 failures), the driver wide."), (9, "No way of")])
def test_the_most_frequent_way_of_failing_is_named_only_if_it_leads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wide: int, said: str
) -> None:
    config = CampaignConfig(siblings=[BULLET], twin=None, driver=AUTOPILOT)
    data = campaign_data(tmp_path, config, 16, roads=16)
    kinds = ["wide"] * wide + ["cuts"] * (16 - wide)
    made = [FailureReason(test.test_id, BULLET, kind, "") for test, kind in zip(data.tests, kinds, strict=True)]
    monkeypatch.setattr("ds_report.sections.reasons_of", lambda data: made)
    section = failure_section(data)
    assert section is not None and section.sentences[0].startswith(said)


HOSTILE = "<script>alert(1)</script>"


def table(folder: Path, tests: int) -> Path:
    rng = np.random.default_rng(3)
    speed, curve = rng.uniform(5, 20, tests), rng.uniform(0, 0.2, tests)
    rows = [
        (test, simulator, int(speed[test] * level > 12), speed[test], curve[test])
        for test in range(tests)
        for simulator, level in ((HOSTILE, 1.0), ("other", 1.2), ("car", 0.9))
    ]
    frame = pd.DataFrame(rows, columns=["test_id", "simulator", "failed", "speed", "curve"])
    frame.to_csv(folder / "t.csv", index=False)
    return folder / "t.csv"


def test_a_page_says_where_each_simulator_fails_and_runs_nothing(tmp_path: Path) -> None:
    study = import_outcomes([table(tmp_path, 60)], Columns(twin=SimulatorName("car")))
    write_study(tmp_path, study)
    text = write_study_page(tmp_path, study).read_text()
    assert HOSTILE not in text and "&lt;script&gt;" in text and "default-src 'none'" in text
    assert "where speed is " in text and "did not choose this threshold" in text
    assert "real propose" in text and text.count("data:image/png") == 5
    assert "predicted without driving it" in text  # predictors are scored on the twin
    assert write_study_page(tmp_path, study).read_text() == text
    few = write_study_page(tmp_path, import_outcomes([table(tmp_path, 4)], Columns())).read_text()
    assert "expected at least 10" in few and "What was read" in few


def with_outcomes(folder: Path, config: CampaignConfig, failing: dict[str, set[int]]) -> CampaignData:
    """A campaign of 16 roads, in which each simulator fails exactly the given ones, by position."""
    tests = 16 // len(config.siblings)
    config = config.model_copy(update={"search": SearchConfig(population=tests - 1, iterations=1, runs=1)})
    data = campaign_data(folder, config, tests, roads=16)
    place = {test.test_id: k for k, test in enumerate(data.tests)}
    executions = []
    for one in data.executions:
        failed = place[one.test_id] in failing[one.simulator]
        outcome = Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED
        executions.append(replace(one, outcome=outcome, fitness=-0.1 if failed else 1.0))
    return replace(data, executions=tuple(executions))


@pytest.mark.parametrize(
    ("of_one", "of_twin", "said"),
    [
        (10, 9, "with a:One in 9 and with b:Two in 1: where it has not driven, believe a:One"),
        (8, 4, "with a:One in 4 and with b:Two in 4: too few or too mixed"),
    ],
)
def test_the_sibling_that_does_as_the_twin_more_often_is_believed(
    tmp_path: Path, of_one: int, of_twin: int, said: str
) -> None:
    failing = {"a:One": set(range(of_one)), "b:Two": set(), "c:Three": set(range(of_twin))}
    first = first_screen(with_outcomes(tmp_path, NOWHERE, failing))
    assert f"disagree on {of_one} of 16 tests" in first.believe and said in first.believe
    assert first.worst and "--failed" in first.command


def test_without_a_twin_nobody_is_believed(tmp_path: Path) -> None:
    config = NOWHERE.model_copy(update={"twin": None})
    first = first_screen(with_outcomes(tmp_path, config, {"a:One": {0, 1}, "b:Two": {1}}))
    assert "only drives on a twin or on your car can say" in first.believe and first.command == "ds real propose ."


ALL_FAIL = "of which the twin fails all, and missed none of the 16 failures"


@pytest.mark.parametrize(
    ("failing", "where", "said", "command"),
    [
        (set(), "none of 16 roads", "completed all 16 tests, and the twin c:Three failed none.", "--min-angle 200"),
        (set(range(16)), "all 16 roads", f"failed 16 of 16 tests, {ALL_FAIL}", "--max-angle 60"),
    ],
)
def test_campaigns_in_which_all_or_nothing_fails_read_as_such(
    tmp_path: Path, failing: set[int], where: str, said: str, command: str
) -> None:
    first = first_screen(with_outcomes(tmp_path, NOWHERE, dict.fromkeys(NOWHERE.simulators, failing)))
    assert f"failed on {where}" in first.where and command in first.command
    assert "The siblings a:One and b:Two agree on all 16 tests: they " in first.believe and said in first.believe


ALONE = NOWHERE.model_copy(update={"siblings": ["a:One"]})
UNTWINNED = ALONE.model_copy(update={"twin": None})
ONE_MISSED = "of which the twin fails 2, and missed 1 of the 3 failures"
MISSED = "completed all 16 tests and missed every one of the"
PAIR = "The siblings a:One and b:Two agree on all 16 tests: they "


@pytest.mark.parametrize(
    ("config", "of_siblings", "of_twin", "said"),
    [
        (ALONE, set(), {1, 2, 3}, f"a:One {MISSED} 3 failures that the twin c:Three"),
        (ALONE, {1, 2, 3}, {1, 2, 9}, f"a:One failed 3 of 16 tests, {ONE_MISSED}"),
        (NOWHERE, set(), {4}, f"{PAIR}{MISSED} 1 failure that the twin c:Three"),
        (NOWHERE, {4}, set(), f"{PAIR}failed 1 of 16 tests, and the twin c:Three failed none."),
        (UNTWINNED, {4}, None, "a:One failed 1 of 16 tests; only drives on a twin or on your"),
    ],
)
def test_siblings_that_never_disagree_are_measured_by_the_twin(
    tmp_path: Path, config: CampaignConfig, of_siblings: set[int], of_twin: set[int] | None, said: str
) -> None:
    failing = dict.fromkeys(config.siblings, of_siblings) | ({} if of_twin is None else {"c:Three": of_twin})
    assert first_screen(with_outcomes(tmp_path, config, failing)).believe.startswith(said)


def test_a_road_that_was_driven_twice_counts_once(tmp_path: Path) -> None:
    data = with_outcomes(tmp_path, NOWHERE, {"a:One": set(range(10)), "b:Two": set(), "c:Three": set(range(9))})
    again = replace(data.tests[0], test_id="a-0-0099")
    drives = [replace(one, test_id="a-0-0099") for one in data.executions if one.test_id == data.tests[0].test_id]
    repeated = replace(data, tests=(*data.tests, again), executions=(*data.executions, *drives))
    assert first_screen(repeated).believe == first_screen(data).believe
    assert first_screen(repeated).where == first_screen(data).where


def test_an_unfinished_campaign_is_to_be_finished(tmp_path: Path) -> None:
    data = with_outcomes(tmp_path, NOWHERE, {name: {0} for name in NOWHERE.simulators})
    assert first_screen(replace(data, executions=data.executions[:-3])).command == "ds campaign resume ."


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
