# SPDX-License-Identifier: Apache-2.0
"""`ds compare`, `ds suite` and `ds test` as commands, with made-up drives, and what a campaign proposes at its end."""

from __future__ import annotations

import html
import json
import re
import shlex
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import typer
from tests.campaign.engines import MadeUpEngine, use_engines
from tests.command_line import document, ds, refusal
from tests.fuzz.kinds_campaigns import suite_of

from ds_analysis.sensitivity import RoadResult, Sensitivity, Threshold, factors_named
from ds_base.folder_files import locked
from ds_cli.campaign.run import judged
from ds_cli.options import CampaignCriteria
from ds_cli.output import Result, end
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig, parse_config, read_config
from ds_orchestrator.campaign.engine import DriveSettings, Watch
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.folder import store_of
from ds_orchestrator.campaign.forecast import Forecast, MeasuredDrive
from ds_orchestrator.campaign.runner import Campaign
from ds_orchestrator.campaign.template import SIZES, template
from ds_orchestrator.store.model import DriveArrays
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store
from ds_report.first_screen import GENTLE, WINDING, proposal
from ds_sim import BULLET, DONKEY, PANDA, SimulatorName
from ds_sim.session import RunRecord


class OfDriver(MadeUpEngine):
    """Drives that depend on the driver: that of the campaigns, and one that another seed tells apart."""

    def __init__(self, driver: DriverName, *, runs: int = 10_000) -> None:
        super().__init__(runs=runs)
        self.offset = 0 if driver == AUTOPILOT else 1

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        moved = replace(request.scenario, seed=request.seed + self.offset)
        return replace(super().drive(replace(request, scenario=moved)), scenario=request.scenario)


DONE = Result(document={}, show=lambda: None, next="ds models")
Engines = list[OfDriver]
Configs = list[tuple[CampaignConfig, Path]]


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Engines:
    """Every engine that a verb starts drives nothing; returns those that were started."""
    started: Engines = []

    def start(settings: DriveSettings) -> OfDriver:
        started.append(OfDriver(settings.driver))
        return started[-1]

    use_engines(monkeypatch, start)
    monkeypatch.setattr("ds_orchestrator.engines.start.check_driver", lambda *_, **__: None)
    monkeypatch.setattr(
        "ds_driver.networks.network_driver.driver_sha256",
        lambda name: str(name).encode().hex().ljust(64, "0") if name.has_files else "",
    )
    return started


def campaign(folder: Path, *, driver: str = "autopilot", **changed: Any) -> Path:
    raw = {
        "siblings": ["bullet", "softbody"],
        "twin": "donkey",
        "driver": driver,
        "record": "none",
        "seed": 3,
        "search": {"population": 2, "iterations": 2, "runs": 1},
        **changed,
    }
    config = parse_config(raw, "here")
    folder.mkdir()
    with locked(folder):
        store = store_of(folder, config)
        Campaign(config, folder, store, OfDriver(config.driver), Listener()).run()
        if driver != "autopilot":
            store.note("sha256 of the driver's weights", driver.encode().hex().ljust(64, "0"))
        store.close()
    return folder


