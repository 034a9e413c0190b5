# SPDX-License-Identifier: Apache-2.0
"""Runs a network as a driver node for one or more simulators."""

from __future__ import annotations

import sys
import time
from functools import partial

import numpy as np
from ds_interfaces.msg import Frame
from ds_interfaces.srv import GetSimulatorInfo
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from ds_driver.control.bicycle import Geometry
from ds_driver.networks.backends import BACKENDS, DEVICES
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import NOT_SIMULATED, DriverError
from ds_driver.networks.pilot import Frame as Seen
from ds_driver.ros.simulator_client import SimulatorClient, SimulatorInfo
from ds_driver.sim2real.image_translation import GeneratorSet
from ds_sim.ros.conversions import MESSAGES, pixels_of
from ds_sim.ros.diagnostics import AnswerDiagnostics
from ds_sim.ros.frame_publisher import FRAME_DEPTH
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import Command, SimulatorSpec

TOPIC = "sim2real/image_raw"
SIMULATORS = -1
"""Value of a crop parameter that stands for the simulator's own."""


class DriverNode(Node):
    """Drives one or more simulators with a network, and crops the images of each as its frames say.

    For a network that sees translated images, it asks each simulator for its name before a run, which selects the
    generator; then its frames are answered.
    """

    def __init__(self) -> None:
        super().__init__("driver")
        network = declare(self, "network", "dave2", "Shipped network, or what docs/bring_your_own_network.md names.")
        about = "Generators that translate its images: a shipped set or a folder; empty: the network's own; or none."
        sim2real = declare(self, "sim2real", "", about)
        about = "Backend that runs the network."
        backend = declare(self, "backend", "auto", about, choices=BACKENDS)
        device = declare(self, "device", "cpu", "Device that runs the network.", choices=DEVICES)
        self._namespaces = declare(self, "namespaces", [""], 'Namespaces of the simulators; "" is the node\'s own.')
        count = len(self._namespaces)
        about = "Image rows at the {} that the network does not see, one for each namespace; -1: the simulator's."
        tops, bottoms = (
            declare(self, name, [SIMULATORS] * count, about.format(end), low=SIMULATORS, high=152, length=count)
            for name, end in (("crop_top", "top"), ("crop_bottom", "bottom"))
        )
        self._given = list(zip(tops, bottoms, strict=True))
        self._crops: list[Crop | None] = [None] * count
        self._names: list[str | None] = [None] * count
        self._driver = NetworkDriver(DriverName.parse(network).on(backend, device).seeing(sim2real))
        self._translation = self._driver.translation
        self._milliseconds: list[float] = []
        info = None
        if self._translation is not None:
            info = SimulatorInfo(self, self._namespaces, "which selects the sim2real generator", self._on_info)
            topics = [f"{name}/{TOPIC}" if name else TOPIC for name in self._namespaces]
            self._image_publishers = [self.create_publisher(Image, topic, FRAME_DEPTH) for topic in topics]
        answers, self._simulators = AnswerDiagnostics(self), list[SimulatorClient]()
        for index, namespace in enumerate(self._namespaces):
            on_start = None if info is None else partial(info.ask, index)
            self._simulators.append(SimulatorClient(self, namespace, Frame, answers, on_start))
            if on_start is None:
                self._simulators[index].drive_with(partial(self._answer, index))
            else:
                on_start()
        self.get_logger().info(f"{network} drives {', '.join(filter(None, self._namespaces)) or self.get_namespace()}")

    def _on_info(self, index: int, info: GetSimulatorInfo.Response) -> None:
        assert self._translation is not None
        if info.name != self._names[index]:
            namespace = self._namespaces[index] or self.get_namespace()
            try:
                digest = self._translation.generator(info.name).sha256[:12]
                self.get_logger().info(f"{namespace}: generator {digest} translates images of {info.name}")
            except DriverError as error:  # every frame will state it, too
                self.get_logger().error(str(error))
        self._names[index] = info.name
        self._simulators[index].drive_with(partial(self._answer, index))

    def _answer(self, index: int, frame: Frame) -> Command:
        started = time.perf_counter()
        image = pixels_of(frame.image)
        has_geometry = frame.wheelbase > 0.0 and frame.max_steering_angle > 0.0
        vehicle = Geometry(frame.wheelbase, frame.max_steering_angle) if has_geometry else None
        if self._translation is None:
            crop, simulator = self._crop_for(index, frame), None
        else:
            image = self._translated(self._translation, index, frame, image)
            crop, simulator = Crop(), NOT_SIMULATED
        command = self._driver.command(
            Seen(image=image, speed=frame.speed, crop=crop, step=frame.step, simulator=simulator, vehicle=vehicle)
        )
        self._milliseconds.append(1e3 * (time.perf_counter() - started))
        return command

    def _translated(
        self, translation: GeneratorSet, index: int, frame: Frame, image: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Translate as the driver would do by itself, and publish the same bits if somebody subscribes."""
        name = self._names[index]
        if name is None:
            raise DriverError("the simulator has not stated its name yet")
        translated = translation.translate(image, name)
        if self._image_publishers[index].get_subscription_count():
            self._image_publishers[index].publish(MESSAGES.image(translated, frame.header))
        return translated

    def _crop_for(self, index: int, frame: Frame) -> Crop:
        """Choose the crop at the first frame of each run, and log it when it changes."""
        cached = self._crops[index]
        if cached is not None and frame.step > 0:
            return cached
        crop = self._crop_of(index, frame.crop_top, frame.crop_bottom)
        if crop != cached:
            name = self._namespaces[index] or self.get_namespace()
            rows = f"{crop.top} rows cut off at the top, {crop.bottom} at the bottom"
            source = "as it says" if SIMULATORS in self._given[index] else "from parameters"
            self.get_logger().info(f"{name}: {rows} ({source})")
        self._crops[index] = crop
        return crop

    def _crop_of(self, index: int, top: int, bottom: int) -> Crop:
        """Return the crop of the parameters, or where they leave it to the simulator, its own."""
        pairs = zip(self._given[index], (top, bottom), strict=True)
        return Crop(*(reported if rows == SIMULATORS else rows for rows, reported in pairs))

    def rows_seen(self, spec: SimulatorSpec) -> tuple[int, int] | None:
        """Return the rows that the network sees in images of its own namespace's simulator, as `Pilot.rows_seen`."""
        crop = self._crop_of(0, spec.crop_top, spec.crop_bottom)
        return self._driver.rows_seen(crop, spec.camera.height_px, spec.name)

    def destroy_node(self) -> None:
        """Print the latency of the answers."""
        if self._milliseconds:
            median, slow, longest = np.percentile(self._milliseconds, (50, 99, 100))
            # ROS and its logger may be shut down by now.
            print(
                f"{len(self._milliseconds)} frames answered: median {median:.1f} ms, 99% within {slow:.1f} ms, "
                f"longest {longest:.1f} ms",
                file=sys.stderr,
            )
        super().destroy_node()


def main() -> None:
    """Run the driver until a signal stops it."""
    sys.exit(run_node(DriverNode))


if __name__ == "__main__":
    main()
