"""`ds campaign refine`: which tests it makes, when it stops, and what stays as it was; drives are made up."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom
from tests.campaign.executors import MadeUpExecutor
from tests.command_line import ds

from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.folder import locked, store_of
from ds_orchestrator.campaign.refined_data import is_refined
from ds_orchestrator.campaign.road_selection import roads_of
from ds_orchestrator.campaign.runner import Campaign
from ds_orchestrator.comparison import given_tests
from ds_orchestrator.refinement import CellEvidence
from ds_orchestrator.run import SilentListener
from ds_orchestrator.search.features import cell_of
from ds_orchestrator.siblings.families import families_of
from ds_orchestrator.store.store import Store
from ds_road import Road
from ds_sim.conditions import DEFAULT, Conditions
from ds_sim.session import RunRecord


class CurvedExecutor(MadeUpExecutor):
    """Leaves the lane where it bends sharply, softbody a little sooner than bullet."""

    def execute(self, simulator: str, road: Road, seed: int, conditions: Conditions = DEFAULT) -> RunRecord:
        known = super().execute(simulator, road, seed, conditions)
        limit = {"bullet": 0.19, "softbody": 0.18}.get(simulator, 0.17)
        lateral = 2.0 * float(np.exp(8.0 * (road.lane_curvature_max_right - limit)))
        failed = lateral > 2.0
        for k, one in enumerate(known.observations):
            offset = lateral * k / (len(known.observations) - 1)
            lane = replace(one.lane, lateral_position=offset, lateral_distance=2.0 - abs(offset))
            known.observations[k] = replace(one, lane=lane)
        known.outcome = type(known.outcome).OUT_OF_BOUNDS if failed else type(known.outcome).COMPLETED
        return known


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Every engine is an executor that drives nothing; `left` drives are made before it is stopped."""
    state: dict[str, Any] = {"left": 10_000, "drives": []}

    @contextmanager
    def running(config: CampaignConfig, *_: object, **__: object) -> Iterator[CurvedExecutor]:
        executor = CurvedExecutor(runs=state["left"])
        yield executor
        state["drives"] += executor.roads

    monkeypatch.setattr(given_tests, "running_engine", running)
    return state


def campaign(folder: Path, **changed: Any) -> Path:
    raw = {
        "siblings": ["bullet", "softbody"], "twin": "donkey", "driver": "autopilot", "record": "none", "seed": 3,
        "search": {"population": 8, "iterations": 4, "runs": 1}, **changed,
    }  # fmt: skip
    config = parse_config(raw, "here")
    folder.mkdir()
    with locked(folder):
        store = store_of(folder, config)
        spaces = {name: f"/{name}" for name in config.simulators}
        Campaign(config, folder, store, CurvedExecutor(), SilentListener(), spaces).run()
        store.close()
    return folder


def added(folder: Path) -> list[Any]:
    with closing(Store(folder / "refinement" / "drives.sqlite")) as store:
        return [*store.tests(), *((e.test_id, e.simulator, e.trajectory_sha256) for e in store.executions())]