def test_a_network_drives_the_tests_of_a_campaign_once(tmp_path: Path, engine: Engines) -> None:
    old, out = campaign(tmp_path / "old"), tmp_path / "out"
    done = ds("compare", old, "--driver", "other", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    # 8 tests on 3 simulators; the reference drives only the three that check whether it repeats.
    assert [len(executor.roads) for executor in engine] == [3, 24]
    assert sum(row["tests"] for row in result["simulators"]) == len(result["tests"]) == 24
    assert result["origin"] == "reference"
    # The initial population of either search.
    assert {row["random_roads"]["tests"] for row in result["simulators"]} == {4}
    counted = [sum(test["change"] == "newly fails" for test in result["tests"])]
    assert counted == [sum(row["newly_fail"] for row in result["simulators"])] and counted[0] > 0
    worse = next(test for test in result["tests"] if "command" in test)
    road = Path(worse["command"].split("--road ")[1].split()[0])
    assert json.loads(road.read_text())[0]["seed"] == worse["seed"]
    for name in ("comparison.html", "comparison.md", "comparison.json", "tables/compared_networks.csv"):
        assert (out / name).stat().st_size > 0
    again = ds("compare", old, "other", "--out", out, "--json")
    assert again.stdout == done.stdout and len(engine) == 2


def test_a_campaign_of_a_node_is_compared_by_its_known_outcomes(tmp_path: Path, engine: Engines) -> None:
    old = campaign(tmp_path / "old", driver="ros@my_node")
    done = ds("compare", old, "other", "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    assert "its known outcomes were not checked: it is a ROS node that you start" in done.stderr
    assert [len(executor.roads) for executor in engine] == [24]


def test_a_moved_comparison_finds_its_roads(tmp_path: Path, engine: Engines, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's commands are typed in its folder; the names of files are relative to it."""
    monkeypatch.chdir(tmp_path)
    campaign(Path("old"))
    assert ds("compare", "old", "nets/other.yaml", "--out", "my results").returncode == 0
    moved = Path("elsewhere").resolve()
    Path("my results").rename(moved)
    page = html.unescape((moved / "comparison.html").read_text("utf-8"))
    commands = [shlex.split(line) for line in re.findall(r"<pre tabindex=\"0\">(ds drive .*)</pre>", page)]
    assert commands and "my results" not in page
    for words in commands:
        said = dict(zip(words[2::2], words[3::2], strict=True))
        assert (moved / said["--road"]).is_file() and said["--driver"] == "../nets/other.yaml"


def test_a_stopped_comparison_goes_on(tmp_path: Path, engine: Engines, monkeypatch: pytest.MonkeyPatch) -> None:
    old, out = campaign(tmp_path / "old"), tmp_path / "out"

    def start(settings: DriveSettings) -> OfDriver:
        engine.append(OfDriver(settings.driver, runs=10))
        return engine[-1]

    with monkeypatch.context() as patch:
        use_engines(patch, start)
        stopped = ds("compare", old, "other", "--out", out)
    assert stopped.returncode == 130 and "the same command" in stopped.stderr
    assert ds("compare", old, "other", "--out", out).returncode == 0
    assert [len(executor.roads) for executor in engine] == [3, 10, 14]


def test_two_campaigns_share_the_tests_that_both_drove(tmp_path: Path, engine: Engines) -> None:
    """Both begin with the same random roads; what is left are the mutants of each, which the other network drives."""
    search: dict[str, Any] = {"search": {"population": 2, "iterations": 8, "runs": 1}}
    old, new = campaign(tmp_path / "old", **search), campaign(tmp_path / "new", driver="other", **search)
    mine, theirs = contents_of(old), contents_of(new)
    result = document("compare", old, new, "--out", tmp_path / "out")
    compared = {(test["road_id"], test["seed"]) for test in result["tests"]}
    assert compared == mine | theirs and len(mine & theirs) >= 4 and theirs - mine
    assert {row["tests"] for row in result["simulators"]} == {len(compared)} and result["origin"] == "both"
    again = 2 * 3  # both networks on three simulators, to check that they repeat
    assert sum(len(executor.roads) for executor in engine) == again + 3 * len(mine ^ theirs)


def contents_of(folder: Path) -> set[tuple[str, int]]:
    with closing(Store(folder / "campaign.sqlite")) as store:
        return {(test.road.road_id, test.seed) for test in store.tests()}


def test_two_networks_drive_the_same_random_roads(tmp_path: Path, engine: Engines) -> None:
    options = ("--roads", 3, "--sims", "bullet,donkey", "--out", tmp_path / "out")
    result = document("compare", "autopilot", "other", *options)
    assert [sorted(executor.roads) for executor in engine][0] == sorted(engine[1].roads)
    assert result["origin"] == "random" and {row["tests"] for row in result["simulators"]} == {3}


def test_a_reference_that_drives_differently_than_before_is_refused(tmp_path: Path, engine: Engines) -> None:
    old = campaign(tmp_path / "old")
    store = Store(old / "campaign.sqlite")
    for execution in store.executions():
        first = execution.trajectory.copy()
        first[:, 0] += 1.0
        digest = trajectory_sha256(first)
        store.add_execution(replace(execution, drive=DriveArrays(first, execution.steering), trajectory_sha256=digest))
    store.close()
    done = ds("compare", old, "other", "--out", tmp_path / "out")
    assert done.returncode == 2 and done.stderr.count("error:") == 1
    assert "--again drives the reference again" in done.stderr
    assert ds("compare", old, "other", "--again", "--out", tmp_path / "out").returncode == 0


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"twin": "panda"}, "twin"),
        ({"conditions": "visibility=60"}, "conditions"),
        ({"siblings": ["bullet"]}, "siblings"),
    ],
)
def test_campaigns_that_do_not_compare_are_refused_in_one_line(
    tmp_path: Path, engine: Engines, changed: dict[str, Any], key: str
) -> None:
    old, new = campaign(tmp_path / "old"), tmp_path / "new"
    if "conditions" in changed:
        new.mkdir()
        config = parse_config({"siblings": ["bullet", "softbody"], "record": "none", **changed}, "here")
        store_of(new, config).close()
    else:
        campaign(new, driver="other", **changed)
    assert f"differ in {key} (" in refusal("compare", old, new, "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("a",), "expected one candidate"),
        (("a", "b", "--driver", "c"), "expected one candidate"),
        (("{old}", "b", "--roads", "3"), "--roads is for two networks"),
        (("a", "{old}"), "is no campaign folder"),
        (("{old}", "b", "--max-failures", "500%"), "expected a share from 0% to 100%"),
        (("{old}", "b", "--junit", "/nowhere/x.xml"), "there is no such folder"),
        (("{old}/..", "b"), "no campaign in"),
        (("{old}", "b", "--engine", "steam"), "expected one of auto, graph, local, dask"),
    ],
)
def test_bad_input_gets_one_line(tmp_path: Path, engine: Engines, arguments: tuple[str, ...], problem: str) -> None:
    old = campaign(tmp_path / "old")
    given = [argument.format(old=old) for argument in arguments]
    assert problem in refusal("compare", *given, "--out", tmp_path / "out")


