# SPDX-License-Identifier: Apache-2.0
"""The wheel: everything that needs no ROS is in it, and it runs without a checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from tests.test_docs import short_script

from ds_driver.networks.weights import APART

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The wheel, and that of the large networks."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [str(ROOT / "tools/wheel.sh"), str(folder)]
    subprocess.run(command, check=True, timeout=120, env={**os.environ, "PYTHON": sys.executable}, capture_output=True)
    names = (
        f"{name}-{PROJECT['version']}-py3-none-any.whl" for name in ("digital_siblings", "digital_siblings_networks")
    )
    first, second = (folder / name for name in names)
    assert set(folder.iterdir()) == {first, second}
    return first, second


@pytest.fixture(scope="module")
def wheel(wheels: tuple[Path, Path]) -> Path:
    return wheels[0]


def environment() -> dict[str, str]:
    """This process's environment, without what leads to a checkout or to ROS."""
    return {key: value for key, value in os.environ.items() if not re.match("PYTHON|AMENT|DS_|ROS|LD_", key)}


def tracked(*patterns: str) -> set[str]:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}


def contents(wheel: Path) -> set[str]:
    return {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}


def test_every_file_of_the_packages_is_in_one_of_the_wheels_and_nothing_else(wheels: tuple[Path, Path]) -> None:
    packages = {
        "/".join(Path(path).parts[2:]) for path in tracked("src/ds_*/ds_*") if not re.search("/(resource|ros)/", path)
    }
    shared = {f"ds_base/share/{path[4:]}" for path in tracked("src/ds_interfaces/msg", "src/ds_bringup/config")}
    assert len(packages) > 300 and len(shared) > 10
    first, second = map(contents, wheels)
    apart = {f"ds_driver/models/{name}.{suffix}" for name in APART for suffix in ("json", "safetensors")}
    assert second == apart and first == packages - apart | shared
    assert wheels[0].stat().st_size < 25 * 10**6 and wheels[1].stat().st_size < 100 * 2**20  # the limit of indexes


def test_no_network_is_in_the_repository_twice() -> None:
    listed = subprocess.run(["git", "ls-files", "-s"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    files = [line.split() for line in listed.splitlines() if line.endswith((".safetensors", ".onnx"))]
    assert len(files) > 15 and len({digest for _, digest, *_ in files}) == len(files)


def test_the_core_asks_for_little_and_for_no_version_above_the_pins() -> None:
    """Whatever set-up installs is in the core or in an extra, from a version on that is not above the pinned one."""
    core, extras = PROJECT["dependencies"], PROJECT["optional-dependencies"]
    assert len(core) <= 15
    asked = {(one := Requirement(text)).name.lower(): one.specifier for text in chain(core, *extras.values())}
    del asked["digital-siblings"], asked["digital-siblings-networks"]
    files = [ROOT / f"requirements/{name}.txt" for name in ("project", "dask", "gym")]
    pins = dict(
        line.partition(" ")[0].split("==") for file in files for line in file.read_text().split("\n") if "==" in line
    )
    pinned = {name.lower(): version for name, version in pins.items()}
    assert all(specifier.contains(pinned[name]) for name, specifier in asked.items())
    direct = (ROOT / "requirements/project.txt").read_text().partition("# their dependencies")[0]
    brought = {"llvmlite", "rich"}  # by numba and typer
    named = {line.partition("==")[0].lower() for line in direct.splitlines() if "==" in line and line[0] != "#"}
    assert named - brought <= asked.keys()


def test_unpacked_it_runs_without_ros_and_checkout(wheel: Path, tmp_path: Path) -> None:
    """Isolated from the environment's paths: messages, configurations, networks and verbs are those of the wheel."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    script = f"""
import sys
sys.path[:] = [{str(tmp_path / "site")!r}] + [p for p in sys.path if "ds_" not in p and "ros_ws" not in p]
sys.modules.update(rclpy=None, ds_interfaces=None)
import ds_sim
assert ds_sim.__file__.startswith({str(tmp_path)!r})
from ds_bags.rosbag2_writer import typestore
from ds_driver.networks.network_driver import NetworkDriver
from ds_orchestrator import read_config
from ds_base.installation import share_folders
from ds_cli import main
print(sorted(name for name in typestore().types if name.startswith("ds_interfaces")))
files = [folder / "config/paper.yaml" for folder in share_folders("ds_bringup")]
paper = read_config(next(file for file in files if file.exists()))
print(paper.simulators, NetworkDriver("dave2").spec if hasattr(NetworkDriver, "spec") else "dave2")
for words in ("--version", "doctor", "drive --sim softbody --driver autopilot", "train --data . --out x"):
    sys.argv = ["ds", *(verb := words.split())]
    if verb[0] == "train":
        sys.modules["torch"] = None
    try:
        main.main()
    except SystemExit as done:
        print(verb[0], done.code, flush=True)
"""
    command = [sys.executable, "-I", "-c", script]
    alone = environment() | {"PYTHONPATH": str(tmp_path / "site")}  # for processes that it starts
    done = subprocess.run(command, cwd=tmp_path, env=alone, capture_output=True, text=True, timeout=120)
    assert "ds_interfaces/msg/Road" in done.stdout and "dave2" in done.stdout, done.stderr
    assert f"ds {PROJECT['version']}\n" in done.stdout and "checks passed\n" in done.stdout, done.stdout
    assert "doctor 0\n" in done.stdout and "drive 0\n" in done.stdout and "train 1\n" in done.stdout, done.stdout
    assert (
        "error: this needs torch, which is not installed: python -m pip install 'digital-siblings[torch]'"
        in done.stderr
    )
    assert "Traceback" not in done.stderr


@pytest.mark.long
def test_in_an_empty_environment_it_drives_tests_checks_and_reports(wheel: Path, tmp_path: Path) -> None:
    """Installs it without extras, from the package index, under the newest versions; takes minutes."""

    def run(*words: object) -> str:
        done = subprocess.run(
            list(map(str, words)), cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=1200
        )
        assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr[-2000:]
        return done.stdout

    run("uv", "venv", "--python", sys.executable, tmp_path / "env")
    run("uv", "pip", "install", "--python", tmp_path / "env", wheel)
    ds = tmp_path / "env/bin/ds"
    assert "completed" in run(ds, "drive", "--sim", "softbody", "--video", "drive.mp4")
    assert "dave2 is connected" in run(ds, "check", "dave2")
    (tmp_path / "small.yaml").write_text("siblings: [softbody]\nsearch: {population: 2, iterations: 1, runs: 1}\n")
    run(ds, "campaign", "run", "small.yaml", "--out", "out", "--workers", 2)
    report = tmp_path / "out/report.html"
    report.unlink()
    assert str(report.relative_to(tmp_path)) in run(ds, "report", "out") and report.is_file()
    (tmp_path / "page.py").write_text(short_script(gymnasium=False))
    run("uv", "pip", "install", "--python", tmp_path / "env", f"{wheel}[analysis,bullet,recording]")
    run(tmp_path / "env/bin/python", "page.py")
    assert (tmp_path / "campaign/report.html").is_file() and list((tmp_path / "campaign/bags").iterdir())
