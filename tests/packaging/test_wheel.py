# SPDX-License-Identifier: Apache-2.0
"""The wheel: everything that needs no ROS is in it, and it runs without a checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from tests.python_api_page import short_script

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [str(ROOT / "tools/wheel.sh"), "-d", str(folder)]
    subprocess.run(command, check=True, timeout=120, env={**os.environ, "PYTHON": sys.executable}, capture_output=True)
    (found,) = folder.glob("*.whl")
    assert found.name == f"digital_siblings-{PROJECT['version']}-py3-none-any.whl"
    return found


def tracked(*patterns: str) -> set[str]:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}


def test_every_file_of_the_packages_is_in_the_wheel_and_nothing_else(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    packages = {
        "/".join(Path(path).parts[2:]) for path in tracked("src/ds_*/ds_*") if not re.search("/(resource|ros)/", path)
    }
    shared = {f"ds_sim/share/{path[4:]}" for path in tracked("src/ds_interfaces/msg", "src/ds_bringup/config")}
    assert len(packages) > 300 and any(name.endswith(".safetensors") for name in packages) and len(shared) > 10
    assert {name for name in names if ".dist-info/" not in name} == packages | shared
    assert wheel.stat().st_size < 100 * 2**20  # the limit of package indexes for one file


def test_it_asks_for_what_set_up_installs_from_those_versions_on() -> None:
    """PyTorch and OpenVINO are extras: networks of ONNX drive without them."""
    lines = (ROOT / "requirements/project.txt").read_text().partition("# their dependencies")[0].splitlines()
    pinned = {line.replace("==", ">=") for line in lines if "==" in line and not line.startswith("#")}
    extras = PROJECT["optional-dependencies"]
    assert {*PROJECT["dependencies"], *extras["torch"], *extras["openvino"]} == pinned
    for name in ("dask", "gym"):
        pins = (ROOT / f"requirements/{name}.txt").read_text()
        assert all(requirement.replace(">=", "==") in pins.splitlines() for requirement in extras[name])


def test_unpacked_it_runs_without_ros_and_checkout(wheel: Path, tmp_path: Path) -> None:
    """Isolated from the environment's paths: messages, configurations, networks and verbs are those of the wheel."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    script = f"""
import sys
sys.path[:] = [{str(tmp_path / "site")!r}] + [p for p in sys.path if "ds_" not in p and "ros_ws" not in p]
sys.modules.update(rclpy=None, ds_interfaces=None)
import ds_sim
assert ds_sim.__file__.startswith({str(tmp_path)!r})
from ds_bags.messages import typestore
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
    command, elsewhere = [sys.executable, "-I", "-c", script], {k: v for k, v in os.environ.items() if k != "DS_ROOT"}
    done = subprocess.run(command, cwd=tmp_path, env=elsewhere, capture_output=True, text=True, timeout=120)
    assert "ds_interfaces/msg/Road" in done.stdout and "dave2" in done.stdout, done.stderr
    assert f"ds {PROJECT['version']}\n" in done.stdout and "checks passed\n" in done.stdout, done.stdout
    assert "doctor 0\n" in done.stdout and "drive 0\n" in done.stdout and "train 1\n" in done.stdout, done.stdout
    assert "error: this needs PyTorch, an extra: python -m pip install 'digital-siblings[torch]'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
def test_in_an_empty_environment_the_python_api_runs(wheel: Path, tmp_path: Path) -> None:
    """Installs it with its dependencies from the package index; takes minutes."""
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env/bin/python"
    environment = {key: value for key, value in os.environ.items() if not re.match("PYTHON|AMENT|DS_|ROS", key)}
    subprocess.run([python, "-m", "pip", "install", "--quiet", wheel], check=True, env=environment, timeout=1200)
    (tmp_path / "page.py").write_text(short_script(gymnasium=False))
    done = subprocess.run(
        [python, "page.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "campaign/report.html").is_file() and list((tmp_path / "campaign/bags").iterdir())
