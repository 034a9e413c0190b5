# SPDX-License-Identifier: Apache-2.0
"""`ds` as a command: one JSON document on standard output, one line per error, and the exit status."""

from __future__ import annotations

import ast
import json
import os
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_campaigns import make_execution
from tests.command_line import document, ds, ds_process, refusal
from tests.drives import driven

from ds_base.table import Column, Table
from ds_cli import application
from ds_cli.output import ScreenProgress
from ds_cli.prediction.predict import tables_result
from ds_cli.verbs import VERBS, overview
from ds_orchestrator.campaign import executor
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.store.model import Origin, Test
from ds_orchestrator.store.store import Store
from ds_road import Road, generate, read_roads, write_roads
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import BULLET
from ds_sim.scenario import Scenario

DS = [sys.executable, "-m", "ds_cli.main"]
REPOSITORY = Path(__file__).resolve().parents[1]
BICYCLE = "examples.bicycle:BicycleSimulator"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of four roads on two siblings and a twin; the second and third road fail everywhere."""
    folder = tmp_path_factory.mktemp("campaign")
    raw = {"siblings": ["bullet", "softbody"], "twin": "donkey", "driver": "autopilot"}
    store = Store(folder / "campaign.sqlite", config=parse_config(raw, "here").identity())
    for number in range(4):
        scenario = Scenario(generate(np.random.default_rng(number)), seed=100 + number)
        test = Test(f"bullet-0-{number:04d}", scenario, Origin(BULLET, 0, number))
        store.add_test(test)
        for simulator in ("bullet", "softbody", "donkey"):
            failed = number in (1, 2) and simulator != "softbody"
            store.add_execution(make_execution(test, simulator, 2.5 if failed else 0.5))
    store.close()
    return folder


@pytest.mark.parametrize("arguments", [(), ("-h",), ("--help",), ("--version",), ("completion", "zsh"), ("help",)])
def test_help_version_and_completion_need_the_standard_library_alone(arguments: tuple[str, ...]) -> None:
    script = f"""
import sys
sys.path.insert(0, {str(REPOSITORY / "src/ds_cli")!r})
sys.argv = {["ds", *arguments]!r}
from ds_cli.main import main
main()"""
    done = subprocess.run([sys.executable, "-I", "-S", "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == (0 if arguments else 2) and done.stderr == "" and done.stdout
    if arguments == ("--version",):
        project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
        assert done.stdout == f"ds {project['version']}\n"


def test_the_overview_says_of_every_verb_what_its_own_help_says() -> None:
    app: Any = application.make_app()
    for name, verb in VERBS.items():
        assert f"  {name} " in overview()
        if not verb.module:
            continue
        command = app.get_command(None, name)
        assert command.help.splitlines()[0] == verb.summary, name
        assert tuple(getattr(command, "commands", ())) == verb.verbs, name


def test_every_help_text_has_an_example_that_its_parser_takes() -> None:
    def commands(command: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
        inner = getattr(command, "commands", {})
        yield from (one for name in inner for one in commands(inner[name], *path, name))
        if not inner:
            yield path, command

    app: Any = application.make_app()
    for name, verb in VERBS.items():
        for path, command in commands(app.get_command(None, name), name) if verb.module else ():
            (example,) = (line for line in command.help.splitlines() if line.startswith("Example: ds "))
            words = shlex.split(example.removeprefix("Example: ds ").partition(" > ")[0])
            assert tuple(words[: len(path)]) == path
            command.make_context("ds", words[len(path) :])


def test_a_help_text_imports_nothing_heavy() -> None:
    verbs = [name for name, verb in VERBS.items() if verb.module]
    script = f"""
import sys
from ds_cli.application import run
for verb in {verbs!r}:
    run([verb, "--help"])
heavy = {{"numpy", "torch", "scipy", "shapely", "rclpy", "cv2", "pyarrow", "plotly", "onnx"}} & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage:") == len(verbs)


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("ds ma", "maps"),
        ("ds campaign ro", "roads"),
        ("ds bag redrive --vi", "--video"),
        ("ds drive --sim bul", "bullet"),
        ("ds drive --conditions visi", "visibility="),
        ("ds drive --conditions friction=0.5,visi", "friction=0.5,visibility="),
        ("ds sensitivity --conditions friction,visi", "friction,visibility"),
    ],
)
def test_tab_completes_verbs_options_and_simulators(typed: str, offered: str) -> None:
    words = typed.split(" ")
    asked = {"COMP_WORDS": typed, "COMP_CWORD": str(len(words) - 1), "_DS_COMPLETE": "complete_bash"}
    done = subprocess.run(DS, capture_output=True, text=True, timeout=60, env={**os.environ, **asked})
    assert done.stdout.split() == [offered], done.stderr


