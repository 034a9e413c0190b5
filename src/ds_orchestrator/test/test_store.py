# SPDX-License-Identifier: Apache-2.0
"""What a campaign keeps in its store, what machines must share to go on with it, and how long it still takes."""

from __future__ import annotations

import heapq
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_executions import made_execution

from ds_base.folder_files import StoreError
from ds_driver.networks import network_driver
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator import executables
from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.folder import BACKEND, DRIVER_SHA256, CampaignData, record_provenance
from ds_orchestrator.campaign.status import DRIVES_SAMPLED, driver_habits
from ds_orchestrator.campaign.time_left import TimedListener
from ds_orchestrator.engines import fingerprint as module
from ds_orchestrator.engines.fingerprint import PROCESSOR_FEATURES, differences, fingerprint
from ds_orchestrator.store.model import DriveArrays, Origin, Test
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store, seconds_of
from ds_road import Road, generate
from ds_sim import BULLET, DONKEY, PANDA, SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome, SimulatorError
from ds_sim_panda import simulator as panda

FOG = Conditions(visibility=50.0)


def test_stages_add_up_over_sessions(tmp_path: Path) -> None:
    store = Store(tmp_path / "campaign.sqlite", config="{}")
    for stage, seconds in (("search", 2.5), ("twin", 7.5), ("search", 1.0)):
        store.add_seconds(stage, seconds)
    store.note("another fact", "3")
    assert seconds_of(store.notes()) == {"twin": 7.5, "search": 3.5}


def test_a_stored_test_keeps_its_road_its_conditions_and_its_origin_if_a_search_made_it(tmp_path: Path) -> None:
    """A road has a lane, a width and a form."""
    sampled = Road.from_road_points([(0, 0), (0, 20), (5, 40)], lane_width=3.5, lane="left")
    tests = [
        Test("any-name", Scenario(sampled, FOG, seed=7)),
        Test("t-1", Scenario(Road([(125, 25 * k) for k in range(5)], maxitwo_compatible=True), seed=0)),
        Test("a-1-0002", Scenario(sampled, seed=8), Origin(SimulatorName("a"), 1, 2)),
    ]
    with closing(Store(tmp_path / "drives.sqlite", config="{}")) as store:
        for test in tests:
            store.add_test(test)
        assert store.tests() == tests


def test_a_full_disk_is_said_and_what_was_stored_stays(tmp_path: Path) -> None:
    with closing(Store(tmp_path / "campaign.sqlite", config="{}")) as store:
        store.note("kept", "1")
        store._file.ask("PRAGMA max_page_count=1")  # which SQLite raises to the present size
        with pytest.raises(StoreError, match="cannot grow, the disk is full: make room, and give the same command ag"):
            store.note("long", "x" * 100_000)
        assert store.notes().keys() == {"config", "kept"}


def test_a_repeated_scenario_is_left_out_with_its_drives() -> None:
    one, other = (generate(np.random.default_rng(seed)) for seed in (1, 2))
    tests = tuple(
        Test(f"bullet-0-{k:04d}", Scenario(road, under, seed=k), Origin(BULLET, 0, k))
        for k, (road, under) in enumerate([(one, DEFAULT), (other, DEFAULT), (one, DEFAULT), (one, FOG), (one, FOG)])
    )
    executions = tuple(made_execution(test.test_id, BULLET, Outcome.COMPLETED) for test in tests)
    data = CampaignData(config=CampaignConfig(), tests=tests, executions=executions, given_up=frozenset({"x"}))
    assert [test.number for test in data.distinct.tests] == [0, 1, 3]
    assert [one.test_id[-1] for one in data.distinct.verdicts] == ["0", "1", "3"]
    assert data.distinct.distinct is data.distinct and not data.distinct.given_up


FRAMES = 40


def store_of(folder: Path, tests: int, factor: float, speed: float) -> Store:
    """Make a campaign whose driver answers a wave times a factor, clipped, at a constant speed."""
    store = Store(folder / "campaign.sqlite", config=CampaignConfig().identity())
    steering = np.clip(factor * np.sin(np.linspace(0.0, 6.0, FRAMES)), -1.0, 1.0)
    trajectory = np.zeros((FRAMES + 1, 5))
    trajectory[:, 3] = speed
    road = generate(np.random.default_rng(1))
    for number in range(tests):
        test = Test(f"bullet-0-{number:04d}", Scenario(road, seed=1), Origin(BULLET, 0, number))
        store.add_test(test)
        drive = DriveArrays(trajectory, steering)
        for simulator in ("bullet", "donkey"):
            made = made_execution(test.test_id, simulator, Outcome.COMPLETED, steps=FRAMES, drive=drive)
            store.add_execution(replace(made, trajectory_sha256=trajectory_sha256(trajectory)))
    return store


