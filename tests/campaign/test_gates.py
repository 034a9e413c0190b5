# SPDX-License-Identifier: Apache-2.0
"""Campaigns under conditions, fixed or searched, with made-up drives, and their gates.

A test that nobody can pass, or whose lines nobody can see, says nothing about the network.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.campaign.damaged_stores import change_store
from tests.campaign.engines import MadeUpEngine
from tests.campaign.test_campaign import CONFIG, DONKEYS, ONE, maps_text, run
from tests.drives import driven

from ds_analysis.paper.campaign_contents import excluded_table, maps_of
from ds_base.folder_files import StoreError
from ds_cli.campaign.inspection import campaign_status_command
from ds_cli.campaign.run import stored_config
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, parse_config
from ds_orchestrator.campaign.engine import Watch
from ds_orchestrator.campaign.executor import trajectory_sha256
from ds_orchestrator.campaign.folder import ENGINE, CampaignData, open_store, read_campaign
from ds_orchestrator.campaign.status import roads_of, stages_of
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import format_conditions, parse_conditions
from ds_sim.gates.gate import GateState, gate_of
from ds_sim.registry import DONKEY
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason
from ds_studies import whole_campaign
from ds_studies.whole_campaign import run_campaign

FOGGY = CONFIG.model_copy(update={"conditions": parse_conditions("visibility=60")})
SEEN, UNSEEN = 0.5, 0.01


class GatedEngine(MadeUpEngine):
    """Made-up drives, and an autopilot whose runs end as the seed has it: one in three invalid by each gate."""

    def __init__(self, *, gate_errors: int = 0, **options: Any) -> None:
        super().__init__(**options)
        self.gated: list[tuple[str, str]] = []
        self.conditions: set[Conditions] = set()
        self._gate_errors = gate_errors

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        if not request.probed:
            self.conditions.add(request.conditions)
            return super().drive(request)
        assert request.driver == AUTOPILOT
        self.gated.append((request.simulator, request.road.road_id))
        run = MadeUpEngine().drive(request)
        if self._gate_errors:
            self._gate_errors -= 1
            return replace(run, outcome=Outcome.SIM_ERROR, message="no luck")
        kind = (request.seed + len(request.simulator)) % 3
        return replace(
            run,
            outcome=Outcome.OUT_OF_BOUNDS if kind == 0 else Outcome.COMPLETED,
            visible_contrasts=[UNSEEN if kind == 1 else SEEN],
        )


def test_only_valid_tests_are_driven_and_the_others_enter_no_map(tmp_path: Path) -> None:
    executor = GatedEngine()
    campaign, store = run(tmp_path / "a", executor, FOGGY)
    data = read_campaign(store)
    assert len(data.gates) == len(executor.gated) == len(set(executor.gated)) == 16
    states = {key: gate.state for key, gate in data.gates.items()}
    assert set(states.values()) == {GateState.VALID, GateState.INFEASIBLE, GateState.OUT_OF_ODD}
    # The states are those that the made-up autopilot's runs were given.
    seeds = {test.test_id: test.seed for test in data.tests}
    expected = (GateState.INFEASIBLE, GateState.OUT_OF_ODD, GateState.VALID)
    assert all(state is expected[(seeds[i] + len(name)) % 3] for (i, name), state in states.items())
    valid = {key for key, state in states.items() if state is GateState.VALID}
    assert {(e.test_id, e.simulator) for e in data.executions} == valid
    assert executor.conditions == {Conditions(visibility=60)} == {test.conditions for test in data.tests}
    assert campaign.failed_executions == 0 and not data.given_up and not data.errors
    for map_id, feature_map in maps_of(data).items():
        if map_id.kind == "union":
            assert sum(c.tests for c in feature_map.cells.values()) == sum(n == map_id.simulator for _, n in valid)
    driving = [stage for stage in stages_of(data) if stage.failures is not None]
    assert all(stage.state == "done" for stage in driving)
    assert sum(stage.excluded for stage in driving) == 16 - len(valid)


def test_excluded_tests_are_shown_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, store = run(tmp_path / "a", GatedEngine(), FOGGY)
    data = read_campaign(store)
    excluded = {key: gate.state.value for key, gate in data.gates.items() if not gate.is_valid}
    counts = {name: Counter(state for (_, n), state in excluded.items() if n == name) for name in DONKEYS}
    found = campaign_status_command(tmp_path / "a")
    assert found.document["excluded"] == counts
    found.show()
    shown = capsys.readouterr().out
    for name, of in counts.items():
        line = f"{name}: {of.total()} of 8 gated tests enter no map: {of['infeasible']} infeasible, "
        assert f"{line}{of['out_of_odd']} out of the operational design domain" in shown
    rows = list(csv.DictReader(excluded_table(data).csv().splitlines()))
    assert {(row["test"], row["simulator"]): row["state"] for row in rows} == {
        key: state.replace("out_of_odd", "out of the operational design domain") for key, state in excluded.items()
    }
    assert {row["conditions"] for row in rows} == {"visibility=60"}
    states = {(road["test_id"], n): s for road in roads_of(tmp_path / "a") for n, s in road.get("excluded", {}).items()}
    assert states == excluded


@pytest.mark.parametrize("stop_after", [0, 2])
def test_a_stopped_campaign_goes_on_and_gates_nothing_twice(tmp_path: Path, stop_after: int) -> None:
    _, undisturbed = run(tmp_path / "whole", GatedEngine(), FOGGY)
    first, second = GatedEngine(runs=stop_after), GatedEngine()
    run(tmp_path / "parts", first, FOGGY)[1].close()
    _, store = run(tmp_path / "parts", second, FOGGY)
    assert maps_text(store) == maps_text(undisturbed) and store.gates() == undisturbed.gates()
    assert len(first.gated) + len(second.gated) == 16 and not set(first.gated) & set(second.gated)


def test_an_error_of_the_autopilot_is_repeated_and_excludes_nothing(tmp_path: Path) -> None:
    config = FOGGY.model_copy(update={"siblings": [DONKEYS[1]]})
    executor = GatedEngine(gate_errors=1)
    _, store = run(tmp_path / "a", executor, config)
    assert [error[3:] for error in store.errors()] == [("SIM_ERROR", "autopilot: no luck")]
    _, undisturbed = run(tmp_path / "b", GatedEngine(), config)
    assert store.gates() == undisturbed.gates()


@pytest.mark.parametrize("reason", [Reason.NOT_APPLICABLE, Reason.OUT_OF_SIGHT])
@pytest.mark.parametrize("probed", [True, False])
def test_a_simulator_that_cannot_judge_a_test_excludes_it_there(tmp_path: Path, reason: Reason, probed: bool) -> None:
    class Refusing(GatedEngine):
        def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
            if request.probed is probed and request.simulator == DONKEYS[0]:
                return request.ended(Outcome.SIM_ERROR, "cannot", reason)
            return super().drive(request)

    _, store = run(tmp_path / "a", Refusing(), FOGGY)
    of_first = {gate.state for (_, name), gate in store.gates().items() if name == DONKEYS[0]}
    assert GateState[reason.name] in of_first and GateState.VALID not in of_first and not store.errors()
    assert {e.simulator for e in store.executions()} <= {DONKEYS[1]}


def test_every_test_is_gated_where_that_is_asked_for(tmp_path: Path) -> None:
    executor = GatedEngine()
    _, store = run(tmp_path / "a", executor, CONFIG.model_copy(update={"gates": "all"}))
    assert len(store.gates()) == 16 and executor.conditions == {Conditions()}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("UPDATE tests SET conditions='fog=1'", "unknown condition 'fog'"),
        ("UPDATE gates SET state='fine'", "state: 'fine'"),
        ("UPDATE gates SET outcome='SIM_ERROR'", "outcome: 'SIM_ERROR'"),
        ("UPDATE gates SET simulator='nonsense' WHERE simulator='donkey'", "gates of 'nonsense'"),
        ("UPDATE gates SET state='infeasible' WHERE state='valid'", "where its gate excludes it"),
        ("UPDATE gates SET test_id='donkey-0-9999' WHERE rowid=1", "gate of 'donkey-0-9999'"),
    ],
)
def test_damaged_rows_get_one_line(tmp_path: Path, change: str, named: str) -> None:
    run(tmp_path / "a", GatedEngine(), FOGGY)[1].close()
    change_store(tmp_path / "a" / "campaign.sqlite", change)
    with pytest.raises(StoreError, match=named) as refused:
        read_campaign(Store(tmp_path / "a" / "campaign.sqlite"))
    assert len(str(refused.value).splitlines()) == 1


def test_conditions_that_a_simulator_cannot_realise_are_refused_before_anything_starts(tmp_path: Path) -> None:
    quick = "tests.engines.quick_simulator:QuickSimulator"
    config = CONFIG.model_copy(
        update={"siblings": [quick], "conditions": parse_conditions("friction=0.5"), "engine": "local"}
    )
    with pytest.raises(ConfigError, match="quick cannot realise friction"):
        run_campaign(config, tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_conditions_have_one_text(tmp_path: Path) -> None:
    config = parse_config({"conditions": "visibility = 60.0, camera_pitch=0deg"}, "test.yaml")
    assert config.conditions == parse_conditions("visibility=60")
    assert parse_config({"conditions": "none"}, "test.yaml").identity() == parse_config({}, "test.yaml").identity()


SEARCHED = {"line_contrast": {"low": 0.1, "high": 0.9}, "visibility": {"low": 20.0, "high": 200.0, "step": 0.5}}


def config_of(population: int, iterations: int, **more: Any) -> CampaignConfig:
    """The campaign with another search, of these conditions, and the features that it then has."""
    raw = json.loads(CONFIG.identity())
    del raw["features"]
    raw["search"] |= {"conditions": SEARCHED, "population": population, "iterations": iterations}
    return parse_config({**raw, "engine": "local", **more}, "here")


def test_a_stopped_search_of_conditions_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    config = config_of(3, 4)
    assert config.features == ["lane_curvature", "line_contrast"]
    executor = GatedEngine()
    _, undisturbed = run(tmp_path / "whole", executor, config)
    first, second = GatedEngine(runs=5), GatedEngine()
    run(tmp_path / "parts", first, config)[1].close()
    _, store = run(tmp_path / "parts", second, config)
    assert maps_text(store) == maps_text(undisturbed)
    assert sorted(first.roads + second.roads) == sorted(executor.roads)
    data = read_campaign(store)
    conditions = [test.conditions for test in data.tests]
    assert len(set(conditions)) > len(conditions) / 2
    assert all(0.1 <= one.line_contrast <= 0.9 and 20.0 <= one.visibility <= 200.0 for one in conditions)
    cells = {cell for feature_map in maps_of(data).values() for cell in feature_map.cells}
    assert {cell[1] for cell in cells} <= set(range(1, 10)) and len({cell[1] for cell in cells}) > 1
    # Each test is driven on each simulator at which it is valid, whatever the order.
    assert {(e.test_id, e.simulator) for e in data.executions} == {k for k, gate in data.gates.items() if gate.is_valid}
    assert len(data.gates) == len(data.tests) * len(config.simulators)


def test_maps_of_the_usual_conditions_are_drawn_beside_those_of_the_paper() -> None:
    searched = {**SEARCHED, "veiling_luminance": {"low": 0.0, "high": 3000.0}}
    config = parse_config({"search": {"conditions": searched}}, "here")
    assert config.features == ["lane_curvature", "line_contrast"]
    assert config.further_axes == [
        ("lane_curvature", "visibility"),
        ("lane_curvature", "veiling_luminance"),
        ("turns_count", "curvature"),
    ]
    of_paper = parse_config({"search": {"conditions": SEARCHED}, "features": ["turns_count", "curvature"]}, "here")
    assert of_paper.further_axes == [("lane_curvature", "line_contrast"), ("lane_curvature", "visibility")]
    assert parse_config({}, "here").further_axes == []


def test_a_search_by_measured_contrast_fills_its_cells(tmp_path: Path) -> None:
    config = config_of(3, 2, features=["turns_count", "visible_contrast"])
    data = read_campaign(run(tmp_path, GatedEngine(), config)[1])
    own = {test.test_id: data.gates[test.test_id, test.sibling].visible_contrast for test in data.tests}
    driven = {(e.test_id, e.simulator) for e in data.executions}
    by_own = {test.test_id for test in data.tests if (test.test_id, test.sibling) in driven}
    cells = {i: cell[1] for i, cell in data.cells.items() if i in by_own}
    assert cells and all(0.05 * 2**bin_ <= own[i] < 0.05 * 2 ** (bin_ + 1) for i, bin_ in cells.items())


def test_a_search_without_conditions_has_the_text_of_earlier_versions() -> None:
    keys = "method population iterations runs min_angle max_angle extent"
    assert set(json.loads(CONFIG.identity())["search"]) == set(keys.split())


TEXT = "line_contrast=0.1,visibility=80,steering_lag=0.05"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign with real worker processes: its drives, gates and bags are the library's."""
    out = tmp_path_factory.mktemp("campaign") / "out"
    search = ONE.search.model_copy(update={"population": 1, "iterations": 0})
    changes = {"search": search, "conditions": parse_conditions(TEXT), "engine": "local", "record": "telemetry"}
    with pytest.MonkeyPatch.context() as patch:
        # `test_report_browser.py` has a report of conditions.
        patch.setattr(whole_campaign, "write_all", lambda folder, *_arguments, **_options: folder / "report.html")
        assert run_campaign(ONE.model_copy(update=changes), out).executions_in_error == 0
    return out