def test_bash_completes_a_condition_after_another_one(tmp_path: Path) -> None:
    """Bash breaks words at `=`, and puts what it is given in place of the last part."""
    ds_there = tmp_path / "ds"
    ds_there.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ds_cli.main "$@"\n')
    ds_there.chmod(0o755)
    script = """
source <(ds completion bash | sed 's#/[^ ]*/ds 2>#ds 2>#')
COMP_LINE='ds drive --conditions friction=0.5,visi'
COMP_POINT=${#COMP_LINE} COMP_WORDS=(ds drive --conditions friction = 0.5,visi) COMP_CWORD=5
_ds_completion
echo "${COMPREPLY[@]}"
"""
    env = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=60, env=env)
    assert done.stdout.split() == ["0.5,visibility="], done.stderr


def test_from_a_cell_or_a_failure_to_its_roads(campaign: Path, tmp_path: Path) -> None:
    failed = ds("campaign", "roads", campaign, "--failed", "--out", tmp_path / "failed.json")
    assert failed.returncode == 0, failed.stderr
    roads = json.loads((tmp_path / "failed.json").read_text())
    assert [road["test_id"] for road in roads] == ["bullet-0-0001", "bullet-0-0002"]
    assert roads[0]["seed"] == 101 and roads[0]["outcomes"]["softbody"] == "COMPLETED"
    expected = [generate(np.random.default_rng(number)) for number in (1, 2)]
    assert read_roads(tmp_path / "failed.json") == expected
    assert json.loads(ds("campaign", "roads", campaign, "--failed", "--simulator", "softbody").stdout) == []
    turns, curvature = expected[0].turns_count, int(100 * expected[0].curvature)
    for cell in (f"{turns},{curvature / 100:.2f}", f"{turns},{curvature}"):
        found = json.loads(ds("campaign", "roads", campaign, "--cell", cell).stdout)
        assert "bullet-0-0001" in {road["test_id"] for road in found}
        assert all(road["cell"] == {"turns_count": turns, "curvature": curvature} for road in found)
    exported = ds("road", "export", tmp_path / "failed.json", "--out", tmp_path / "xodr")
    assert exported.stdout.splitlines() == [str(tmp_path / f"xodr/bullet-0-000{n}.xodr") for n in (1, 2)]


def test_maps_are_grids_of_every_simulator_with_one_scale(campaign: Path) -> None:
    every = ds("maps", campaign).stdout
    titles = ("All tests on bullet: ", "All tests on softbody: ", "Twin donkey: ", "Siblings merged: ")
    assert all(title in every for title in titles) and every.count(" 1  failure probability, on every map") == 1
    # 4 tests each; the second and third fail but on softbody.
    assert [every.count(f" {failing} of ") for failing in (0, 2)] == [2, 2]
    shown = ds("maps", campaign, "--map", "union_bullet")
    assert shown.returncode == 0, shown.stderr
    assert "All tests on bullet: failure probability" in shown.stdout and "merged" in shown.stdout
    assert "1/1" in shown.stdout and "0/1" in shown.stdout
    assert {"merged", "union_bullet", "twin_donkey"} <= set(document("maps", campaign))


def test_an_evaluation_is_short_unless_all_is_wanted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = [
        Table(name=name, title=title, columns=[Column("r", "number")], rows=[[0.5]])
        for name, title in (("rq2", "RQ2"), ("robustness_checks", "RQ2 in other ways"))
    ]
    tables_result(tables, tmp_path, "ds models", everything=False).show()
    short = capsys.readouterr().out
    assert "Not shown without --all: RQ2 in other ways" in short
    assert short.count("0.500") == 1 and (tmp_path / "robustness_checks.csv").is_file()
    tables_result(tables, None, "ds models", everything=True).show()
    assert capsys.readouterr().out.count("0.500") == 2


def test_lines_may_be_some_seconds_apart(capsys: pytest.CaptureFixture[str]) -> None:
    now = 0.0
    progress = ScreenProgress(lambda: now, every=3.0)
    progress.start(10)
    for _ in range(10):
        now += 1.0
        progress.advance(line="x")
    assert [line.split(";")[0] for line in capsys.readouterr().err.splitlines()] == ["3/10 x", "6/10 x", "9/10 x"]