@pytest.mark.parametrize(
    ("factor", "speed", "kinds"),
    [(0.3, 7.0, []), (25.0, 7.0, ["saturated"]), (0.0, 7.0, ["constant"]), (0.3, 0.4, ["crawls"])],
)
def test_names_the_habits_of_the_driver(tmp_path: Path, factor: float, speed: float, kinds: list[str]) -> None:
    assert [habit.kind for habit in driver_habits(store_of(tmp_path, 2, factor, speed))] == kinds


def test_counts_that_go_still_count(tmp_path: Path) -> None:
    store = store_of(tmp_path, 3, 0.3, 7.0)
    with pytest.deprecated_call():
        assert store.outcome_counts() == {("bullet", "COMPLETED"): 3, ("donkey", "COMPLETED"): 3}
    with pytest.deprecated_call():
        assert store.failures_of_groups() == {(BULLET, 0, BULLET): (0, 3), (BULLET, 0, DONKEY): (0, 3)}


def test_decodes_a_bounded_sample_of_both_simulators(tmp_path: Path) -> None:
    store = store_of(tmp_path, 60, 0.3, 7.0)
    sample = store.sampled_executions(DRIVES_SAMPLED)
    assert DRIVES_SAMPLED / 2 < len(sample) <= DRIVES_SAMPLED
    assert {one.simulator for one in sample} == {"bullet", "donkey"}
    assert {int(one.test_id[-4:]) // 15 for one in sample} == {0, 1, 2, 3}


def test_says_nothing_about_a_campaign_without_drives(tmp_path: Path) -> None:
    assert driver_habits(store_of(tmp_path, 0, 0.3, 7.0)) == ()


def test_the_renderer_counts_where_panda_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    here = fingerprint("", (BULLET, PANDA))
    assert here["renderer"].startswith("Mesa ") and differences(here, here) == ""

    def missing() -> str:
        raise SimulatorError("libEGL.so.1 is missing")

    monkeypatch.setattr(panda, "graphics", missing)
    assert differences(here, fingerprint("", (PANDA,))) == f"renderer absent there, {here['renderer']} here"
    assert not {"renderer", "panda3d"} & set(fingerprint("onnx", (BULLET, DONKEY)))


def test_code_that_is_not_shipped_counts_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "own_car.py"
    file.write_text("from ds_sim_softbody.simulator import SoftbodySimulator\n\nclass Car(SoftbodySimulator): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    simulators = (SimulatorName("own_car:Car"), BULLET)
    here = fingerprint("", simulators)
    file.write_text(file.read_text() + "# changed\n")
    assert differences(here, fingerprint("", simulators)).startswith("code of own_car ")
    assert fingerprint("", (SimulatorName("nobody:Car"),))["simulator nobody:Car"] == "absent"


def test_a_difference_in_processor_features_names_only_what_one_side_lacks() -> None:
    here, there = {"processor features": "avx avx2 fma"}, {"processor features": "avx fma sve"}
    assert differences(here, there) == "processor features without avx2 and with sve"


def test_only_processor_features_that_round_the_networks_back_end_count(tmp_path: Path) -> None:
    """A newer processor with AVX-512 gives the same bits, also where its formats for networks are others."""
    older, newer, arm = (tmp_path / name for name in ("older", "newer", "arm"))
    older.write_text("flags\t\t: sse2 fma avx2 avx512f avx512vl avx512_bf16\n")
    newer.write_text("flags\t\t: sse2 fma avx2 avx512f avx512vl avx512_vp2intersect avx_vnni\n")
    arm.write_text("Features\t: asimd sve\n")
    features = module._processor_features
    assert features("onnx", older) == features("", newer) == "avx2 avx512f avx512vl fma"
    assert features("openvino-bf16", older) != features("openvino-bf16", newer)
    assert features("onnx", arm) == "asimd sve"
    assert fingerprint("onnx", ())[PROCESSOR_FEATURES] == features("onnx")


def test_the_libraries_of_a_networks_back_end_count() -> None:
    known = fingerprint("openvino-bf16", ()).keys()
    assert "openvino" in known and "onnxruntime" not in known


@pytest.mark.parametrize(
    ("driver", "begun", "driven"),
    [
        ("dave2", None, "dave2@openvino"),
        ("dave2", "openvino", "dave2@openvino"),
        ("dave2", "", "dave2@onnx"),  # by a version that recorded none
        ("residual", "", "residual@onnx"),
        ("dave2@openvino", "", "dave2@openvino"),
        ("autopilot", "", "autopilot"),
    ],
)
def test_a_campaign_resumes_on_the_back_end_on_which_it_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driver: str, begun: str | None, driven: str
) -> None:
    config = parse_config({"driver": driver}, "here")
    settings = config.drive_settings()
    with closing(Store(tmp_path / "campaign.sqlite", config=config.identity())) as store:
        if begun is not None and driver != "autopilot":
            store.note(DRIVER_SHA256, network_driver.driver_sha256(config.driver))
        if begun:
            store.note(BACKEND, begun)
        assert record_provenance(store, settings, tmp_path) == replace(settings, driver=DriverName.parse(driven))
        monkeypatch.setattr(network_driver, "default_backend", lambda: "torch")
        assert record_provenance(store, settings, tmp_path).driver == DriverName.parse(driven)
        assert CampaignData(config=config, notes=store.notes()).driver == DriverName.parse(driven)
        assert (BACKEND in store.notes()) == (driven != driver)


def test_an_executable_of_a_package_that_is_not_built_says_how_to_build_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executables, "ABOVE", "not_built.ros.executables")
    said = "orchestrator: not_built is not in this workspace.*--packages-up-to ds_bringup"
    with pytest.raises(SystemExit, match=said):
        executables.orchestrator()