def test_a_suite_holds_the_tests_that_tell_most_and_compares_by_itself(tmp_path: Path, engine: Engines) -> None:
    old, file = campaign(tmp_path / "old"), tmp_path / "suite.json"
    made = document("suite", "make", old, "--out", file, "--tests", 5)
    assert (made["tests"], made["drives"]) == (5, 15)
    suite = json.loads(file.read_text())
    assert all(len(test["outcomes"]) == 3 for test in suite["tests"])
    assert file.read_text().count('"name"') == 5
    # The same driver: nothing changes, and every criterion of change is met.
    regression = ("--fail-on", "regression")
    same = ds("suite", "run", file, "--driver", "autopilot", "--out", tmp_path / "same", *regression)
    assert same.returncode == 0 and "identically, to the bit" in same.stdout, same.stderr
    # Another one: some test newly fails.
    out, junit, summary = tmp_path / "other", tmp_path / "junit.xml", tmp_path / "summary.md"
    files = ("--junit", junit, "--markdown", summary, "--update", tmp_path / "updated.json")
    other = ds("suite", "run", file, "--driver", "other", "--out", out, *regression, *files)
    tests = json.loads((out / "comparison.json").read_text())["tests"]
    newly = sum(test["change"] == "newly fails" for test in tests)
    assert newly > 0 and other.returncode == 3 and "not passed:" in other.stderr
    assert int(ElementTree.parse(junit).getroot().get("failures", "")) == newly
    assert "Pass criterion not met" in summary.read_text() == (out / "comparison.md").read_text()
    # The updated suite expects what the other driver did.
    updated = ds("suite", "run", tmp_path / "updated.json", "--driver", "other", "--out", out, *regression)
    assert updated.returncode == 0 and "identically" in updated.stdout


def test_drives_end_as_soon_as_the_answer_is_sure(tmp_path: Path, engine: Engines) -> None:
    old, file, out = campaign(tmp_path / "old"), tmp_path / "suite.json", tmp_path / "out"
    ds("suite", "make", old, "--out", file, "--tests", 8)
    run = ("suite", "run", file, "--driver", "other", "--stop-early", "--out")
    ended = ds(*run, out, "--fail-on", "regression")
    assert ended.returncode == 3 and "ended after 5 of 8 tests" in ended.stderr
    assert sum(len(executor.roads) for executor in engine) == 15
    whole = ds(*run, tmp_path / "all", "--max-failures", "100%")
    assert whole.returncode == 0 and len(json.loads((tmp_path / "all/comparison.json").read_text())["tests"]) == 24
    assert "--stop-early needs --fail-on" in refusal(*run, out)
    assert "is for two networks" in refusal("compare", old, "other", "--out", tmp_path / "c", "--stop-early")
    drives = sum(len(executor.roads) for executor in engine)
    options = ("--roads", 60, "--sims", "bullet", "--stop-early", "--out", out / "c")
    (bullet,) = document("compare", "autopilot", "other", *options)["simulators"]
    assert bullet["tests"] % 5 == 0
    assert sum(len(executor.roads) for executor in engine) - drives == 2 * bullet["tests"]
    assert bullet["tests"] == 60 or bullet["interval"][1] < 0.1 or bullet["verdict"] == "worse"


