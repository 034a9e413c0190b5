# SPDX-License-Identifier: Apache-2.0
"""Launches one simulator and one driver.

ros2 launch ds_bringup drive.launch.py [sim:=bullet|softbody|panda|donkey] [namespace:=ds1]
                                       [driver:=dave2|autopilot|PATH] [sync:=lockstep|first|realtime]

For your own simulator: sim:=module:Class parameters:=FILE, with FILE like those in config/simulators.
"""

from typing import Any

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe two nodes in one namespace."""
    sim, driver = LaunchConfiguration("sim"), LaunchConfiguration("driver")
    wants_autopilot = EqualsSubstitution(driver, "autopilot")
    file = PathJoinSubstitution([FindPackageShare("ds_bringup"), "config", "simulators", sim])

    def text(value: LaunchConfiguration) -> ParameterValue:
        return ParameterValue(value, value_type=str)

    def node(package: str, executable: str, *own: dict[str, ParameterValue], **more: Any) -> Node:
        return Node(
            package=package,
            executable=executable,
            name=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("parameters"), *own],
            output="screen",
            **more,
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument("sim", default_value="bullet", description="known simulator, or module:Class"),
            DeclareLaunchArgument("driver", default_value="dave2", description="shipped network, file, or autopilot"),
            DeclareLaunchArgument("namespace", default_value="ds1", description="namespace of both nodes"),
            DeclareLaunchArgument("sync", default_value="lockstep", description="lockstep, first or realtime"),
            DeclareLaunchArgument(
                "parameters", default_value=[file, ".yaml"], description="file with the parameters of the nodes"
            ),
            node(
                "ds_sim",
                "simulator",
                {"simulator": text(sim), "sync": text(LaunchConfiguration("sync"))},
                on_exit=Shutdown(reason="the simulator ended"),
            ),
            node("ds_driver", "driver", {"network": text(driver)}, condition=UnlessCondition(wants_autopilot)),
            node("ds_driver", "autopilot", condition=IfCondition(wants_autopilot)),
        ]
    )
