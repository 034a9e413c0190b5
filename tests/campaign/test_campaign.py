# SPDX-License-Identifier: Apache-2.0
"""The whole method without ROS: the twin takes every role, driven by its autopilot in this process."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from installed_package import installed_package, write_package
from tests.campaign.engines import EngineHere, MadeUpEngine
from tests.campaign.own_parts import StraightSearch

from ds_analysis.paper.campaign_contents import maps_of
from ds_base.folder_files import StoreError
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, SearchConfig, parse_config, read_config
from ds_orchestrator.campaign.engine import Engine, Watch
from ds_orchestrator.campaign.executor import CampaignError, Listener, Stopped
from ds_orchestrator.campaign.folder import read_campaign, store_of
from ds_orchestrator.campaign.runner import Campaign
from ds_orchestrator.campaign.status import stages_of
from ds_orchestrator.graph.session import GraphEngine
from ds_orchestrator.maps.algebra import operator_of
from ds_orchestrator.maps.campaign_maps import cells_of, elites_of
from ds_orchestrator.maps.feature_map import MapId, to_json
from ds_orchestrator.search.algorithms import search_of
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.gates.gate import Gate
from ds_sim.registry import DONKEY, SimulatorName, label_of
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome
from ds_sim.testing import STRAIGHT

OWN = "tests.campaign.own_parts"
DONKEYS = [SimulatorName("ds_twin_donkey.simulator:DonkeySimulator"), DONKEY]
CONFIG = CampaignConfig(
    siblings=DONKEYS,
    twin=None,
    driver=AUTOPILOT,
    seed=7,
    record="none",
    retries=1,
    search=SearchConfig(population=2, iterations=2, runs=1, min_angle=40, max_angle=90),
)
ONE = CONFIG.model_copy(update={"siblings": [DONKEYS[1]]})


def run(folder: Path, engine: Engine, config: CampaignConfig = CONFIG) -> tuple[Campaign, Store]:
    folder.mkdir(exist_ok=True)
    store = store_of(folder, config)
    campaign = Campaign(config, folder, store, engine, Listener())
    with suppress(Stopped):
        campaign.run()
    return campaign, store


def maps_text(store: Store) -> str:
    return json.dumps(to_json(maps_of(read_campaign(store))))


def test_every_test_runs_once_on_every_sibling(tmp_path: Path) -> None:
    executor = EngineHere()
    campaign, store = run(tmp_path / "a", executor)
    assert len(executor.roads) == len(store.executions()) == CONFIG.executions_at_most == 16
    assert len(set(executor.roads)) == 16
    assert len(store.tests()) == 8 and campaign.failed_executions == 0
    # The same vehicle under two names: both unions hold the same tests in the same cells.
    maps = maps_of(read_campaign(store))
    assert maps[MapId.union(SimulatorName(DONKEYS[0]))].cells == maps[MapId.union(SimulatorName(DONKEYS[1]))].cells


@pytest.mark.parametrize("count", [1, 5, 14])
def test_what_is_finished_survives_a_kill(tmp_path: Path, count: int) -> None:
    """The process ends itself by SIGKILL in the moment in which the listener hears that a run is finished."""

    class Killer(Listener):
        left = count

        def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
            self.left -= 1
            if not self.left:
                os.kill(os.getpid(), signal.SIGKILL)

    def work() -> None:
        store = Store(tmp_path / "campaign.sqlite", config=CONFIG.identity())
        Campaign(CONFIG, tmp_path, store, MadeUpEngine(), Killer()).run()

    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    child.join(60)
    assert child.exitcode == -signal.SIGKILL
    kept = len(Store(tmp_path / "campaign.sqlite").executions())
    assert kept >= count  # another simulator's thread may have stored a run that the listener had not heard of
    rest = MadeUpEngine()
    _, store = run(tmp_path, rest)
    assert len(rest.roads) == CONFIG.executions_at_most - kept == 16 - kept
    _, undisturbed = run(tmp_path / "whole", MadeUpEngine())
    assert maps_text(store) == maps_text(undisturbed)


def test_errors_are_retried_and_never_enter_a_map(tmp_path: Path) -> None:
    campaign, store = run(tmp_path / "a", EngineHere(errors=3), ONE)
    assert campaign.failed_executions == 1 and len(store.executions()) == 3
    assert [error[3] for error in store.errors()] == ["DRIVER_SILENT"] * 3
    # A later session repeats only executions that ended in an error.
    again = EngineHere()
    campaign, store = run(tmp_path / "a", again, ONE)
    assert campaign.failed_executions == 0 and len(store.executions()) == 4


def test_a_search_that_continued_without_an_outcome_does_so_again(tmp_path: Path) -> None:
    """The second test has no outcome at first; once it has one, the following roads stay the same."""
    _, store = run(tmp_path / "a", EngineHere(errors=2, errors_after=1), ONE)
    roads = [test.road.road_id for test in store.tests()]
    assert len(store.executions()) == 3 and len(store.given_up()) == 1
    again = EngineHere()
    _, store = run(tmp_path / "a", again, ONE)
    assert again.roads == [(DONKEYS[1], roads[1])]
    assert [test.road.road_id for test in store.tests()] == roads
    assert len(store.executions()) == 4
    # Each outcome belongs to the road in the store.
    driven = {e.test_id: e.trajectory for e in store.executions()}
    for test in store.tests():
        start = test.road.lane_centre[0]
        assert driven[test.test_id][0, :2] == pytest.approx(start, abs=0.05)


def test_a_simulator_without_any_outcome_stops_the_campaign_and_spoils_nothing(tmp_path: Path) -> None:
    """Two attempts each at five tests in a row; once fixed, the campaign equals an undisturbed one."""
    config = ONE.model_copy(update={"search": ONE.search.model_copy(update={"population": 3, "iterations": 5})})
    _, whole = run(tmp_path / "whole", EngineHere(), config)
    with pytest.raises(CampaignError, match=r"donkey gave no outcome for 5 tests in a row .*no command within 1 s"):
        run(tmp_path / "parts", EngineHere(errors=1000, errors_after=2), config)
    store = Store(tmp_path / "parts" / "campaign.sqlite")
    assert len(store.tests()) == 3 and store.given_up() == set() and len(store.errors()) == 10
    store.close()
    _, store = run(tmp_path / "parts", EngineHere(), config)
    assert maps_text(store) == maps_text(whole)
    assert [t.road.road_id for t in store.tests()] == [t.road.road_id for t in whole.tests()]


def test_a_cancelled_run_is_repeated(tmp_path: Path) -> None:
    executor = EngineHere(errors=1)
    executor.error = Outcome.CANCELLED
    campaign, store = run(tmp_path / "a", executor, ONE)
    assert campaign.failed_executions == 0 and len(store.executions()) == 4
    assert [row[3] for row in store.errors()] == ["CANCELLED"]


def test_a_test_whose_road_has_changed_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "a", EngineHere(runs=2), ONE)[1].close()
    db = sqlite3.connect(tmp_path / "a" / "campaign.sqlite")
    db.execute("UPDATE tests SET road_id='another' WHERE number=1")
    db.commit()
    with pytest.raises(StoreError, match="test donkey-0-0001 has another road than"):
        run(tmp_path / "a", EngineHere(), ONE)


def test_an_error_on_one_sibling_stops_the_others_at_once(tmp_path: Path) -> None:
    class Broken(EngineHere):
        def __init__(self) -> None:
            super().__init__()
            self.stopped = threading.Event()

        def stop(self) -> None:
            self.stopped.set()

        def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
            if request.simulator == DONKEYS[1]:
                raise OSError("no space left")
            assert self.stopped.wait(20.0), "the active run was not stopped"
            return request.ended(Outcome.CANCELLED, "stopped")

    with pytest.raises(OSError, match="no space left"):
        run(tmp_path / "a", Broken())


@pytest.mark.parametrize(
    ("raw", "named"),
    [
        (
            {"siblings": ["bulet"]},
            "siblings: unknown simulator 'bulet', did you mean 'bullet'?: expected one of bullet, softbody, panda",
        ),
        ({"siblings": []}, "siblings: an empty list, expected at least 1"),
        ({"siblings": "bullet"}, "siblings: bullet, expected a list, as in [a, b]"),
        ({"siblings": None}, "siblings: nothing there, expected a list"),
        ({"sibling": ["bullet"]}, "sibling: there is no such key (keys: siblings"),
        ({"twin": "bullet"}, "twin: bullet is a sibling too"),
        ({"twin": False}, "twin: false, expected text"),
        ({"search": {"min_angle": 200, "max_angle": 100}}, "search: min_angle 200 is above max_angle 100"),
        ({"search": "deephyperion"}, "search: deephyperion, expected keys with values"),
        ({"seed": -1}, "seed: -1, expected at least 0"),
        ({"seed": "1"}, "seed: '1', expected a whole number"),
        ({"record": "everything"}, "record: everything, expected one of none, telemetry, compressed, raw"),
        ({"maxitwo_compatible": "yes"}, "maxitwo_compatible: 'yes', expected true or false"),
        ({"conditions": "fog=1"}, "unknown condition 'fog'"),
        ({"lane": "centre"}, "lane: centre, expected one of right, left, middle"),
        ([1, 2], "c.yaml: [1, 2], expected keys with values"),
        ({"seed": -1, "workers": 65}, "seed: -1, expected at least 0; workers: 65, expected at most 64"),
        ({"search": {"method": "hyperion"}}, "search.method: unknown search 'hyperion': expected one of deephyperion"),
        ({"operators": {"probability": "sum"}}, "operators.probability: unknown operator 'sum'"),
        ({"operators": {"compare": ["mean", "mean"]}}, "operators.compare: an operator is named twice"),
        ({"features": ["turns_count", "length"]}, "features: unknown feature 'length': expected one of turns_count"),
        ({"features": ["curvature", "curvature:2"]}, "expected two or three different ones"),
        ({"features": ["turns_count", "segment_count"]}, "the same number"),
        ({"migration": "some"}, "migration: some, expected one of all, elites"),
        ({"sim2real": True}, "sim2real: True: expected false, or a set of generators"),
        ({"features": ["turns_count", f"{OWN}:NOTHING"]}, "NOTHING is a str, expected a Feature"),
        ({"features": ["turns_count", "no.such:FEATURE"]}, "cannot be imported"),
        ({"features": [f"{OWN}:EASTING", f"{OWN}:EASTING:2"]}, "expected two or three different ones"),
        ({"operators": {"quality_loss": f"{OWN}:EASTING"}}, "is a Feature, expected a MergeOperator"),
        ({"search": {"method": f"{OWN}:MEDIAN"}}, "is a MergeOperator, expected a type"),
        ({"search": {"method": "tests.campaign.engines:EngineHere"}}, "no subclass of"),
        ({"search": {"conditions": {"rain": {"low": 0.0, "high": 1.0}}}}, "unknown condition 'rain'"),
        ({"search": {"conditions": {"visibility": {"low": 5.0, "high": 50.0}}}}, "expected a finite range within 20"),
        (
            {"search": {"conditions": {"visibility": {"low": 20.0, "high": 200.0}}}, "conditions": "visibility=40"},
            "visibility is fixed and searched",
        ),
        ({"features": ["curvature", "visibility"]}, "visibility is not searched"),
        ({"features": ["curvature", "visible_contrast"]}, "is measured by the gates, expected conditions"),
        ({"search": {"conditions": {"visibility": {"low": 20.0}}}}, "search.conditions.visibility.high"),
    ],
)
def test_a_wrong_configuration_is_refused_in_one_line(raw: object, named: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_config(raw, "c.yaml")
    assert named in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (None, "cannot be read .No such file or directory.: check the path"),
        ("siblings: [bullet\n: :", "not YAML: line 2"),
        ("search:\n\truns: 1", "not YAML: line 2, column 1: .*indent with spaces"),
        ("seed: 1\nsearch: {runs: 1, runs: 2}", "line 2, column 19: the key runs comes twice"),
        ("# nothing but a comment", "empty, expected a campaign's keys"),
        ("\xff", "not YAML"),
    ],
)
def test_a_file_that_is_no_configuration_is_refused(tmp_path: Path, text: str | None, named: str) -> None:
    if text is not None:
        (tmp_path / "c.yaml").write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=named) as refused:
        read_config(tmp_path / "c.yaml")
    assert "\n" not in str(refused.value)


def test_the_shipped_configurations_are_what_they_say() -> None:
    folder = Path("src/ds_bringup/config")
    demo, paper, first_run = (read_config(folder / f"{name}.yaml") for name in ("demo", "paper", "first_run"))
    # Paper 4.2.4; every key is written out, with its default value.
    search = paper.search
    assert (search.method, search.population, search.iterations, search.runs) == ("deephyperion", 20, 150, 5)
    assert set(yaml.safe_load((folder / "paper.yaml").read_text())) == set(CampaignConfig.model_fields)
    plain = paper.operators.model_copy(update={"compare": []})
    assert str(paper.driver) == "dave2@openvino-bf16"  # no verdict differs (docs/speed.md)
    assert paper.model_copy(update={"operators": plain, "driver": DriverName("dave2")}) == CampaignConfig()
    assert paper.operators.compare == ["minimum", "maximum", "mean", "weighted_mean"]
    smaller = {"search": search.model_copy(update={"runs": 2}), "driver": DriverName("dave2_short")}
    assert first_run == paper.model_copy(update=smaller)
    drives = [config.executions_at_most for config in (demo, first_run, paper)]
    assert drives == [2 * 1 * 20 * 3, 2 * 2 * 170 * 3, 2 * 5 * 170 * 3]
    assert parse_config({"twin": "none"}, "c.yaml").twin is None


def test_a_campaign_in_the_left_lane_drives_the_same_roads_there_and_resumes(tmp_path: Path) -> None:
    left = CONFIG.model_copy(update={"lane": "left"})
    assert '"lane"' not in CONFIG.identity() and '"lane":"left"' in left.identity()
    _, right_store = run(tmp_path / "right", MadeUpEngine(), CONFIG)
    run(tmp_path / "left", MadeUpEngine(runs=3), left)[1].close()
    _, store = run(tmp_path / "left", MadeUpEngine(), left)
    tests = store.tests()
    assert {test.road.lane for test in tests} == {"left"} and len(tests) == len(right_store.tests())
    # The first roads depend on no outcome.
    assert tests[0].road == right_store.tests()[0].road.in_lane("left") != right_store.tests()[0].road
    driven = {e.test_id: e.trajectory for e in store.executions()}
    for test in tests:
        assert driven[test.test_id][0, :2] == pytest.approx(test.road.left_lane_centre[0], abs=1e-9)
    store.close()
    with pytest.raises(StoreError, match="lane: left there, the default now"):
        Store(tmp_path / "left" / "campaign.sqlite", config=CONFIG.identity())


def test_a_pool_gives_each_run_to_a_worker_that_is_free() -> None:
    class Counting(EngineHere):
        def __init__(self) -> None:
            super().__init__()
            self.busy, self.stopped, self.runs = threading.Lock(), False, 0

        def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
            assert self.busy.acquire(blocking=False), "two runs at once on one simulator of one worker"
            together.wait(timeout=120.0)
            self.runs += 1
            self.busy.release()
            return request.ended(Outcome.COMPLETED, "")

        def stop(self) -> None:
            self.stopped = True

    together = threading.Barrier(2)
    workers = [Counting(), Counting()]
    probing = MadeUpEngine()
    pool = GraphEngine(workers, [DONKEY], lambda: probing)
    with ThreadPoolExecutor(2) as threads:
        asked = [DriveRequest(Scenario(STRAIGHT, seed=seed), DriverName("dave2"), DONKEY) for seed in range(6)]
        list(threads.map(pool.drive, asked))
    assert sum(w.runs for w in workers) == 6
    pool.drive(DriveRequest(Scenario(STRAIGHT, seed=6), AUTOPILOT, DONKEY, probed=True))
    assert sum(w.runs for w in workers) == 6 and len(probing.roads) == 1
    pool.stop()
    assert all(w.stopped for w in workers)


@pytest.mark.parametrize("method", ["deephyperion_cs", "random"])
def test_every_search_goes_on_where_it_was_stopped(tmp_path: Path, method: str) -> None:
    """With a feature of the run, whose cell is computed from the stored execution on replay."""
    search = CONFIG.search.model_copy(update={"method": method, "iterations": 4})
    config = ONE.model_copy(update={"search": search, "features": ["turns_count", "steering_deviation:2"]})
    _, whole = run(tmp_path / "whole", MadeUpEngine(), config)
    run(tmp_path / "parts", MadeUpEngine(runs=3), config)[1].close()
    _, parts = run(tmp_path / "parts", MadeUpEngine(), config)
    assert maps_text(parts) == maps_text(whole)
    assert parts.searches() == whole.searches() and parts.searches()[0][:3] == (DONKEYS[1], 0, method)


def test_maxitwo_compatible_drives_the_mutants_centre_line_and_migrates_elites_alone(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"maxitwo_compatible": True})
    executor = MadeUpEngine()
    _, store = run(tmp_path / "a", executor, config)
    tests = store.tests()
    assert len(tests) == 2 * (2 + 2 + 1)
    mutants = [test for test in tests if test.road.maxitwo_compatible]
    assert len(mutants) == 2 * 3 and all(len(test.road.points) == 96 for test in mutants)
    driven = {e.test_id: e.trajectory for e in store.executions()}
    for test in mutants:
        # The driven road starts where the mutant starts, although a simulator receives only control points.
        assert driven[test.test_id][0, :2] == pytest.approx(test.road.lane_centre[0], abs=1e-9)
    plan = config.map_plan()
    cells = cells_of(tests, store.executions(), features=plan.features, maxitwo_compatible=True)
    elites = elites_of(tests, store.executions(), cells)
    migrated = {e.test_id for e in store.executions() if not e.test_id.startswith(label_of(e.simulator) + "-")}
    assert migrated == elites and 0 < len(elites) <= len(tests)
    first = MadeUpEngine(runs=0)
    run(tmp_path / "a", first, config)
    assert first.roads == []


class SlowEngine(MadeUpEngine):
    """Sixteen drives at a time, of different lengths."""

    capacity, lock = 16, threading.Lock()

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        time.sleep(0.05 + 0.1 * np.random.default_rng(request.seed).random())
        with self.lock:
            return super().drive(request, watch)


def test_searches_and_migration_keep_sixteen_workers_busy(tmp_path: Path) -> None:
    """Ten searches alone would leave six idle; the results are those of one drive after the other."""
    config = CONFIG.model_copy(update={"search": CONFIG.search.model_copy(update={"runs": 5, "iterations": 18})})
    engine, one = SlowEngine(), MadeUpEngine()
    one.capacity = 1
    _, parallel = run(tmp_path / "parallel", engine, config)
    _, serial = run(tmp_path / "serial", one, config)
    assert maps_text(parallel) == maps_text(serial) and list(parallel.tests()) == list(serial.tests())
    outcomes = [[(e.test_id, e.simulator, e.trajectory_sha256) for e in of.executions()] for of in (parallel, serial)]
    assert outcomes[0] == outcomes[1] and len(outcomes[0]) == len(engine.roads) == 2 * 5 * 20 * 2
    searched = {(test.sibling, test.road.road_id) for test in parallel.tests()}
    last = max(k for k, drive in enumerate(engine.roads) if drive in searched)
    assert last > 300  # of the 200 other drives most were over when the last search ended; after it, it would be 199


def test_stages_say_how_far_a_campaign_is(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"siblings": [DONKEYS[0]], "twin": "donkey"})
    engine = MadeUpEngine(runs=2)
    engine.capacity = 1  # so that the search is first
    _, store = run(tmp_path / "a", engine, config)
    begun = {stage.name: stage for stage in stages_of(read_campaign(store))}
    search = begun[f"search {DONKEYS[0]}, run 0"]
    assert (search.done, search.expected, search.state) == (2, 4, "begun")
    twin = begun[f"twin: {DONKEYS[0]} to donkey"]
    assert (twin.done, twin.expected, twin.state) == (0, None, "to do")
    assert [begun[name].state for name in ("maps", "evaluation", "report")] == ["to do"] * 3
    store.close()
    _, store = run(tmp_path / "a", MadeUpEngine(), config)
    results = {stage.name: stage for stage in stages_of(read_campaign(store))}
    assert (results[twin.name].done, results[twin.name].expected, results[twin.name].state) == (4, 4, "done")
    failed = [e.outcome.is_failure for e in store.executions() if e.simulator != "donkey"]
    assert results[search.name].failures == sum(failed)
    for executions, state in ((store.count_executions(), "done"), (1, "to do")):
        store.set_result("maps", executions)
        assert {s.name: s.state for s in stages_of(read_campaign(store))}["maps"] == state


def config_of(**changes: Any) -> CampaignConfig:
    raw = {
        "siblings": CONFIG.siblings,
        "twin": CONFIG.twin,
        "driver": "autopilot",
        "engine": "local",
        "record": "none",
        "search": {"population": 2, "iterations": 3, "runs": 1, "method": f"{OWN}:StraightSearch"},
        "features": ["turns_count", f"{OWN}:EASTING:5"],
        "operators": {"probability": f"{OWN}:MEDIAN"},
    }
    return parse_config({**raw, **changes}, "mine.yaml")


@pytest.fixture
def package(tmp_path: Path) -> Iterator[None]:
    """An installed package that adds the feature `easting` and the operator `median`."""
    write_package(tmp_path, "features", {"easting": f"{OWN}:EASTING"})
    with installed_package(tmp_path, "operators", {"median": f"{OWN}:MEDIAN"}):
        yield


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(("feature", "median"), [(f"{OWN}:EASTING:5", f"{OWN}:MEDIAN"), ("easting:5", "median")])
def test_a_campaign_runs_with_parts_of_the_users_own(tmp_path: Path, feature: str, median: str) -> None:
    config = config_of(features=["turns_count", feature], operators={"probability": median})
    data = read_campaign(run(tmp_path / "campaign", MadeUpEngine(), config)[1])
    assert search_of(f"{OWN}:StraightSearch") is StraightSearch
    assert all(test.road.curvature < 0.08 for test in data.tests), "drawn by the own search"
    expected = {test.test_id: (test.road.turns_count, int(test.road.control_points[-1][0]) // 5) for test in data.tests}
    assert data.cells == expected
    merged = maps_of(data)[MapId.merged()]
    values = np.array([[0.0, 0.5], [1.0, 0.5]])
    assert operator_of(median).combine(values, np.ones(2)).tolist() == [0.5, 0.5]
    assert merged.cells and set(merged.cells) <= set(expected.values())


@pytest.mark.parametrize(("allowed", "status"), [("", 2), (f"{OWN}:MEDIAN,{OWN}:EASTING,{OWN}:StraightSearch", 0)])
def test_a_received_folder_runs_no_code_that_the_user_has_not_named(tmp_path: Path, allowed: str, status: int) -> None:
    run(tmp_path, MadeUpEngine(), config_of())[1].close()
    script = f"import sys; from ds_cli.application import run; code = run(['campaign', 'status', {str(tmp_path)!r}])\n"
    script += f"print('imported' if {OWN!r} in sys.modules else 'not imported'); sys.exit(code)"
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        timeout=120,
        env={"DS_TRUST": allowed, "PYTHONPATH": ":".join(map(str, sys.path)), "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode == status, done.stderr
    assert ("not imported" in done.stdout) == (not allowed)
    if not allowed:
        assert "a received file must not run code" in done.stderr and done.stderr.count("\n") == 1