def test_a_suite_with_conditions_drives_no_autopilot(tmp_path: Path, engine: Engines) -> None:
    file = tmp_path / "suite.json"
    assert ds("suite", "make", campaign(tmp_path / "old"), "--out", file, "--tests", 2).returncode == 0
    suite = json.loads(file.read_text())
    suite["tests"][0]["conditions"] = "visibility=60"
    file.write_text(json.dumps(suite))
    tests = document("suite", "run", file, "--driver", "autopilot", "--out", tmp_path / "out")["tests"]
    assert {test["conditions"] for test in tests} == {"", "visibility=60"}


(TEST,) = suite_of(1)["tests"]
MOVED = TEST | {"control_points": [[x + 1.0, y] for x, y in TEST["control_points"]]}
OF_CODE = TEST | {"outcomes": TEST["outcomes"] | {"nowhere:Code": TEST["outcomes"]["bullet"]}}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"version": 2}, "made by a newer version of ds (suite version 2, expected 1)"),
        ({"version": "x"}, "made by another version of ds"),
        ({"format": "other"}, "no suite, expected a file of `ds suite make`"),
        ({"surprise": 1}, "surprise: there is no such key"),
        ({"tests": []}, "expected at least 1 of them"),
        ({"tests": [MOVED]}, "does not match its digest"),
        ({"siblings": ["bullet", "nowhere:Code"], "tests": [OF_CODE]}, "--trust"),
    ],
)
def test_a_suite_that_cannot_be_run_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, Any], problem: str
) -> None:
    (tmp_path / "suite.json").write_text(json.dumps(suite_of(1) | change))
    words = ("suite", "run", tmp_path / "suite.json", "--driver", "autopilot", "--out", tmp_path / "out")
    assert problem in refusal(*words)


