"""`ds` from outside: one JSON document on standard output, one line per problem, and the exit status."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ds_road import Road, generate, write_roads

DS = [sys.executable, "-m", "ds_orchestrator.cli.main"]


def ds(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*DS, *map(str, arguments)], capture_output=True, text=True, timeout=120)


def test_road_check_answers_for_every_road_whatever_it_is(tmp_path: Path) -> None:
    road = [[125, 25 * i] for i in range(9)]
    file = tmp_path / "roads.json"
    file.write_text(
        json.dumps([road, [[125, 25]], [[0, 0], [float("nan"), 1]], "nonsense", [[900, 25 * i] for i in range(9)]])
    )
    done = ds("road", "check", file, "--json")
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    keys = {"valid", "reason", "length", "curvature", "turns_count", "turns_count_maxitwo"}
    assert [a["valid"] for a in answers] == [True, False, False, False, False]
    assert all(set(a) == keys and bool(a["reason"]) == (not a["valid"]) for a in answers)
    assert answers[0]["length"] == pytest.approx(150.0) and answers[0]["turns_count"] == 0


def test_road_generate_can_be_checked_and_shown(tmp_path: Path) -> None:
    done = ds("road", "generate", "--seed", 4, "--count", 2)
    roads = json.loads(done.stdout)
    assert len(roads) == 2 and Road(roads[0]).validity.valid
    (tmp_path / "one.json").write_text(json.dumps(roads[0]))
    shown = ds("road", "show", tmp_path / "one.json", "--out", tmp_path / "road.png")
    assert shown.returncode == 0 and (tmp_path / "road.png").read_bytes().startswith(b"\x89PNG")
    people = ds("road", "check", tmp_path / "one.json")
    assert people.returncode == 0 and "yes" in people.stdout


def test_bad_input_ends_with_2_and_one_line(tmp_path: Path) -> None:
    import numpy as np

    two = tmp_path / "two.json"
    write_roads([generate(np.random.default_rng(s)) for s in (1, 2)], two)
    crossing = tmp_path / "crossing.json"
    crossing.write_text(json.dumps([[50, 50], [50, 100], [50, 150], [100, 150], [100, 110], [20, 110], [10, 60]]))
    sampled = tmp_path / "sampled.json"
    sampled.write_text(json.dumps([{"road_points": [[125, 10 * i] for i in range(1, 9)]}]))
    config = tmp_path / "c.yaml"
    config.write_text("siblings: [bulett]")
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(b"cut")
    cases: dict[str, tuple[object, ...]] = {
        "bulet": ("drive", "--sim", "bulet", "--driver", "autopilot"),
        "dave3": ("drive", "--sim", "donkey", "--driver", "dave3"),
        "missing": ("drive", "--sim", "donkey", "--driver", tmp_path / "none.safetensors"),
        "damaged": ("drive", "--sim", "donkey", "--driver", cut),
        "2 roads": ("drive", "--sim", "donkey", "--driver", "autopilot", "--road", two),
        "give its control points": ("drive", "--sim", "donkey", "--driver", "autopilot", "--road", sampled),
        "not valid": ("drive", "--sim", "donkey", "--driver", "autopilot", "--road", crossing),
        "No such file": ("road", "check", tmp_path / "none.json"),
        "unknown simulator": ("campaign", "run", config, "--out", tmp_path / "out"),
        "no campaign": ("maps", tmp_path),
        "no drives": ("train", "--data", tmp_path, "--out", tmp_path / "t"),
    }
    for named, arguments in cases.items():
        done = ds(*arguments, *(["--json"] if arguments[0] in ("drive", "maps") else []))
        assert done.returncode == 2, (named, done.stderr)
        assert done.stdout == "", named
        lines = done.stderr.strip().splitlines()
        assert len(lines) == 1 and named in lines[0], (named, lines)


def test_unknown_verbs_and_options_end_with_2() -> None:
    for arguments in (("fly",), ("drive",), ("drive", "--sim", "donkey", "--seed", "minus one")):
        done = ds(*arguments)
        assert done.returncode == 2 and "Traceback" not in done.stderr


@pytest.mark.graph
def test_drive_answers_with_one_document_and_repeats_itself() -> None:
    runs = [ds("drive", "--sim", "donkey", "--driver", "autopilot", "--seed", 5, "--json") for _ in range(2)]
    first, second = (json.loads(run.stdout) for run in runs)
    assert runs[0].returncode == 0 and first["outcome"] == "COMPLETED"
    assert {"fitness", "max_lateral_position", "steps", "simulated_seconds", "wall_seconds"} <= set(first)
    assert len(first["trajectory_sha256"]) == 64
    assert {**first, "wall_seconds": 0} == {**second, "wall_seconds": 0}
    assert first["simulated_seconds"] == pytest.approx(first["steps"] / 20)


def test_a_tub_that_says_nothing_of_the_motion_is_refused(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('[]\n[]\n{}\n{}\n{"paths": ["catalog_0.catalog"], "deleted_indexes": []}')
    row = {"_index": 0, "_timestamp_ms": 5, "user/angle": 0.1, "user/throttle": 0.2}
    (tmp_path / "catalog_0.catalog").write_text(json.dumps(row))
    done = ds("twin", "fit", tmp_path, "--out", tmp_path / "car.yaml")
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1
    assert "position or speed" in done.stderr and not (tmp_path / "car.yaml").exists()