def test_time_left_counts_what_this_call_did(capsys: pytest.CaptureFixture[str]) -> None:
    """Four of eight were done before; the others take 30 s each."""
    now = 0.0
    progress = ScreenProgress(lambda: now)
    progress.start(8)
    for number in range(8):
        now += 0.001 if number < 4 else 30.0
        progress.advance(line="x")
    left = ["", "", "", "", "; about 1 min 30 s left", "; about 1 min 00 s left", "; about 30 s left", ""]
    said = capsys.readouterr().err.splitlines()
    assert said == [f"{done}/8 x{words}" for done, words in enumerate(left, start=1)]


def test_road_check_answers_for_every_road_whatever_it_is(tmp_path: Path) -> None:
    road = [[125, 25 * i] for i in range(9)]
    file = tmp_path / "roads.json"
    file.write_text(
        json.dumps([road, [[125, 25]], [[0, 0], [float("nan"), 1]], "nonsense", [[900, 25 * i] for i in range(9)]])
    )
    answers = document("road", "check", file)
    keys = {"valid", "reason", "length", "curvature", "turns_count", "turns_count_maxitwo"}
    assert [a["valid"] for a in answers] == [True, False, False, False, False]
    assert all(set(a) == keys and bool(a["reason"]) == (not a["valid"]) for a in answers)
    assert answers[0]["length"] == pytest.approx(150.0) and answers[0]["turns_count"] == 0


def test_road_generate_can_be_checked_and_shown(tmp_path: Path) -> None:
    roads = json.loads(ds("road", "generate", "--seed", 4, "--count", 2).stdout)
    assert len(roads) == 2 and Road(roads[0]).validity.valid
    (tmp_path / "one.json").write_text(json.dumps(roads[0]))
    shown = ds("road", "show", tmp_path / "one.json", "--out", tmp_path / "road.png")
    assert shown.returncode == 0 and (tmp_path / "road.png").read_bytes().startswith(b"\x89PNG")
    people = ds("road", "check", tmp_path / "one.json")
    assert people.returncode == 0 and "yes" in people.stdout


