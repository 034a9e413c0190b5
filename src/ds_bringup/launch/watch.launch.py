# SPDX-License-Identifier: Apache-2.0
"""Watches the simulators of this ROS domain in Foxglove or RViz, and a campaign in the browser.

ros2 launch ds_bringup watch.launch.py [tool:=foxglove|rviz|none] [port:=8765] [campaign:=DIR]

Foxglove connects to ws://127.0.0.1:8765 and imports the layout config/foxglove_layout.json; through this bridge it
reads, and neither publishes nor calls. The tools are no dependencies: apt install ros-jazzy-foxglove-bridge, or
ros-jazzy-rviz2.
"""

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

APT = {"foxglove_bridge": "ros-jazzy-foxglove-bridge", "rviz2": "ros-jazzy-rviz2"}
"""Package of a tool -> what apt calls it."""


def check_installed(package: str) -> None:
    """Refuse a tool that is not installed, with the command that installs it."""
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        raise RuntimeError(f"{package} is not installed: apt install {APT[package]}, or give tool:=none") from None


def nodes_of(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Describe the tool, and the page of the campaign if one is given."""
    tool = LaunchConfiguration("tool").perform(context)
    campaign = LaunchConfiguration("campaign").perform(context)
    nodes: list[LaunchDescriptionEntity] = []
    if tool == "foxglove":
        check_installed("foxglove_bridge")
        readable = {
            "address": "127.0.0.1",
            "port": int(LaunchConfiguration("port").perform(context)),
            "capabilities": ["connectionGraph"],
        }
        nodes.append(
            Node(package="foxglove_bridge", executable="foxglove_bridge", parameters=[readable], output="screen")
        )
    elif tool == "rviz":
        check_installed("rviz2")
        configuration = PathJoinSubstitution([FindPackageShare("ds_bringup"), "config", "watch.rviz"])
        nodes.append(Node(package="rviz2", executable="rviz2", arguments=["-d", configuration], output="screen"))
    elif tool != "none":
        raise RuntimeError(f"tool {tool!r}: expected foxglove, rviz or none")
    if campaign:
        nodes.append(Node(package="ds_orchestrator", executable="watch", arguments=[campaign], output="screen"))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; the processes follow when they are known."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("tool", default_value="foxglove", description="foxglove, rviz or none"),
            DeclareLaunchArgument("port", default_value="8765", description="port of the Foxglove bridge"),
            DeclareLaunchArgument("campaign", default_value="", description="campaign folder to show in the browser"),
            OpaqueFunction(function=nodes_of),
        ]
    )
