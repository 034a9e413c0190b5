"""The driver node: images in, the network's commands out, for one simulator or several."""

from __future__ import annotations

import sys
import time

import numpy as np
from ds_interfaces.msg import VehicleState
from numpy.typing import NDArray
from rclpy.node import Node

from ds_driver.backends import with_backend
from ds_driver.eyes import Answer, Eyes
from ds_driver.network_driver import NetworkDriver
from ds_driver.preprocessing import Crop
from ds_sim.ros_runtime import run_node
from ds_sim.simulator import Command


class DriverNode(Node):
    """Runs a network; it sees images and speed, never the road, and knows of a simulator only its crop.

    Parameters: `network` (any name that `NetworkDriver` takes), `backend` (auto, torch, onnx or openvino), `device`
    (cpu or cuda), `namespaces` (of the simulators; [""] for its own), `crop_top` and `crop_bottom` (rows, one number
    per namespace).
    """

    def __init__(self) -> None:
        super().__init__("driver")
        network = self.declare_parameter("network", "dave2").value
        backend = self.declare_parameter("backend", "auto").value
        device = self.declare_parameter("device", "cpu").value
        namespaces = self.declare_parameter("namespaces", [""]).value
        tops = self.declare_parameter("crop_top", [0] * len(namespaces)).value
        bottoms = self.declare_parameter("crop_bottom", [0] * len(namespaces)).value
        if not len(namespaces) == len(tops) == len(bottoms):
            raise ValueError(
                f"parameters namespaces, crop_top and crop_bottom have {len(namespaces)}, {len(tops)} and "
                f"{len(bottoms)} entries: give one crop per namespace"
            )
        self._driver = NetworkDriver(with_backend(network, backend, device))
        self._milliseconds: list[float] = []
        self._eyes = [
            Eyes(self, namespace, self._answer_with(Crop(top, bottom)))
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
