"""Both siblings, the twin and one driver for all of them, and a campaign on them; ends with the campaign.

ros2 launch ds_bringup campaign.launch.py out:=DIR [config:=FILE]

The configuration must name siblings bullet and softbody, twin donkey and driver dave2, as demo.yaml and paper.yaml do.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SIMULATORS = {
    "ds1": ("ds_sim_bullet", "bullet"),
    "ds2": ("ds_sim_softbody", "softbody"),
    "twin": ("ds_twin_donkey", "donkey"),
}
"""Namespace -> package whose executable `simulator` runs there, and name of its parameter file."""


def generate_launch_description() -> LaunchDescription:
    """Describe five processes; a driver that ends is started again."""
    folder = PathJoinSubstitution([FindPackageShare("ds_bringup"), "config"])
    campaign = Node(
        package="ds_orchestrator",
        executable="campaign",
        arguments=[LaunchConfiguration("config"), "--out", LaunchConfiguration("out")],
        output="screen",
        sigterm_timeout="30",
    )
    simulators = [
        Node(
            package=package,
            executable="simulator",
            name="simulator",
            namespace=namespace,
            parameters=[PathJoinSubstitution([folder, "simulators", f"{name}.yaml"])],
            respawn=True,
            output="log",
        )
        for namespace, (package, name) in SIMULATORS.items()
    ]
    driver = Node(
        package="ds_driver",
        executable="driver",
        name="driver",
        parameters=[PathJoinSubstitution([folder, "driver.yaml"])],
        respawn=True,
        output="log",
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("out", description="folder of the campaign; an unfinished one goes on"),
            DeclareLaunchArgument(
                "config", default_value=PathJoinSubstitution([folder, "demo.yaml"]), description="campaign file"
            ),
            *simulators,
            driver,
            campaign,
            RegisterEventHandler(OnProcessExit(target_action=campaign, on_exit=[EmitEvent(event=Shutdown())])),
        ]
    )