@pytest.mark.parametrize("size", SIZES)
def test_the_template_names_every_key_and_is_what_was_asked_for(
    tmp_path: Path, size: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = template("my nets/a: b.yaml", [BULLET, PANDA], DONKEY, size)
    path = Path("campaign.yaml")
    path.write_text(text)
    asked = CampaignConfig(driver=DriverName("my nets/a: b.yaml"), siblings=[BULLET, PANDA], search=SIZES[size])
    assert read_config(path) == asked
    assert all(f"{key}:" in text for key in CampaignConfig.model_fields)
    assert all(f"{key}:" in text for key in type(asked.search).model_fields)
    assert f"{asked.executions_at_most} drives" in text.splitlines()[0]


def test_a_campaign_searches_the_conditions_that_a_sensitivity_found(tmp_path: Path, configs: Configs) -> None:
    """From the simulator's own world to where the median simulator fails; each end of a signed condition counts."""
    levels: dict[str, list[int | None]] = {
        "visibility": [2, 4, 8],
        "camera_yaw": [6, None, 8],
        "lens_dirt": [8, 12, None],
        "illuminance": [10, None, None],
        "shadow_depth": [1, 1, 1],
    }
    factors = factors_named(list(levels))
    names = tuple(map(SimulatorName, "abc"))
    thresholds = {}
    for number, factor in enumerate(factors):
        for name, level in zip(names, levels[factor.name], strict=True):
            thresholds[number, str(name)] = Threshold(
                simulator=name,
                factor=factor,
                verdict="fails" if level else "completes",
                roads=[RoadResult(completes=(level or 17) - 1, fails=level)],
            )
    found = Sensitivity(driver=AUTOPILOT, simulators=names, factors=factors, needed=1, roads={}, thresholds=thresholds)
    (tmp_path / "sensitivity.json").write_text(json.dumps(found.document()))
    file = tmp_path / "out/campaign.yaml"
    words = ("test", "autopilot", "--sims", "bullet,donkey", "--sensitivity", tmp_path, "--out", file.parent)
    assert ds(*words).returncode == 0
    searched = {name: (one.low, one.high) for name, one in configs[0][0].search.conditions.items()}
    # Visibility is even in 1 / m: level 4 of 16 up to 20 m is 80 m; yaw is even, level 8 of 16 up to 0.15 rad.
    assert searched == {"visibility": (80.0, 1000.0), "camera_yaw": (-0.075, 0.075)}
    assert "    # lens_dirt: {low: 0, high: 0.375}" in file.read_text() and "illuminance" not in file.read_text()
    for content in ("{}", "[", '{"thresholds": [{"condition": "visibility"}]}'):
        (tmp_path / "sensitivity.json").write_text(content)
        assert "sensitivity" in refusal(*words)
    (tmp_path / "sensitivity.json").unlink()
    assert "sensitivity" in refusal(*words)


@pytest.fixture
def configs(monkeypatch: pytest.MonkeyPatch) -> Configs:
    """Configurations that `ds test` was about to run, and their folders."""
    tested: Configs = []

    def run(config: CampaignConfig, out: Path, **_: object) -> Result:
        tested.append((config, out))
        return DONE

    monkeypatch.setattr("ds_cli.campaign.run.campaign", run)
    return tested


def test_a_test_of_a_network_is_a_campaign_without_a_file_to_write(
    tmp_path: Path, configs: Configs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert ds("test", "autopilot", "--sims", "bullet,donkey").returncode == 0
    (config, out), written = configs[0], Path("autopilot_test/campaign.yaml")
    assert out == written.parent and config.search.max_angle == 300
    assert config.engine == "local" and config.identity() == read_config(written).identity()
    angles = ("--min-angle", 20, "--max-angle", 60)
    assert ds("test", "autopilot", "--sims", "bullet", *angles, "--out", "gentle").returncode == 0
    gentle = configs.pop()[0]
    assert (gentle.search.min_angle, gentle.search.max_angle, gentle.twin) == (20, 60, None)
    huge = refusal("test", "autopilot", "--sims", "bullet", "--size", "huge", "--out", "huge")
    assert "expected one of small, medium, paper" in huge
    # The same test goes on; another one does not write over it.
    assert ds("test", "autopilot", "--sims", "bullet,donkey", "--engine", "graph").returncode == 0
    assert (configs[1][0].engine, configs[1][0].workers) == ("graph", 1)
    other = refusal("test", "autopilot", "--sims", "bullet,donkey", "--size", "medium")
    assert "holds another test: choose another --out" in other
    assert ds("test", "autopilot", "--sims", "bullet,donkey", "--seed", 7, "--out", "seventh").returncode == 0
    assert read_config(Path("seventh/campaign.yaml")).seed == 7


def test_a_test_that_fails_may_end_with_status_3(tmp_path: Path, engine: Engines) -> None:
    done = ds("test", "dave2", "--sims", "bullet,donkey", "--fail-on", "failure", "--out", tmp_path / "out")
    assert done.returncode == 3 and "not passed: " in done.stderr and "next: ds " in done.stderr, done.stderr
    first, _, rest = done.stderr.partition("first answer after ")[2].partition("the test goes on, and replaces this")
    assert "from 6 of 12 tests:\n  dave2 failed on " in first and "report.html" in first and "finished in" in rest
    assert Path(done.stdout.splitlines()[-1]) == tmp_path / "out" / "report.html"


def test_a_dry_run_forecasts_from_one_drive_on_each_simulator_and_writes_nothing(
    tmp_path: Path, engine: Engines
) -> None:
    file = tmp_path / "campaign.yaml"
    file.write_text("{driver: autopilot, search: {population: 3, iterations: 2, runs: 2}, conditions: visibility=60}")
    found = document("campaign", "run", file, "--out", tmp_path / "new/deep", "--dry-run")
    assert sorted(simulator for simulator, _ in engine[0].roads) == ["bullet", "donkey", "softbody"]
    # 2 siblings x 2 searches x 5 tests on 3 simulators, and as many drives of the autopilot for their gates.
    assert (found["drives"], found["search_drives"], found["searches"], found["gate_drives"]) == (60, 20, 4, 60)
    assert found["disk"] > 0 and found["seconds"] >= 0 and not (tmp_path / "new").exists()
    assert ds("campaign", "run", file, "--out", tmp_path, "--dry-run", "--attach").returncode == 2


def test_a_forecast_takes_as_long_as_all_drives_or_the_longest_searches() -> None:
    measured = tuple(MeasuredDrive(simulator=SimulatorName(name), outcome="", seconds=10.0, disk=100) for name in "abc")
    search = {"drives": 60, "search_drives": 20, "searches": 2, "gate_drives": 0}
    forecast = Forecast(**search, start_seconds=5.0, measured=measured, free=0)
    # 60 drives of 10 s, three at a time; or 30 of one search, one after the other, and the rest meanwhile.
    assert forecast.seconds == pytest.approx(5 + 60 * 10 / 3) and forecast.disk == 6000
    assert replace(forecast, searches=1, search_drives=30).seconds == pytest.approx(5 + 30 * 10)


def test_a_campaign_is_held_against_criteria(tmp_path: Path) -> None:
    folder, junit = campaign(tmp_path / "old"), tmp_path / "junit.xml"
    with closing(Store(folder / "campaign.sqlite")) as store:
        failures = sum(execution.outcome.is_failure for execution in store.executions())
    assert judged(DONE, folder, CampaignCriteria()) is DONE
    unmet = judged(DONE, folder, CampaignCriteria(fail_on="failure", junit=junit)).unmet
    assert len(unmet) == 1 and unmet[0].startswith("tests fail: ")
    root = ElementTree.parse(junit).getroot()
    assert (root.get("tests"), root.get("failures")) == ("24", str(failures))
    for option in ("regression", "worse"):
        assert refusal("campaign", "run", tmp_path / "none.yaml", "--out", tmp_path / "x", "--fail-on", option)


def test_an_error_prevails_over_a_criterion() -> None:
    end(DONE, True)
    for error, unmet, status in ((False, ["a"], 3), (True, ["a"], 1), (True, [], 1)):
        with pytest.raises(typer.Exit) as exit_:
            end(replace(DONE, error=error, unmet=unmet), True)
        assert exit_.value.exit_code == status


SMALL = {"population": 4, "iterations": 8, "runs": 1}
PASS, FAIL = {"bullet": (0, 24), "donkey": (0, 24)}, {"bullet": (24, 24), "donkey": (24, 24)}


def config(**search: Any) -> CampaignConfig:
    return CampaignConfig(driver=AUTOPILOT, siblings=[BULLET], search=SearchConfig(**{**SMALL, **search}))


def pasted(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> CampaignConfig:
    """The configuration that a proposed command writes, and would run."""
    monkeypatch.chdir(folder)
    words = shlex.split(command)
    assert ds(*words[1:]).returncode == 0
    return read_config(folder / words[-1] / "campaign.yaml")


@pytest.mark.usefixtures("configs")
@pytest.mark.parametrize(
    ("tally", "before", "words", "angles"),
    [
        (PASS, config(), "All 48 drives on bullet, donkey pass", WINDING),
        (FAIL, config(), "All 48 drives on bullet, donkey fail", GENTLE),
        (FAIL, config(conditions={"visibility": {"low": 20, "high": 90}}, min_angle=90), "leave out", (90, 300)),
    ],
)
def test_other_roads_are_proposed_where_everything_comes_out_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Any, before: CampaignConfig, words: str, angles: Any
) -> None:
    found = proposal(tally, before)
    assert found is not None and words in found[0]
    after = pasted(found[1], tmp_path, monkeypatch)
    assert (after.search.min_angle, after.search.max_angle) == angles
    assert after.search.conditions == {} and after.simulators == before.simulators


@pytest.mark.usefixtures("configs")
def test_two_siblings_without_a_twin_stay_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = parse_config({"driver": "autopilot", "twin": "none", "search": SMALL}, "here")
    found = proposal(FAIL, before)
    assert found is not None
    after = pasted(found[1], tmp_path, monkeypatch)
    assert (after.siblings, after.twin) == (before.siblings, None)


def test_at_the_ends_of_the_range_something_else_is_proposed() -> None:
    hard, easy = proposal(PASS, config(min_angle=WINDING[0])), proposal(FAIL, config(min_angle=10, max_angle=60))
    assert hard is not None and hard[1].startswith("ds sensitivity --driver autopilot --sims bullet,donkey")
    assert easy is not None and easy[1].startswith("ds drive --sim bullet --driver autopilot")


def test_nothing_is_proposed_where_tests_differ_or_nothing_was_driven() -> None:
    for tally in ({}, {"bullet": (0, 0)}, {"bullet": (0, 24), "donkey": (1, 24)}, {"bullet": (24, 24), "d": (0, 24)}):
        assert proposal(tally, config()) is None
