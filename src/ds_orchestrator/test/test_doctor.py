from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from ds_orchestrator import doctor
from ds_orchestrator.doctor import Check

REPOSITORY = Path(__file__).resolve().parents[3]


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_an_old_python_without_a_compiler_is_told_what_to_type() -> None:
    checks = by_name(doctor.check_system(version=(3, 10), which=lambda _: None))
    assert not checks["Python"].ok
    assert "3.10" in checks["Python"].detail
    assert not checks["C++ compiler"].ok
    assert checks["C++ compiler"].fix.endswith("apt-get install -y g++")


def test_what_is_well_needs_no_fix() -> None:
    checks = doctor.check_system(version=(3, 12), which=lambda name: f"/usr/bin/{name}")
    assert all(check.ok != bool(check.fix) for check in checks)
    assert by_name(checks)["C++ compiler"].detail == "/usr/bin/c++"


def test_imports_are_tried_for_real_and_keep_standard_output_clean(capfd: pytest.CaptureFixture[str]) -> None:
    found = doctor.try_imports(Path(sys.executable), {"numpy": "numpy", "no-such-thing": "no_such_thing"})
    version, problem = found["numpy"]
    assert not problem
    assert version.split(".")[0].isdigit()
    assert "no_such_thing" in found["no-such-thing"][1]
    assert capfd.readouterr().out == ""


def test_an_interpreter_that_dies_is_reported_for_each_library(tmp_path: Path) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\nexit 139\n")
    broken.chmod(0o755)
    assert "139" in doctor.try_imports(broken, {"numpy": "numpy"})["numpy"][1]


@pytest.mark.parametrize(
    ("installed", "ok"), [(("2.13.0+cpu", ""), True), (("2.14.0", ""), False), (("", "no module"), False)]
)
def test_a_library_must_have_the_pinned_version(installed: tuple[str, str], ok: bool) -> None:
    (check,) = doctor.check_libraries({"torch": "2.13.0"}, {"torch": installed})
    assert check.ok is ok
    assert bool(check.fix) is not ok


@pytest.mark.parametrize(
    ("installed", "ok", "told"),
    [
        (("2026.4.1-22982-releases", ""), True, "2026.4.1"),
        (("", "no module"), True, "not installed: an extra"),
        (("2025.1", ""), False, "2026.4.1 is pinned"),
    ],
)
def test_an_extra_may_be_absent_but_not_another_version(installed: tuple[str, str], ok: bool, told: str) -> None:
    (check,) = doctor.check_extras({"openvino": "2026.4.1"}, {"openvino": installed})
    assert check.ok is ok and told in check.detail and bool(check.fix) is not ok


def test_pins_are_those_of_the_direct_requirements() -> None:
    pins = doctor.read_pins(REPOSITORY / "requirements/project.txt")
    assert pins["torch"] == "2.13.0"
    assert "sympy" not in pins


def test_torn_weights_are_noticed(tmp_path: Path) -> None:
    file = tmp_path / "dave2.safetensors"
    assert "missing" in doctor.check_weights(file).detail
    file.write_bytes(b"version https://example.invalid/pointer")
    assert "torn" in doctor.check_weights(file).detail
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


def test_an_unknown_argument_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--yaml"]) == 2
    assert "--yaml" in capsys.readouterr().err
