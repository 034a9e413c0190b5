"""The reference driver as a node: it reads the lane state instead of the camera (paper, equation 1)."""

from __future__ import annotations

import sys

import numpy as np
from ds_interfaces.msg import VehicleState
from numpy.typing import NDArray
from rclpy.node import Node

from ds_driver.control import Autopilot
from ds_driver.eyes import Answer, Eyes
from ds_sim.ros_runtime import run_node
from ds_sim.simulator import AutopilotGains, Command


class AutopilotNode(Node):
    """Drives one simulator or several by the lateral position, each with its own gains.

    Parameters: `namespaces` (of the simulators; [""] for its own), and one number per namespace of
    `proportional`, `derivative`, `integral`, `max_speed` and `min_speed` (km/h).
    """

    def __init__(self) -> None:
        super().__init__("autopilot")
        namespaces = self.declare_parameter("namespaces", [""]).value
        columns = {
            name: self.declare_parameter(name, [default] * len(namespaces)).value
            for name, default in (
                ("proportional", 0.7),
                ("derivative", 0.0),
                ("integral", 0.0),
                ("max_speed", 30.0),
                ("min_speed", 15.0),
            )
        }
        for name, values in columns.items():
            if len(values) != len(namespaces):
                raise ValueError(f"parameter {name} has {len(values)} entries: give one per namespace")
        self._eyes = [
            Eyes(self, namespace, _pilot(AutopilotGains(**{name: values[i] for name, values in columns.items()})))
            for i, namespace in enumerate(namespaces)
        ]
        self.get_logger().info(f"the autopilot drives {', '.join(namespaces) or 'its own namespace'}")


def _pilot(gains: AutopilotGains) -> Answer:
    autopilot = Autopilot(gains)

    def answer(_image: NDArray[np.uint8], state: VehicleState) -> Command:
        nonlocal autopilot
        if state.step == 0:
            autopilot = Autopilot(gains)
        return autopilot.command(state.preview_lateral_position, state.speed)

    return answer


def main() -> None:
    """Run the autopilot until it is told to stop."""
    sys.exit(run_node(AutopilotNode))


if __name__ == "__main__":
    main()
