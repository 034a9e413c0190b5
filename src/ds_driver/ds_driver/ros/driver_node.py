"""Runs a network as a driver node for one or more simulators."""

from __future__ import annotations

import sys
import time
from functools import partial

import numpy as np
from ds_interfaces.msg import VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from numpy.typing import NDArray
from rclpy.node import Node

from ds_driver.networks.backends import BACKENDS, DEVICES, with_backend
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.preprocessing import Crop
from ds_driver.ros.simulator_client import Answer, SimulatorClient
from ds_driver.ros.simulator_info import SimulatorInfo
from ds_sim.ros.conversions import crop_of
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import Command

ASK = -1
"""Value of a crop parameter that asks the simulator."""


class DriverNode(Node):
    """Drives one or more simulators with a network; asks each simulator for its crop before each run."""

    def __init__(self) -> None:
        super().__init__("driver")
        network = declare(self, "network", "dave2", "Shipped network, or what docs/bring_your_own_network.md names.")
        about = "Backend that runs the network."
        backend = declare(self, "backend", "auto", about, choices=BACKENDS)
        device = declare(self, "device", "cpu", "Device that runs the network.", choices=DEVICES)
        self._namespaces = declare(self, "namespaces", [""], 'Namespaces of the simulators; "" is the node\'s own.')
        count = len(self._namespaces)
        about = "Image rows at the {} that the network does not see, one for each namespace; -1 asks the simulator."
        tops, bottoms = (
            declare(self, name, [ASK] * count, about.format(end), low=ASK, high=152, length=count)
            for name, end in (("crop_top", "top"), ("crop_bottom", "bottom"))
        )
        self._given = list(zip(tops, bottoms, strict=True))
        self._crops: list[Crop | None] = [None] * count
        self._driver = NetworkDriver(with_backend(network, backend, device))
        self._milliseconds: list[float] = []
        purpose = "for the crop of its images (not needed with parameters crop_top and crop_bottom)"
        self._info = SimulatorInfo(self, self._namespaces, purpose, self._on_info)
        self._simulators = []
        for index, (namespace, crop) in enumerate(zip(self._namespaces, self._given, strict=True)):
            asks = ASK in crop
            client = SimulatorClient(self, namespace, partial(self._info.ask, index) if asks else None)
            self._simulators.append(client)
            if asks:
                self._info.ask(index)
            else:
                self._use(index, Crop(*crop), "from parameters")
        self.get_logger().info(f"{network} drives {', '.join(filter(None, self._namespaces)) or self.get_namespace()}")

    def _on_info(self, index: int, info: GetSimulatorInfo.Response) -> None:
        pairs = zip(self._given[index], crop_of(info), strict=True)
        top, bottom = (reported if given == ASK else given for given, reported in pairs)
        self._use(index, Crop(top, bottom), f"from {info.name}")

    def _use(self, index: int, crop: Crop, source: str) -> None:
        """Drive a simulator with the given crop, and log it when it changes."""
        if crop != self._crops[index]:
            name = self._namespaces[index] or self.get_namespace()
            rows = f"{crop.top} rows cut off at the top, {crop.bottom} at the bottom"
            self.get_logger().info(f"{name}: crop {source}: {rows}")
        self._crops[index] = crop
        self._simulators[index].drive_with(self._answer_with(crop))

    def _answer_with(self, crop: Crop) -> Answer:
        def answer(image: NDArray[np.uint8], state: VehicleState) -> Command:
            started = time.perf_counter()
            command = self._driver.command(image, state.speed, crop, state.step)
            self._milliseconds.append(1e3 * (time.perf_counter() - started))
            return command

        return answer

    def destroy_node(self) -> None:
        """Print the latency of the answers."""
        if self._milliseconds:
            median, slow, longest = np.percentile(self._milliseconds, (50, 99, 100))
            # ROS and its logger may be shut down by now.
            print(
                f"{len(self._milliseconds)} frames answered: median {median:.1f} ms, 99 % within {slow:.1f} ms, "
                f"longest {longest:.1f} ms",
                file=sys.stderr,
            )
        super().destroy_node()


def main() -> None:
    """Run the driver until a signal stops it."""
    sys.exit(run_node(DriverNode))


if __name__ == "__main__":
    main()