def test_new_tests_lie_in_disputed_cells_and_all_siblings_drive_them(tmp_path: Path, engine: dict[str, Any]) -> None:
    folder = campaign(tmp_path / "c")
    plan = ("campaign", "refine", folder, "--budget", 13, "--dry-run", "--json")
    disputed = {tuple(one["cell"]) for one in json.loads(ds(*plan).stdout)["cells"] if one["verdict"] == "disputed"}
    done = ds("campaign", "refine", folder, "--budget", 13, "--engine", "local", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["spent"] == len(engine["drives"]) == 12 and document["tests"] == 6  # 13 is no multiple of two
    with closing(Store(folder / "refinement" / "drives.sqlite")) as store:
        tests, executions = store.tests(), store.executions()
    assert {cell_of(test.road) for test in tests} <= disputed and len({test.road.road_id for test in tests}) == 6
    assert {(e.test_id, e.simulator) for e in executions} == {
        (test.test_id, name) for test in tests for name in ("bullet", "softbody")
    }
    assert all(is_refined(test.test_id) for test in tests)
    with closing(Store(folder / "campaign.sqlite")) as store:
        roads = [test.road for test in store.tests()]
        assert store.count_executions() == 72 and not any(is_refined(test.test_id) for test in store.tests())
    listed = roads_of(folder, refined=True)
    assert [road["test_id"] for road in listed if is_refined(road["test_id"])] == [test.test_id for test in tests]
    assert roads_of(folder, test=tests[0].test_id) == [road for road in listed if road["test_id"] == tests[0].test_id]
    assert not any(is_refined(road["test_id"]) for road in roads_of(folder))
    # Mutants: every new road belongs to a family of the campaign's.
    families = families_of([*roads, *(test.road for test in tests)])
    assert set(families[len(roads) :]) <= set(families[: len(roads)])
    after = json.loads(ds("predict", folder, "--json").stdout)
    assert len(after["verdicts"]["tests"]) == 24 + 6


def test_a_stopped_refinement_goes_on_and_ends_as_if_it_was_not(tmp_path: Path, engine: dict[str, Any]) -> None:
    whole, parts = campaign(tmp_path / "whole"), campaign(tmp_path / "parts")
    assert ds("campaign", "refine", whole, "--budget", 18, "--engine", "local").returncode == 0
    engine["left"] = 5
    stopped = ds("campaign", "refine", parts, "--budget", 18, "--engine", "local")
    assert stopped.returncode == 130 and "finished drives are kept" in stopped.stderr
    engine["left"] = 10_000
    kept = len(added(parts)) - sum(hasattr(one, "road") for one in added(parts))
    planned = json.loads(ds("campaign", "refine", parts, "--budget", 18, "--dry-run", "--json").stdout)
    assert kept == 5 and planned["drives_begun"] == 16 - 5
    assert ds("campaign", "refine", parts, "--budget", 18 - 5, "--engine", "local", "--workers", 3).returncode == 0
    assert added(parts) == added(whole)


def test_it_stops_when_every_disputed_cell_is_settled(tmp_path: Path, engine: dict[str, Any]) -> None:
    folder = campaign(tmp_path / "c", twin="none", search={"population": 6, "iterations": 0, "runs": 1})
    done = json.loads(
        ds("campaign", "refine", folder, "--budget", 5000, "--tolerated", 0.3, "--engine", "local", "--json").stdout
    )
    assert done["spent"] == len(engine["drives"]) < 5000
    assert "only drives on the car tell more" in done["stopped"] or "no new tests of" in done["stopped"]
    settled = [one for one in done["cells"] if one["siblings"]["agreement"] != "not settled"]
    assert settled and all(one["siblings"]["tests_needed"] == 0 for one in settled)
    # Nothing is spent beyond what settles a cell: without failures that takes five tests at a tolerated rate of 0.3.
    for one in settled:
        if one["siblings"]["agreement"] == "all safe" and not any(one["siblings"]["failures"]):
            assert max(one["siblings"]["tests"]) <= 5 + 3
    again = json.loads(ds("campaign", "refine", folder, "--budget", 6, "--tolerated", 0.3, "--json").stdout)
    assert again["spent"] == 0


def test_the_papers_maps_stay_the_papers_and_the_report_is_written_again(
    tmp_path: Path, engine: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Path] = []
    monkeypatch.setattr("ds_orchestrator.run.rebuild_report", lambda folder, **_: written.append(folder))
    folder = campaign(tmp_path / "c")
    (folder / "report.html").touch()
    shown = ds("maps", folder, "--json").stdout
    done = ds("campaign", "refine", folder, "--budget", 8, "--engine", "local", "--json")
    assert json.loads(done.stdout)["tests"] == 4, done.stderr
    assert written == [folder]
    assert ds("maps", folder, "--json").stdout == shown
    refined = json.loads(ds("maps", folder, "--refined", "--json").stdout)
    assert _tests(refined["union_bullet"]) == _tests(json.loads(shown)["union_bullet"]) + 4
    status = ds("campaign", "status", folder)
    assert "4 tests of a refinement" in status.stdout, status.stdout
    assert json.loads(ds("campaign", "status", folder, "--json").stdout)["refinement_tests"] == 4


def _tests(feature_map: dict[str, Any]) -> int:
    return sum(cell["tests"] for cell in feature_map["cells"])


def test_bad_input_is_one_line_and_a_dry_run_drives_nothing(tmp_path: Path, engine: dict[str, Any]) -> None:
    folder = campaign(tmp_path / "c")
    few = campaign(tmp_path / "few", search={"population": 2, "iterations": 0, "runs": 1})
    damaged = campaign(tmp_path / "damaged")
    (damaged / "refinement").mkdir()
    (damaged / "refinement" / "drives.sqlite").write_bytes(b"no database at all")
    for problem, arguments in (
        ("--budget 1: a test takes 2 drives, one on each of bullet, softbody", (folder, "--budget", 1)),
        ("greater than or equal to 1", (folder, "--budget", 0)),
        ("no folder", (tmp_path / "none", "--budget", 6)),
        ("4 tests have a verdict on a sibling, expected at least 10", (few, "--budget", 6)),
        ("drives.sqlite", (damaged, "--budget", 6)),
        ("missing option", (folder,)),
    ):
        for further in ((), ("--dry-run",)):
            done = ds("campaign", "refine", *arguments, *further)
            lines = [line for line in done.stderr.splitlines() if line.startswith("error")]
            assert done.returncode == 2 and done.stdout == "" and len(lines) == 1, done.stderr
            assert problem in lines[0].lower(), lines
    plan = ds("campaign", "refine", folder, "--budget", 8, "--dry-run")
    assert plan.returncode == 0 and "tests needed" in plan.stdout and "disputed cells" in plan.stdout
    assert not engine["drives"] and not (folder / "refinement").exists()


def test_evidence_is_jeffreys_posterior_by_counting() -> None:
    """Posterior on a grid that is uniform in arcsin(sqrt(rate)), as Jeffreys' prior is; one further test at a time."""
    grid = np.sin((np.arange(100_000) + 0.5) / 100_000 * np.pi / 2) ** 2

    def above(tests: int, failures: int) -> float:
        weights = binom.pmf(failures, tests, grid)
        return float(weights[grid > 0.1].sum() / weights.sum())

    for tests, failures in ((1, 0), (1, 1), (2, 1), (5, 0), (17, 0), (18, 0), (19, 0), (30, 3), (9, 3)):
        one = CellEvidence(cell=(0,), tests=(tests,), failures=(failures,))
        share = above(tests, failures)
        assert one.verdicts == ("fails" if share >= 0.95 else "safe" if share <= 0.05 else "disputed",)
        if failures == 0 and share > 0.05:
            further = next(n for n in range(1, 100) if above(tests + n, 0) <= 0.05)
            assert one.tests_needed == further
    assert CellEvidence(cell=(0,), tests=(3, 30), failures=(3, 0)).agreement == "siblings differ"
    assert CellEvidence(cell=(0,), tests=(3, 3), failures=(3, 0)).agreement == "not settled"
    assert CellEvidence(cell=(0,), tests=(30, 30), failures=(0, 0)).agreement == "all safe"
    assert CellEvidence(cell=(0,), tests=(0, 30), failures=(0, 0)).verdicts == ("untested", "safe")
    assert CellEvidence(cell=(0,), tests=(10, 30), failures=(1, 0)).tests_needed is None  # stays at the tolerated rate