A, FAST, LONG, QUICK, SLOW, TWIN = map(SimulatorName, ("a", "fast", "long", "quick", "slow", "twin"))

TOOK = {FAST: 2.0, SLOW: 5.0, TWIN: 3.0}
STAGES = [{FAST: 40, SLOW: 40}, {FAST: 40, SLOW: 40, TWIN: 80}]
WHOLE = 40 * 5.0 + 80 * 3.0


SCENARIO = Scenario(Road([[0, 0], [0, 25], [0, 50], [0, 75]]), seed=1)


class Left(TimedListener):
    """Estimate with a clock that a test sets."""

    def __init__(self, *stages: dict[SimulatorName, int]) -> None:
        super().__init__(lambda: self.clock)
        self.clock = 0.0
        self.expect(stages)
        self.stage("first")

    def end(self, stage: int, simulator: SimulatorName, *, fresh: bool = True) -> None:
        origin = Origin(SimulatorName("another") if stage else simulator, 0, 0)
        self.finished(Test("t", SCENARIO, origin), simulator, None, fresh)

    def at(self, clock: float, *drives: tuple[SimulatorName, float, float | None]) -> float | None:
        self.clock = clock
        return self.seconds_left(drives)


def estimates(known: int) -> list[tuple[float, float]]:
    """Pair the true seconds left at the end of each execution with the estimate, in order.

    A previous session has finished the first `known` executions of the first stage on each simulator.
    """
    left, said = Left(*STAGES), []
    for number, stage in enumerate(STAGES):
        now = left.clock
        left.stage("next")
        ends = []
        for name, count in stage.items():
            before = known if number == 0 else 0
            for _ in range(before):
                left.end(number, name, fresh=False)
            ends += [(now + TOOK[name] * (k + 1), name) for k in range(count - before)]
        heapq.heapify(ends)
        while ends:
            left.clock, name = heapq.heappop(ends)
            left.end(number, name)
            said.append((left.clock, left.seconds_left() or 0.0))
    return [(left.clock - moment, seconds) for moment, seconds in said]


@pytest.mark.parametrize("known", [0, 30])
def test_it_is_right_in_every_stage_and_after_a_resume(known: int) -> None:
    found = estimates(known)
    assert found[0][0] == pytest.approx(WHOLE - known * 5.0 - 2.0)
    for true, said in found[4:]:
        # The twin is assumed to be as fast as the others until it has driven; nothing is assumed afterwards.
        assert said == pytest.approx(true, abs=0.2 * true + 5.0)
    afterwards = [pair for pair in found if pair[0] < 80 * 3.0 - 6.0]
    assert len(afterwards) > 100
    for true, said in afterwards:
        assert said == pytest.approx(true, abs=5.0)


def test_it_follows_a_machine_that_becomes_slower_and_says_nothing_at_first() -> None:
    left = Left({A: 200})
    left.end(0, A, fresh=False)
    assert left.at(0.0) is None
    for took in [1.0] * 50 + [4.0] * 50:
        left.clock += took
        left.end(0, A)
    assert left.seconds_left() == pytest.approx(99 * 4.0)
    left.driven()
    assert left.seconds_left() is None and (left.done, left.total) == (101, 200)


def test_a_first_long_drive_counts_while_it_is_under_way() -> None:
    """One simulator excludes a test at once; the other's first drive has taken 40 s and is at half of its road."""
    left = Left({QUICK: 5, LONG: 5}, {TWIN: 10})
    assert left.at(8.0, (LONG, 8.0, 0.05)) is None  # the car still accelerates
    assert left.at(40.0, (LONG, 40.0, 0.5)) == pytest.approx(5 * 80.0 - 40.0 + 10 * 80.0)
    left.clock = 0.0
    left.end(0, QUICK)
    # What is under way without feedback takes at least as long as it did so far.
    assert (left.at(40.0, (LONG, 40.0, None)) or 0.0) >= 4 * 40.0
    assert left.at(40.0, (LONG, 40.0, 0.5)) == pytest.approx(5 * 80.0 - 40.0 + 10 * (0.0 + 80.0) / 2)