def test_bad_input_ends_with_2_and_one_line(campaign: Path, tmp_path: Path) -> None:
    texts = {
        "crossing.json": "[[50, 50], [50, 100], [50, 150], [100, 150], [100, 110], [20, 110], [10, 60]]",
        "deep.json": "[" * 200_000,
        "c.yaml": "siblings: [bulett]",
        "deep.yaml": "siblings: " + "[" * 50_000,
        "cut.safetensors": "cut",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    crossing, deep, config, deep_config, cut = (tmp_path / name for name in texts)
    two, out = tmp_path / "two.json", tmp_path / "out"
    write_roads([generate(np.random.default_rng(s)) for s in (1, 2)], two)
    cases: tuple[tuple[str, tuple[object, ...]], ...] = (
        ("bullet, softbody, panda, donkey", ("drive", "--sim", "bulet", "--driver", "autopilot")),
        ("bullet, softbody, panda, donkey", ("drive",)),
        ("dave3", ("drive", "--sim", "donkey", "--driver", "dave3")),
        ("missing", ("drive", "--sim", "donkey", "--driver", tmp_path / "none.safetensors")),
        ("damaged", ("drive", "--sim", "donkey", "--driver", cut)),
        ("2 roads", ("drive", "--sim", "donkey", "--driver", "autopilot", "--road", two)),
        ("not valid", ("drive", "--sim", "donkey", "--driver", "autopilot", "--road", crossing)),
        ("expected a name that ends with .mp4", ("drive", "--sim", "donkey", "--video", tmp_path / "x.avi")),
        ("--seed", ("drive", "--sim", "donkey", "--seed", "minus one")),
        ("No such file", ("road", "check", tmp_path / "none.json")),
        ("not a regular file", ("road", "check", tmp_path)),
        ("not JSON", ("road", "check", deep)),
        ("is a file, expected a folder", ("road", "export", two, "--out", cut)),
        ("unknown simulator", ("campaign", "run", config, "--out", out)),
        ("deep", ("campaign", "run", deep_config, "--out", out)),
        ("file", ("campaign", "run", tmp_path, "--out", out)),
        ("no campaign", ("maps", tmp_path)),
        ("no map 'mergd'", ("maps", campaign, "--map", "mergd")),
        ("no test 'x'", ("campaign", "roads", campaign, "--test", "x")),
        ("such as", ("campaign", "roads", campaign, "--cell", "77,0.99")),
        ("no simulator 'bulet'", ("campaign", "roads", campaign, "--simulator", "bulet")),
        ("no drives", ("train", "--data", tmp_path, "--out", tmp_path / "t")),
        ("unknown verb 'flie'", ("flie",)),
        ("did you mean 'maps'", ("map",)),
        ("completion", ("completion", "tcsh")),
        ("at least two", ("siblings", "compare", "--sims", "donkey")),
        ("'rain': did you mean visibility (20 m or more) or friction", ("sensitivity", "--conditions", "rain")),
        ("--levels 5 is not possible: expected 2, 4, 8, 16", ("sensitivity", "--sims", "donkey", "--levels", "5")),
        ("expected two or three different features", ("maps", "out", "--axes", "curvature,curvature")),
        ("unknown feature 'length'", ("maps", "out", "--axes", "length,curvature")),
        ("no test in", ("maps", campaign, "--axes", "curvature,visible_contrast")),
        ("not among", ("siblings", "compare", "--sims", "donkey,softbody", "--twin", "bullet")),
        ("road 0 is not valid", ("siblings", "compare", "--file", crossing, "--driver", "autopilot")),
        ("--lane", ("drive", "--sim", "donkey", "--lane", "centre")),
        ("unknown condition 'fog'", ("drive", "--sim", "donkey", "--conditions", "fog=1")),
        ("expected 20 m or more", ("drive", "--sim", "donkey", "--conditions", "visibility=3")),
        ("bicycle cannot realise friction", ("drive", "--sim", BICYCLE, "--conditions", "friction=0.5")),
    )
    for named, arguments in cases:
        assert named in refusal(*arguments), arguments


@pytest.mark.graph
def test_a_drive_answers_with_one_document_repeats_itself_and_is_that_of_the_library(tmp_path: Path) -> None:
    road, text = tmp_path / "road.json", "steering_lag=0.3,tyre_pull=0.01"
    road.write_text(json.dumps([[125, 40], [125, 65], [128, 90], [131, 115], [131, 140]]))
    common = ("drive", "--sim", "donkey", "--driver", "autopilot", "--road", road, "--seed", 5, "--json")
    # Once by nodes, once without ROS.
    runs = [ds_process(*common, "--conditions", text, "--engine", engine) for engine in ("auto", "local")]
    first, second = (json.loads(run.stdout) for run in runs)
    assert runs[0].returncode == 0 and first["outcome"] == "COMPLETED" and first["warnings"] == []
    assert first["conditions"] == {"steering_lag": 0.3, "tyre_pull": 0.01}
    assert {"fitness", "max_lateral_position", "steps", "simulated_seconds", "wall_seconds"} <= set(first)
    assert {**first, "wall_seconds": 0} == {**second, "wall_seconds": 0}
    assert first["simulated_seconds"] == pytest.approx(first["steps"] / 20)
    (straight := tmp_path / "straight.json").write_text(json.dumps([[125, 10], [125, 50], [125, 90], [125, 130]]))
    assert document("drive", "--sim", "donkey", "--road", straight, "--engine", "local")["warnings"] == []
    run = driven("donkey", read_roads(road)[0], 5, parse_conditions(text))
    assert first["trajectory_sha256"] == executor.trajectory_sha256(run)


def named_commands() -> Iterator[tuple[str, list[str]]]:
    """Literal words of each `ds_command(...)`, both sides of a choice; what is no literal is skipped."""
    for path in (REPOSITORY / "src/ds_cli/ds_cli").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "ds_command":
                ways: list[list[str]] = [[]]
                for word in node.args:
                    sides = [word.body, word.orelse] if isinstance(word, ast.IfExp) else [word]
                    texts = [
                        side.value for side in sides if isinstance(side, ast.Constant) and isinstance(side.value, str)
                    ]
                    ways = [[*way, text] for way in ways for text in texts] if texts else ways
                yield from ((f"{path.stem}:{node.lineno}", way) for way in ways if is_whole(way))


def is_whole(words: list[str]) -> bool:
    """Whether literal words name a verb, and where it has verbs, one of them."""
    return bool(words) and words[0] in VERBS and len(words) > bool(VERBS[words[0]].verbs)


def test_commands_that_verbs_name_exist_with_their_options() -> None:
    named = list(named_commands())
    app: Any = application.make_app()
    assert len(named) > 30
    for where, (verb, *rest) in named:
        command = app.get_command(None, verb)
        if VERBS[verb].verbs:
            command = command.commands[rest.pop(0)]
        options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        assert {word for word in rest if word.startswith("-")} <= options, (where, verb, rest)
