# SPDX-License-Identifier: Apache-2.0
"""Launches one simulator and one driver.

ros2 launch ds_bringup drive.launch.py [sim:=bullet|softbody|panda|donkey] [namespace:=ds1]
                                       [driver:=dave2|autopilot|PATH] [sync:=lockstep|first|realtime]

For your own simulator: sim:=module:Class parameters:=FILE, with FILE like those in config/simulators.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe two nodes in one namespace."""
    sim = LaunchConfiguration("sim")
    driver = LaunchConfiguration("driver")
    namespace = LaunchConfiguration("namespace")
    parameters = LaunchConfiguration("parameters")
    wants_autopilot = EqualsSubstitution(driver, "autopilot")
    return LaunchDescription(
        [
            DeclareLaunchArgument("sim", default_value="bullet", description="known simulator, or module:Class"),
            DeclareLaunchArgument("driver", default_value="dave2", description="shipped network, file, or autopilot"),
            DeclareLaunchArgument("namespace", default_value="ds1", description="namespace of both nodes"),
            DeclareLaunchArgument("sync", default_value="lockstep", description="lockstep, first or realtime"),
            DeclareLaunchArgument(
                "parameters",
                default_value=[
                    PathJoinSubstitution([FindPackageShare("ds_bringup"), "config", "simulators", sim]),
                    ".yaml",
                ],
                description="file with the parameters of the nodes",
            ),
            Node(
                package="ds_sim",
                executable="simulator",
                name="simulator",
                namespace=namespace,
                parameters=[
                    parameters,
                    {
                        "simulator": ParameterValue(sim, value_type=str),
                        "sync": ParameterValue(LaunchConfiguration("sync"), value_type=str),
                    },
                ],
                on_exit=Shutdown(reason="the simulator ended"),
                output="screen",
            ),
            Node(
                package="ds_driver",
                executable="driver",
                name="driver",
                namespace=namespace,
                parameters=[parameters, {"network": ParameterValue(driver, value_type=str)}],
                condition=UnlessCondition(wants_autopilot),
                output="screen",
            ),
            Node(
                package="ds_driver",
                executable="autopilot",
                name="autopilot",
                namespace=namespace,
                parameters=[parameters],
                condition=IfCondition(wants_autopilot),
                output="screen",
            ),
        ]
    )
