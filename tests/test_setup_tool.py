# SPDX-License-Identifier: Apache-2.0
"""Logic of the set-up: system requirements, when a step is repeated, and the lock between two set-ups."""

from __future__ import annotations

import multiprocessing
import shutil
import sys
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest

from setup_tool import machine, ros, workspace
from setup_tool.console import SetupError
from setup_tool.machine import Python
from setup_tool.stamps import Stamps, one_at_a_time

REPOSITORY = Path(__file__).resolve().parents[1]


def python(*, whole: bool = True) -> Python:
    """This Python, with or without its headers and `venv`."""
    here = machine.describe(sys.executable)
    assert here is not None
    return Python(here.executable, here.version, has_headers=whole, has_venv=whole, has_rclpy=False)


def test_all_that_is_missing_is_named_in_one_line_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    clang = {"clang++", "clang"}  # another compiler than GCC will do
    assert machine.find_needs(python(), which=lambda name: name if name in clang else None) == []
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    needs = machine.find_needs(python(whole=False), which=lambda _: None)
    line = machine.missing_line(needs)
    assert "\n" not in line
    series = machine.debian_series(python())
    assert line.endswith(f"Type: sudo apt-get install -y g++ gcc {series}-dev {series}-venv")
    assert all(word in line for word in ("C++ compiler", "C compiler", "Python.h", "venv"))


def test_a_missing_renderer_is_named_with_its_packages(tmp_path: Path) -> None:
    def no_library(name: str) -> object:
        raise OSError(f"{name}: cannot open shared object file")

    needs = machine.find_renderer_needs(no_library, [tmp_path])
    assert machine.apt_command(needs)[3:] == ["libegl1", "libegl-mesa0", "libgl1-mesa-dri"]
    (tmp_path / "swrast_dri.so").touch()
    assert machine.find_renderer_needs(lambda name: None, [tmp_path]) == []


def test_a_python_that_is_named_but_not_there_is_refused() -> None:
    with pytest.raises(SetupError, match=r"Python 3\.11 or 3\.12 is needed, found none"):
        machine.find_python("/no/such/python")


def test_a_stamp_counts_for_its_inputs_only_and_while_what_was_made_is_there(tmp_path: Path) -> None:
    stamps, wheel = Stamps(tmp_path / "stamps"), tmp_path / "wheel"
    assert not stamps.is_done("wheels", "1")
    assert not stamps.begin("wheels")
    assert not stamps.is_done("wheels", "1")
    with pytest.raises(SetupError, match="wheel was not made"):
        stamps.finish("wheels", "1", [wheel])
    assert not stamps.is_done("wheels", "1")
    assert stamps.begin("wheels"), "it was interrupted"
    wheel.touch()
    stamps.finish("wheels", "1", [wheel])
    assert stamps.is_done("wheels", "1") and not stamps.is_done("wheels", "2")
    wheel.unlink()
    assert not stamps.is_done("wheels", "1")
    assert not stamps.begin("wheels"), "it ended before"


def _hold(folder: Path, held: Event, release: Event) -> None:
    with one_at_a_time(folder, lambda: None):
        held.set()
        release.wait(20)


def test_the_second_set_up_waits_for_the_first(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    held, release = context.Event(), context.Event()
    first = context.Process(target=_hold, args=(tmp_path, held, release))
    first.start()
    assert held.wait(60)

    def on_wait() -> None:
        assert first.is_alive()
        release.set()

    with one_at_a_time(tmp_path, on_wait):
        assert release.is_set()
    first.join(20)
    assert first.exitcode == 0


def index_package(prefix: Path, name: str) -> None:
    index = prefix / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / name).touch()


def make_ros(prefix: Path) -> Path:
    index_package(prefix, "rclpy")
    (prefix / "setup.bash").write_text(f"export ROS_DISTRO=jazzy AMENT_PREFIX_PATH={prefix}\n")
    return prefix


def test_only_a_real_jazzy_outside_the_project_counts_as_sourced(tmp_path: Path) -> None:
    project = tmp_path / "project"
    real, own = make_ros(tmp_path / "opt/ros/jazzy"), make_ros(project / ".venv")
    both = {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": f"{own}:/nowhere:{real}"}
    assert ros.sourced_prefix(both, project) == real
    assert ros.sourced_prefix({**both, "AMENT_PREFIX_PATH": str(own)}, project) is None
    assert ros.sourced_prefix({**both, "ROS_DISTRO": "humble"}, project) is None
    assert ros.sourced_prefix({}, project) is None


def test_a_clean_environment_has_no_other_ros_in_it() -> None:
    kept = {"ROS_DOMAIN_ID": "7", "PATH": "/usr/bin", "HOME": "/home/someone"}
    of_humble = {
        "AMENT_PREFIX_PATH": "/opt/ros/humble",
        "ROS_DISTRO": "humble",
        "PYTHONPATH": "/opt/ros/humble/lib/python3.10/site-packages",
        "PYTHONDONTWRITEBYTECODE": "1",
        "LD_LIBRARY_PATH": "/opt/ros/humble/lib",
        "PATH": "/opt/ros/humble/bin:/usr/bin",
    }
    assert ros.clean_environment(kept | of_humble) == kept


def test_a_ros_that_is_gone_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match="cannot be sourced"):
        ros.environment_after(tmp_path / "setup.bash", {"PATH": "/usr/bin:/bin"})


@pytest.mark.parametrize(
    ("change", "is_built_again"),
    [
        (lambda src: (src / "ds_interfaces/msg/Outcome.msg").open("a").write("# more\n"), True),
        (lambda src: (src / "ds_bringup/launch/new.launch.py").touch(), True),
        (lambda src: (src / "ds_sim/setup.cfg").open("a").write("# more\n"), True),
        (lambda src: (src / "ds_sim/ds_sim/new_module.py").touch(), False),
        (lambda src: (src / "ds_sim/README.md").touch(), False),
    ],
    ids=["message", "launch file", "setup.cfg", "module", "text"],
)
def test_the_workspace_is_built_again_only_where_it_must(
    tmp_path: Path, change: Callable[[Path], object], is_built_again: bool
) -> None:
    source = tmp_path / "src"
    for package in ("ds_interfaces", "ds_bringup", "ds_sim"):
        ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(REPOSITORY / "src" / package, source / package, ignore=ignore)
    before = workspace.inputs(source)
    change(source)
    assert (workspace.inputs(source) != before) is is_built_again


def test_an_installed_standard_package_is_preferred(tmp_path: Path) -> None:
    assert {"simulation_interfaces", "tf2_msgs"} <= workspace.packages(REPOSITORY / "src", tmp_path).keys()
    index_package(tmp_path, "simulation_interfaces")
    missing = workspace.packages(REPOSITORY / "src").keys() - workspace.packages(REPOSITORY / "src", tmp_path).keys()
    assert missing == {"simulation_interfaces"}


def test_every_requirement_is_pinned_and_none_twice_in_a_file() -> None:
    pinned: dict[str, str] = {}
    for file in sorted((REPOSITORY / "requirements").glob("*.txt")):
        names = set()
        for line in file.read_text().splitlines():
            requirement = line.partition("#")[0].strip()
            if not requirement:
                continue
            name, separator, version = requirement.partition("==")
            assert separator, f"{file.name}: {requirement} is not pinned"
            assert name not in names, f"{file.name}: {name} twice"
            names.add(name)
            assert pinned.setdefault(name, version) == version, f"{file.name}: {name} has another version"
            assert not name.startswith(("nvidia", "triton"))
