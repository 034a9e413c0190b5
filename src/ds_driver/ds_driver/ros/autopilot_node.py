"""The reference driver as a node: it reads the lane state instead of the camera (paper, equation 1)."""

from __future__ import annotations

import sys

import numpy as np
from ds_interfaces.msg import VehicleState
from numpy.typing import NDArray
from rclpy.node import Node

from ds_driver.control.autopilot import Autopilot
from ds_driver.ros.simulator_client import Answer, SimulatorClient
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import AutopilotGains, Command

GAINS = (
    ("proportional", 0.7, 0.0, 100.0, "On the lateral position, 1/m (K_P), one for each namespace."),
    ("derivative", 0.0, 0.0, 100.0, "On its difference from frame to frame, 1/m (K_D), one for each namespace."),
    ("integral", 0.0, 0.0, 100.0, "On its running sum, 1/m (K_I), one for each namespace."),
    ("max_speed", 30.0, 1.0, 200.0, "Threshold and K = H of equation 2, km/h, one for each namespace."),
    ("min_speed", 15.0, 1.0, 200.0, "K = L of equation 2, km/h, one for each namespace."),
)
"""Name, default, range and meaning of the gains of equations 1 and 2; the ranges keep out what cannot be meant."""


class AutopilotNode(Node):
    """Drives one simulator or several by the lateral position, each with its own gains."""

    def __init__(self) -> None:
        super().__init__("autopilot")
        namespaces = declare(self, "namespaces", [""], 'Of the simulators; "" is the node\'s own.')
        columns = {
            name: declare(self, name, [default] * len(namespaces), about, low=low, high=high, length=len(namespaces))
            for name, default, low, high, about in GAINS
        }
        self._eyes = [
            SimulatorClient(
                self, namespace, _pilot(AutopilotGains(**{name: values[i] for name, values in columns.items()}))
            )
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
