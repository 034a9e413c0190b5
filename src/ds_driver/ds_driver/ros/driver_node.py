"""The driver node: images in, the network's commands out, for one simulator or several."""

from __future__ import annotations

import sys
import time

import numpy as np
from ds_interfaces.msg import VehicleState
from numpy.typing import NDArray
from rclpy.node import Node

from ds_driver.networks.backends import with_backend
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.preprocessing import Crop
from ds_driver.ros.simulator_client import Answer, SimulatorClient
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import Command


class DriverNode(Node):
    """Runs a network; it sees images and speed, never the road, and knows of a simulator only its crop."""

    def __init__(self) -> None:
        super().__init__("driver")
        network = declare(self, "network", "dave2", "Shipped network, or what docs/bring_your_own_network.md names.")
        about = "What computes the network."
        backend = declare(self, "backend", "auto", about, choices=("auto", "torch", "onnx", "openvino"))
        device = declare(self, "device", "cpu", "Where it is computed.", choices=("cpu", "cuda"))
        namespaces = declare(self, "namespaces", [""], 'Of the simulators; "" is the node\'s own.')
        about = "Rows of the image at the {} that the network does not see, one number for each namespace."
        tops, bottoms = (
            declare(self, name, [0] * len(namespaces), about.format(end), low=0, high=152, length=len(namespaces))
            for name, end in (("crop_top", "top"), ("crop_bottom", "bottom"))
        )
        self._driver = NetworkDriver(with_backend(network, backend, device))
        self._milliseconds: list[float] = []
        self._eyes = [
            SimulatorClient(self, namespace, self._answer_with(Crop(top, bottom)))
            for namespace, top, bottom in zip(namespaces, tops, bottoms, strict=True)
        ]
        self.get_logger().info(f"{network} drives {', '.join(namespaces) or 'its own namespace'}")

    def _answer_with(self, crop: Crop) -> Answer:
        def answer(image: NDArray[np.uint8], state: VehicleState) -> Command:
            started = time.perf_counter()
            command = self._driver.command(image, state.speed, crop, state.step)
            self._milliseconds.append(1e3 * (time.perf_counter() - started))
            return command

        return answer

    def destroy_node(self) -> None:
        """Say in the log how long the answers took."""
        if self._milliseconds:
            median, slow, longest = np.percentile(self._milliseconds, (50, 99, 100))
            # By now ROS may be shut down, and its logger with it.
            print(
                f"{len(self._milliseconds)} frames answered: median {median:.1f} ms, 99 % within {slow:.1f} ms, "
                f"longest {longest:.1f} ms",
                file=sys.stderr,
            )
        super().destroy_node()


def main() -> None:
    """Run the driver until it is told to stop."""
    sys.exit(run_node(DriverNode))


if __name__ == "__main__":
    main()
