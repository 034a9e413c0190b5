# SPDX-License-Identifier: Apache-2.0
"""Packages: manifests declare every import, and nothing else, under keys that rosdep knows; versions agree.

Every source file names its licence in its first line, where tools that collect licences look (spdx.dev).
"""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from distutils.core import run_setup  # setuptools provides it where Python no longer does
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from tests.test_layers import imports

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
PACKAGES = sorted(path.parent.name for path in SOURCE.glob("*/package.xml"))
PYTHON_PACKAGES = [name for name in PACKAGES if (SOURCE / name / "setup.py").exists()]

# Keys as of rosdep/python.yaml and jazzy/distribution.yaml in github.com/ros/rosdistro, commit 8468e88 (2026-08-22).
KEYS = {
    "cv2": "python3-opencv",
    "google": "python3-protobuf",
    "gymnasium": "python3-gymnasium-pip",
    "jinja2": "python3-jinja2",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "pandas": "python3-pandas",
    "onnxruntime": "python3-onnxruntime-pip",
    "pydantic": "python3-pydantic",
    "pydantic_core": "python3-pydantic",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "shapely": "python3-shapely",
    "sklearn": "python3-sklearn",
    "torch": "python3-torch",
    "tornado": "python3-tornado",
    "typer": "python3-typer",
    "yaml": "python3-yaml",
}
"""Imported module -> rosdep key."""
ROS_KEYS = {
    "action_msgs", "ament_cmake", "ament_index_python", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs",
    "launch", "launch_ros", "nav_msgs", "python3-pybullet-pip", "python3-pytest", "rcl_interfaces", "rclpy",
    "ros2launch", "rosgraph_msgs", "rosidl_default_generators", "rosidl_default_runtime", "sensor_msgs", "std_msgs",
    "std_srvs", "tf2_msgs", "visualization_msgs",
}  # fmt: skip
WITHOUT_KEY = (
    *("distributed", "llvmlite", "lz4", "markupsafe", "mcap", "numba", "onnx", "openvino"),
    *("panda3d", "plotly", "pyarrow", "pymunk", "safetensors", "statsmodels", "zstandard"),
)
NO_KEY = {
    "backports": "backports.zstd",
    "vehiclemodels": "commonroad-vehicle-models",
    **{name: name for name in WITHOUT_KEY},
}
"""Imported module -> name on PyPI, if rosdep has no key."""
SIMULATORS = ("ds_sim_bullet", "ds_sim_panda", "ds_sim_softbody", "ds_sim_ros")
"""Made by their names in ds_sim/registry.py."""
WITHOUT_IMPORT = {
    "ds_bags": ("ds_interfaces",),  # whose definitions it reads
    "ds_orchestrator": SIMULATORS,
    "ds_bringup": (*SIMULATORS, "ds_twin_donkey", "ds_cli", "ros2launch"),  # what executables of ds_orchestrator run
    "ds_sim": ("builtin_interfaces", "geometry_msgs"),  # imported by the names of messages in ds_sim/messages.py
    "ds_sim_bullet": ("python3-pybullet-pip",),  # imported when the first vehicle is made
    "ds_driver": ("geometry_msgs",),  # imported by the name of the message that a user chooses
    "ds_sim_ros": ("rcl_interfaces", "simulation_interfaces", "std_srvs"),  # imported by the name of a service's type
}

NO_KEY_WITHOUT_IMPORT = {"ds_sim_panda": {"panda3d"}}  # imported when the first scene is made


def executables(name: str) -> dict[str, str]:
    """Map each executable of a package to its entry point, `module:function`."""
    config = configparser.ConfigParser()
    config.read(SOURCE / name / "setup.cfg")
    lines = config.get("options.entry_points", "console_scripts", fallback="").split("\n")
    return {left.strip(): right.strip() for left, _, right in (line.partition("=") for line in lines) if right}


def imports_of(name: str) -> set[str]:
    """List the top-level modules that a package imports, except its own and the standard library's.

    An executable imports its entry point; a launch file, the packages that it names.
    """
    used: set[str] = {target.partition(".")[0] for target in executables(name).values()}
    launched = list((SOURCE / name).glob("launch/*.py"))
    for file in [*(SOURCE / name / name).rglob("*.py"), *launched]:
        used.update(imports(file))
    for file in launched:
        constants = (node.value for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Constant))
        used.update(str(value) for value in constants if value in PACKAGES)
    return used - set(sys.stdlib_module_names) - {name, "compression"}  # of Python 3.14


def manifest(name: str) -> ElementTree.Element:
    return ElementTree.parse(SOURCE / name / "package.xml").getroot()


def declared(name: str) -> set[str]:
    return {str(e.text) for e in manifest(name) if e.tag in ("depend", "exec_depend")}


@pytest.mark.parametrize("name", [*PYTHON_PACKAGES, "ds_bringup"])
def test_every_import_is_declared_and_nothing_else_is(name: str) -> None:
    used = imports_of(name)
    needed = {KEYS.get(module, module) for module in used - NO_KEY.keys()} | set(WITHOUT_IMPORT.get(name, ()))
    assert declared(name) == needed
    comment = re.search(r"<!-- no rosdep key[^:]*: (.*?) -->", (SOURCE / name / "package.xml").read_text())
    named = set(comment.group(1).split(", ")) if comment else set()
    assert named == {NO_KEY[module] for module in used & NO_KEY.keys()} | NO_KEY_WITHOUT_IMPORT.get(name, set())


