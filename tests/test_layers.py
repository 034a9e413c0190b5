"""The science runs without ROS: only the files that are named here may import it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

ROS_MODULES = {
    "rclpy", "builtin_interfaces", "action_msgs", "std_msgs", "std_srvs", "sensor_msgs", "geometry_msgs", "nav_msgs",
    "visualization_msgs", "diagnostic_msgs", "rcl_interfaces", "rosgraph_msgs", "ds_interfaces",
}  # fmt: skip
ROS_FILES = {
    "ds_sim/node.py", "ds_sim/frames.py", "ds_sim/messages.py", "ds_sim/ros_runtime.py",
    "ds_sim/parameters.py", "ds_sim/simulator_parameters.py", "ds_sim/real_time.py",
    "ds_driver/node.py", "ds_driver/autopilot_node.py", "ds_driver/eyes.py",
    "ds_driver/cmd_vel_adapter.py", "ds_driver/camera_driver.py", "ds_driver/camera_eyes.py",
    "ds_driver/command_outputs.py", "ds_driver/latency_report.py",
    "ds_orchestrator/graph.py", "ds_orchestrator/executables.py",
    "ds_orchestrator/recording.py", "ds_orchestrator/questioning.py", "ds_orchestrator/replay_node.py",
}  # fmt: skip


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names


def test_only_the_node_side_imports_ros() -> None:
    files = {f"{p.parent.name}/{p.name}": p for p in Path("src").glob("*/ds_*/*.py")}
    assert set(files) >= ROS_FILES and len(files) > 40
    found = {name for name, path in files.items() if imports(path) & ROS_MODULES}
    assert found == ROS_FILES


def test_nodes_are_thin() -> None:
    for name in ("ds_sim/node.py", "ds_driver/node.py", "ds_driver/autopilot_node.py"):
        path = Path("src") / name.split("/")[0] / name
        assert len(path.read_text().splitlines()) <= 200, name


def test_the_science_imports_in_a_process_without_ros() -> None:
    """Isolated from the environment's paths, with ROS forbidden by name."""
    packages = [str(p.resolve()) for p in Path("src").glob("ds_*")]
    script = f"""
import sys
sys.path[:0] = {packages!r}
class Forbid:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {ROS_MODULES!r}:
            raise ImportError('ROS is forbidden here: ' + name)
sys.meta_path.insert(0, Forbid())
import ds_road, ds_sim.road_simulator, ds_driver.training, ds_driver.assessment, ds_orchestrator.campaign
import ds_orchestrator.report, ds_orchestrator.results, ds_orchestrator.cli
from ds_sim.registry import SIMULATORS, make_simulator
for name in SIMULATORS: make_simulator(name)
ds_orchestrator.cli.make_app()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