@pytest.fixture(scope="module")
def data(folder: Path) -> CampaignData:
    with closing(open_store(folder)) as store:
        return read_campaign(store)


def test_drives_and_gates_are_those_of_the_library(data: CampaignData) -> None:
    executions = {e.test_id: e for e in data.executions}
    assert data.tests
    for test in data.tests:
        assert test.conditions == parse_conditions(TEXT)
        alone = driven("donkey", test.road, test.seed, test.conditions, probed=True)
        assert data.gates[test.test_id, DONKEY] == gate_of(alone)
        if gate_of(alone).state is GateState.VALID:
            assert executions[test.test_id].trajectory_sha256 == trajectory_sha256(alone)
        else:
            assert test.test_id not in executions


def test_it_resumes_with_what_drove_it_last(folder: Path, tmp_path: Path) -> None:
    resumed = stored_config(folder, None)
    assert (resumed.engine, resumed.workers) == ("local", 1)
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    too_many, evil = '{"engine": "graph", "workers": 65}', '{"engine": "evil", "workers": 1}'
    for text in (too_many, evil, '{"engine": "graph"}', "[" * 900):
        (copy / ENGINE).write_text(text)
        found = stored_config(copy, None)
        assert (found.engine, found.workers) == ("auto", 1)  # the defaults
    (copy / ENGINE).write_text('{"engine": "dask", "workers": 3}')
    assert stored_config(copy, None) == resumed.model_copy(update={"engine": "dask", "workers": 3})


def test_roads_carry_their_conditions(folder: Path) -> None:
    assert {road["conditions"] for road in roads_of(folder)} == {format_conditions(parse_conditions(TEXT))}