def test_ds_bringup_depends_on_every_package() -> None:
    """What `colcon build --packages-up-to ds_bringup` builds in a workspace of somebody else."""
    built, found = {"ds_bringup"}, ["ds_bringup"]
    while found:
        found = sorted({key for name in found for key in declared(name)} & set(PACKAGES) - built)
        built.update(found)
    assert built == set(PACKAGES)


@pytest.mark.parametrize("name", PYTHON_PACKAGES)
def test_every_executable_has_its_function(name: str) -> None:
    for target in executables(name).values():
        module, _, function = target.partition(":")
        assert callable(getattr(import_module(module), function))


@pytest.mark.parametrize("name", PYTHON_PACKAGES)
def test_a_package_is_set_up_by_files_of_its_own_folder(name: str) -> None:
    assert imports(SOURCE / name / "setup.py") == {"setuptools"}


@pytest.mark.parametrize("name", PACKAGES)
def test_every_key_is_one_of_this_workspace_or_known_to_rosdep(name: str) -> None:
    tags = ("depend", "exec_depend", "test_depend", "buildtool_depend")
    keys = {str(e.text) for e in manifest(name) if e.tag in tags}
    assert keys <= set(PACKAGES) | ROS_KEYS | set(KEYS.values())


@pytest.mark.parametrize("name", PACKAGES)
def test_a_manifest_has_a_licence_a_maintainer_a_url_and_the_version_of_the_project(name: str) -> None:
    root = manifest(name)
    assert root.findtext("maintainer") and root.findtext("url") and root.findtext("license") == "Apache-2.0"
    assert all((SOURCE / name / str(entry.get("file"))).is_file() for entry in root.iter("license"))
    assert (SOURCE / name / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    assert root.findtext("version") == VERSION


@pytest.mark.parametrize("name", PYTHON_PACKAGES)
def test_setup_installs_type_information_under_what_the_manifest_says(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package's setup.py is read from its own folder, as colcon does, without building anything."""
    monkeypatch.chdir(SOURCE / name)
    distribution: Any = run_setup("setup.py", script_args=["--quiet", "build_py"], stop_after="commandline")
    written, about = manifest(name), distribution.metadata
    for key in ("name", "version", "description", "license", "maintainer"):
        assert getattr(about, key) == written.findtext(key)
    assert [entry.get("email") for entry in written.iter("maintainer")] == [about.maintainer_email]
    assert distribution.extras_require == {"test": ["pytest"]}  # colcon runs pytest for these, else unittest
    command = distribution.get_command_obj("build_py")
    command.ensure_finalized()
    installed = {(Path(folder) / name).as_posix() for _, folder, _, names in command.data_files for name in names}
    stubs = {path.relative_to(SOURCE / name).as_posix() for path in (SOURCE / name).glob("ds_*/**/*.pyi")}
    assert {f"{name}/py.typed", *stubs} <= installed


def test_a_release_finds_every_place_of_the_version() -> None:
    """As `bump-my-version` searches them: once in each file. It writes a file only where it found the text."""
    release = tomllib.loads((ROOT / ".bumpversion.toml").read_text())["tool"]["bumpversion"]
    assert release["current_version"] == VERSION
    places, nothing_to_release = 0, f"\n## [Unreleased]\n\n## [{VERSION}]"
    for place in release["files"]:
        wanted = place["search"].format(current_version=VERSION)
        pattern = wanted if place.get("regex") else re.escape(wanted)
        files = sorted(ROOT.glob(place.get("glob") or place["filename"]))
        texts = [file.read_text() for file in files]
        assert texts and all(len(re.findall(pattern, text)) == 1 or nothing_to_release in text for text in texts), place
        places += len(files)
    assert places >= 2 * len(PYTHON_PACKAGES) + 7


def test_actions_of_workflows_are_pinned_by_commit() -> None:
    files = [ROOT / "action.yml", *ROOT.glob(".github/workflows/*.yml")]
    used = [line for file in files for line in file.read_text().splitlines() if re.search(r"uses: [\w-]+/", line)]
    assert len(used) >= 6 and all(re.search(r"@[0-9a-f]{40}  # v\d", line) for line in used)


def test_the_changelog_begins_with_the_version_of_the_project() -> None:
    headings = [line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## ")]
    released = [heading for heading in headings if heading != "## [Unreleased]"]
    assert released[0].startswith(f"## [{VERSION}] - ")


SUFFIXES = {".py", ".pyi", ".sh", ".in", ".cpp", ".js", ".css", ".j2"}
OF_TORCS = "plugins/ds_sim_torcs/host/"
"""Folder of the program that links against TORCS, which is under the GPL."""


def first_line(text: str) -> str:
    """Return a file's first line that is not for the system."""
    lines = [*text.splitlines(), ""]
    return lines[1] if lines[0].startswith("#!") else lines[0]


def test_every_source_file_names_its_licence() -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True, timeout=60)
    names = [name for name in tracked.stdout.splitlines() if (ROOT / name).is_file()]
    sources = [name for name in names if Path(name).suffix in SUFFIXES or (ROOT / name).read_bytes().startswith(b"#!")]
    assert len(sources) > 500
    missing = []
    for name in sources:
        licence = "GPL-2.0-or-later" if name.startswith(OF_TORCS) else "Apache-2.0"
        if f"SPDX-License-Identifier: {licence}" not in first_line((ROOT / name).read_text()):
            missing.append(name)
    assert not missing, f"the first line must be `# SPDX-License-Identifier: Apache-2.0`: {missing}"
