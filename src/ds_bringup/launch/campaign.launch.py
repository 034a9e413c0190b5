# SPDX-License-Identifier: Apache-2.0
"""Launches a campaign with the simulators and the driver of its file; ends with the campaign.

ros2 launch ds_bringup campaign.launch.py out:=DIR [config:=FILE]
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import read_config


def nodes_of(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """List the processes of the campaign file; all but the campaign's own are restarted when they end."""
    path = LaunchConfiguration("config").perform(context)
    config = read_config(Path(path))
    namespaces = config.drive_settings().namespaces
    graph = [
        Node(
            package="ds_sim",
            executable="simulator",
            namespace=namespace,
            parameters=[{"simulator": str(name), "command_timeout": config.command_timeout}],
            respawn=True,
            output="log",
        )
        for name, namespace in namespaces.items()
    ]
    has_network = config.driver != AUTOPILOT
    network = {"network": str(config.driver)} if has_network else {}
    driver = Node(
        package="ds_driver",
        executable="driver" if has_network else "autopilot",
        namespace="/",
        parameters=[{"namespaces": list(namespaces.values()), **network}],
        respawn=True,
        output="log",
    )
    campaign = Node(
        package="ds_orchestrator",
        executable="campaign",
        arguments=[path, "--out", LaunchConfiguration("out")],
        output="screen",
        sigterm_timeout="30",
    )
    end = RegisterEventHandler(OnProcessExit(target_action=campaign, on_exit=[EmitEvent(event=Shutdown())]))
    return [*graph, driver, campaign, end]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; the processes follow when the campaign file is read."""
    demo = PathJoinSubstitution([FindPackageShare("ds_bringup"), "config", "demo.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("out", description="campaign folder; an unfinished campaign resumes"),
            DeclareLaunchArgument("config", default_value=demo, description="campaign file"),
            OpaqueFunction(function=nodes_of),
        ]
    )
