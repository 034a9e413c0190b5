# SPDX-License-Identifier: Apache-2.0
"""Launches one simulator and the adapter for a driver with standard messages (docs/drivers.md).

ros2 launch ds_bringup adapter.launch.py [sim:=bullet|softbody|panda|donkey] [namespace:=ds1]
                                         [message:=twist_stamped|twist|ackermann|servo|autoware]
                                         [sync:=lockstep|realtime]
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Describe two nodes in one namespace."""

    def text(name: str) -> ParameterValue:
        return ParameterValue(LaunchConfiguration(name), value_type=str)

    return LaunchDescription(
        [
            DeclareLaunchArgument("sim", default_value="bullet", description="known simulator, or module:Class"),
            DeclareLaunchArgument("namespace", default_value="ds1", description="namespace of both nodes"),
            DeclareLaunchArgument("message", default_value="twist_stamped", description="what your driver sends"),
            DeclareLaunchArgument("sync", default_value="lockstep", description="lockstep, first or realtime"),
            Node(
                package="ds_sim",
                executable="simulator",
                name="simulator",
                namespace=LaunchConfiguration("namespace"),
                parameters=[{"simulator": text("sim"), "sync": text("sync")}],
                on_exit=Shutdown(reason="the simulator ended"),
                output="screen",
            ),
            Node(
                package="ds_driver",
                executable="cmd_vel_adapter",
                name="cmd_vel_adapter",
                namespace=LaunchConfiguration("namespace"),
                parameters=[{"message": text("message")}],
                output="screen",
            ),
        ]
    )
