# SPDX-License-Identifier: Apache-2.0
"""Launches both digital siblings and the twin, each in its own namespace with its own driver.

ros2 launch ds_bringup siblings.launch.py [driver:=dave2|autopilot|PATH] [sync:=lockstep|first|realtime]
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

SIMULATORS = {"ds1": "bullet", "ds2": "softbody", "twin": "donkey"}
"""Namespace -> simulator."""


def generate_launch_description() -> LaunchDescription:
    """Describe six nodes: a simulator and a driver in each namespace."""
    one = PathJoinSubstitution([FindPackageShare("ds_bringup"), "launch", "drive.launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("driver", default_value="dave2", description="shipped network, file, or autopilot"),
            DeclareLaunchArgument("sync", default_value="lockstep", description="lockstep, first or realtime"),
            *(
                # A group, as arguments of one would also be those of the next.
                GroupAction(
                    [
                        IncludeLaunchDescription(
                            PythonLaunchDescriptionSource(one),
                            launch_arguments={"sim": simulator, "namespace": namespace}.items(),
                        )
                    ]
                )
                for namespace, simulator in SIMULATORS.items()
            ),
        ]
    )
