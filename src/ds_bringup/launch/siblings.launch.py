# SPDX-License-Identifier: Apache-2.0
"""Launches both digital siblings and the twin, each in its own namespace with its own driver.

ros2 launch ds_bringup siblings.launch.py [driver:=dave2|autopilot|PATH] [sync:=lockstep|first|realtime]
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SIMULATORS = {
    "ds1": ("ds_sim_bullet", "bullet.yaml"),
    "ds2": ("ds_sim_softbody", "softbody.yaml"),
    "twin": ("ds_twin_donkey", "donkey.yaml"),
}
"""Namespace -> package with the executable `simulator`, and parameter file of its nodes."""


def generate_launch_description() -> LaunchDescription:
    """Describe six nodes: a simulator and a driver in each namespace."""
    driver = LaunchConfiguration("driver")
    wants_autopilot = EqualsSubstitution(driver, "autopilot")
    folder = PathJoinSubstitution([FindPackageShare("ds_bringup"), "config", "simulators"])
    sync = {"sync": ParameterValue(LaunchConfiguration("sync"), value_type=str)}
    network = {"network": ParameterValue(driver, value_type=str)}
    description = LaunchDescription(
        [
            DeclareLaunchArgument("driver", default_value="dave2", description="shipped network, file, or autopilot"),
            DeclareLaunchArgument("sync", default_value="lockstep", description="lockstep, first or realtime"),
        ]
    )
    for namespace, (package, file) in SIMULATORS.items():
        parameters = PathJoinSubstitution([folder, file])
        description.add_action(
            Node(
                package=package,
                executable="simulator",
                name="simulator",
                namespace=namespace,
                parameters=[parameters, sync],
                on_exit=Shutdown(reason="the simulator ended"),
                output="screen",
            )
        )
        description.add_action(
            Node(
                package="ds_driver",
                executable="driver",
                name="driver",
                namespace=namespace,
                parameters=[parameters, network],
                condition=UnlessCondition(wants_autopilot),
                output="screen",
            )
        )
        description.add_action(
            Node(
                package="ds_driver",
                executable="autopilot",
                name="autopilot",
                namespace=namespace,
                parameters=[parameters],
                condition=IfCondition(wants_autopilot),
                output="screen",
            )
        )
    return description
