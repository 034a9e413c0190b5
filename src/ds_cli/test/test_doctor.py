# SPDX-License-Identifier: Apache-2.0
"""What `ds doctor` looks at, and errors: one line for what a user can cause, a traceback in a file for what we can."""

from __future__ import annotations

import json
import os
import re
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from installed_package import write_package

from ds_base import InputError, RunError
from ds_cli import doctor
from ds_cli.application import BUG, run
from ds_cli.doctor import Check

REPOSITORY = Path(__file__).resolve().parents[3]


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_an_old_python_without_a_compiler_gets_the_commands_to_type() -> None:
    checks = by_name(doctor.check_system(version=(3, 10), which=lambda _: None))
    assert not checks["Python"].ok and "3.10" in checks["Python"].detail
    assert not checks["C++ compiler"].ok and checks["C++ compiler"].fix.endswith("apt-get install -y g++")


@pytest.mark.parametrize("imports", [False, True])
def test_libraries_are_looked_up_and_keep_standard_output_clean(
    capfd: pytest.CaptureFixture[str], imports: bool
) -> None:
    wanted = {"numpy": "numpy", "no-such-thing": "no_such_thing"}
    found = doctor.look_up(Path(sys.executable), wanted, imports=imports)
    assert found["numpy"] == (metadata.version("numpy"), "") and "no_such_thing" in found["no-such-thing"][1]
    assert capfd.readouterr().out == ""


def test_an_installed_library_that_cannot_be_imported_is_found_by_importing_it(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("raise OSError('libbroken.so: cannot open shared object file')\n")
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nPYTHONPATH={tmp_path} exec {sys.executable} "$@"\n')
    python.chmod(0o755)
    assert "libbroken.so" in doctor.look_up(python, {"broken": "broken"}, imports=True)["broken"][1]


def test_a_missing_renderer_is_no_problem_but_named() -> None:
    def no_library(name: str) -> object:
        raise OSError(f"{name}: cannot open shared object file")

    found = doctor.check_renderer(no_library)
    assert found.ok and "libEGL.so.1" in found.detail and "apt-get install -y libegl1" in found.detail


def test_parts_of_installed_packages_are_listed_with_what_they_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "theirs.py").write_text(
        "class Simulator:\n    @staticmethod\n    def missing():\n        return 'no engine: apt-get install engine'\n"
    )
    write_package(tmp_path, "simulators", {"mine": "theirs:Simulator"})
    write_package(tmp_path, "operators", {"max": "theirs:MAX"})
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    checks = by_name(doctor.check_parts(Path(sys.executable)))
    assert checks["simulator mine"].detail == "of theirs 1.2: no engine: apt-get install engine"
    assert not checks["simulator mine"].ok and "no attribute 'MAX'" in checks["operator max"].detail


def test_a_healthy_environment_passes() -> None:
    """The environment of the tests: every library has its pinned version, and its module the right name."""
    pins = doctor.read_pins(REPOSITORY / "requirements/project.txt")
    owners = metadata.packages_distributions()
    modules = {name: doctor.module_of(name) for name in pins}
    for name, module in modules.items():
        found = {owner.lower().replace("-", "_") for owner in owners.get(module, [])}
        assert name.replace("-", "_") in found, f"{module} does not belong to {name}"
    places = doctor.look_up(Path(sys.executable), modules)
    checks = [doctor.check_library(name, places[name], "fix", pinned=pinned) for name, pinned in pins.items()]
    assert [check for check in checks if not check.ok] == []


def test_no_advice_deletes_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for file, text in (("project.txt", "torch==2.13.0"), ("dask.txt", "distributed==2026.8.0")):
        (tmp_path / "requirements").mkdir(exist_ok=True)
        (tmp_path / "requirements" / file).write_text(text)
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / ".venv/bin/python").symlink_to(sys.executable)
    monkeypatch.setattr(doctor, "look_up", lambda _, wanted, **__: dict.fromkeys(wanted, ("", "no module")))
    checks = by_name(doctor.diagnose(tmp_path))
    assert not checks["torch"].ok and checks["torch"].fix == "rm -rf .venv/.setup && make setup"
    deleting = {check.fix for check in checks.values() if re.search(r"\brm\b", check.fix)}
    assert deleting == {checks["torch"].fix}


def test_an_interpreter_that_dies_is_reported_for_each_library(tmp_path: Path) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\nexit 139\n")
    broken.chmod(0o755)
    assert "139" in doctor.look_up(broken, {"numpy": "numpy"})["numpy"][1]


@pytest.mark.parametrize(
    ("installed", "absent", "ok", "told"),
    [
        (("2.13.0+cpu", ""), "", True, "2.13.0"),
        (("2.14.0", ""), "", False, "2.13.0 is pinned"),
        (("", "no module"), "", False, "no module"),
        (("2.13.0", ""), ", for speed", True, "2.13.0"),
        (("", "no module"), ", for speed", True, "not installed; optional, for speed"),
        (("2.14.0", ""), ", for speed", False, "2.13.0 is pinned"),
    ],
)
def test_a_library_must_have_the_pinned_version_unless_it_is_optional_and_absent(
    installed: tuple[str, str], absent: str, ok: bool, told: str
) -> None:
    check = doctor.check_library("torch", installed, "make setup", pinned="2.13.0", absent=absent)
    assert check.ok is ok and told in check.detail and bool(check.fix) is not ok


def test_torn_weights_are_noticed(tmp_path: Path) -> None:
    file = tmp_path / "dave2.safetensors"
    assert "missing" in doctor.check_weights(file).detail
    file.write_bytes(b"version https://example.invalid/pointer")
    assert "truncated" in doctor.check_weights(file).detail
    file.write_bytes(bytes(doctor.SMALLEST_WEIGHTS))
    assert doctor.check_weights(file).ok


def test_without_an_environment_the_answer_is_make_setup(tmp_path: Path) -> None:
    checks = by_name(doctor.diagnose(tmp_path))
    assert checks["environment"] == Check("environment", False, ".venv is not there yet", "make setup")


def test_json_is_one_document(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor, "repository", lambda: tmp_path)
    assert doctor.main(["--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["ok"] is False
    assert {"name", "ok", "detail", "fix"} == set(document["checks"][0])


def failing(error: Exception) -> object:
    def verb(*_: object, **__: object) -> None:
        raise error

    return verb


@pytest.mark.parametrize(
    ("error", "status"),
    [(InputError("road.json: no road"), 2), (RunError("the simulator ended"), 1), (OSError(28, "No space left"), 2)],
)
def test_what_a_user_can_cause_is_one_line(
    error: Exception, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ds_road.read_roads", failing(error))
    monkeypatch.setattr("ds_road.read_raw_roads", failing(error))
    assert run(["road", "check", "roads.json"]) == status
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and "bug" not in lines[0]


@pytest.mark.parametrize("debug", [False, True])
def test_a_shape_error_of_ours_is_a_bug_with_a_traceback_in_a_file(
    debug: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> object:
        return np.ones(3) + np.ones(4)

    monkeypatch.setattr("ds_road.read_raw_roads", broken)
    assert run([*(["--debug"] if debug else []), "road", "check", "roads.json"]) == BUG == 70
    shown = capsys.readouterr().err
    assert ("Traceback" in shown) is debug
    last = shown.splitlines()[-1]
    assert "this is a bug of ds (ValueError), not of your input" in last
    found = re.search(r"report (\S+)$", last)
    assert found
    log = Path(found[1])
    assert "could not be broadcast" in log.read_text() and "ds " in log.read_text().splitlines()[0]
    log.unlink()
