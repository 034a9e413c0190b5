# SPDX-License-Identifier: Apache-2.0
"""Architecture of the packages: only folders named here import ROS, folders stay small, and nodes thin."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

ROS_MODULES = {
    "rclpy", "builtin_interfaces", "action_msgs", "std_msgs", "std_srvs", "sensor_msgs", "geometry_msgs", "nav_msgs",
    "visualization_msgs", "diagnostic_msgs", "tf2_msgs", "rcl_interfaces", "rosgraph_msgs", "ds_interfaces",
    "simulation_interfaces",
}  # fmt: skip
ROS_FOLDERS = {"ros", "graph"}
"""Folders of a package whose modules may import ROS."""
FLOORS = (
    {"ds_base"},
    {"ds_road"},
    {"ds_sim"},
    {"ds_bags", "ds_sim_bullet", "ds_sim_panda", "ds_sim_softbody"},
    {"ds_driver", "ds_twin_donkey"},
    {"ds_orchestrator", "ds_sim_ros", "ds_recording"},  # searches, drives, remembers, maps; speaks drivers' messages
    {"ds_analysis"},  # reads, never drives
    {"ds_report"},  # shows
    {"ds_studies"},  # drives because an analysis asks for it
    {"ds_cli"},
)
"""Packages from the ground up; each imports only from floors below its own."""


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names


def modules() -> dict[str, Path]:
    """List every module of every package, by its path below the package's folder."""
    return {"/".join(path.parts[2:]): path for path in Path("src").glob("*/ds_*/**/*.py")}


def test_only_the_folders_named_ros_and_graph_import_ros() -> None:
    files = modules()
    assert len(files) > 140 and any("/" in name.partition("/")[2] for name in files)
    importing = {name for name, path in files.items() if imports(path) & ROS_MODULES}
    assert importing and all(ROS_FOLDERS & set(Path(name).parts[1:-1]) for name in importing), importing


def imported_modules(tree: ast.AST) -> Iterator[str]:
    """List what a module imports, also within functions, but not for type checkers alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        yield from imported_modules(node)


def test_packages_import_only_from_floors_below() -> None:
    floor_of = {name: floor for floor, names in enumerate(FLOORS) for name in names}
    packages = {path.parent.name for path in Path("src").glob("*/setup.py")}
    assert packages == set(floor_of)
    for name, path in modules().items():
        package = name.partition("/")[0]
        above = {one for one in imports(path) & packages - {package} if floor_of[one] >= floor_of[package]}
        assert not above, f"{name} imports {above}"


def test_no_modules_import_each_other_in_a_circle() -> None:
    names = {name.removesuffix(".py").replace("/", "."): path for name, path in modules().items()}
    names = {name: path for name, path in names.items() if not name.endswith("__init__")}
    TopologicalSorter(
        {name: set(imported_modules(ast.parse(path.read_text()))) & names.keys() for name, path in names.items()}
    ).prepare()
