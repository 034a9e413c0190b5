# SPDX-License-Identifier: Apache-2.0
"""Writes one rosbag2 folder per run, as ROS 2 Jazzy does (metadata version 9, MCAP), without a ROS install."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_bags.layout import TRANSLATED, BagError, Level, partial_path
from ds_bags.messages import frame_times, message_builder, typestore
from ds_bags.rosbag2_writer import Rosbag2Writer, topic_of
from ds_base.folder_files import place_folder
from ds_base.installation import versions
from ds_road import road_to_json
from ds_sim.conditions.text import format_conditions
from ds_sim.frames import ROAD_FRAME, START
from ds_sim.registry import SimulatorName, spec_of
from ds_sim.resimulation import resimulate
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation, SimulatorSpec

_TOPICS = {
    "road": ("ds_interfaces/msg/Road", 1, True),
    "road_markers": ("visualization_msgs/msg/MarkerArray", 1, True),
    "/tf_static": ("tf2_msgs/msg/TFMessage", 1, True),
    "/tf": ("tf2_msgs/msg/TFMessage", 100, False),
    "state": ("ds_interfaces/msg/VehicleState", 50, False),
    "odom": ("nav_msgs/msg/Odometry", 50, False),
    "drive": ("ds_interfaces/msg/DriveCommand", 10, False),
    "camera/camera_info": ("sensor_msgs/msg/CameraInfo", 5, False),
    "camera/image_raw": ("sensor_msgs/msg/Image", 5, False),
    "camera/image_raw/compressed": ("sensor_msgs/msg/CompressedImage", 5, False),
    "sim2real/image_raw": ("sensor_msgs/msg/Image", 5, False),
    "sim2real/image_raw/compressed": ("sensor_msgs/msg/CompressedImage", 5, False),
    "outcome": ("ds_interfaces/msg/Outcome", 1, True),
}
"""Topic (relative to the simulator's namespace, or absolute) -> type, queue depth, latched or not."""
Translation = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
"""Maps a camera image to the translated one that the driver saw, both (rows, columns, 3) uint8 RGB."""
_IMAGE_TOPIC = {"compressed": "camera/image_raw/compressed", "raw": "camera/image_raw"}


def facts_of(simulator: SimulatorName, run: RunRecord, level: Level) -> dict[str, str]:
    """Custom data of a bag that is known before the run has ended."""
    return {
        "simulator": str(simulator),
        "engine": spec_of(simulator).engine,
        "level": level,
        "road": json.dumps(road_to_json(run.road)),
        "road_id": run.road.road_id,
        "seed": str(run.seed),
        **({} if run.conditions.is_default else {"conditions": format_conditions(run.conditions)}),
        **{f"version.{name}": version for name, version in versions().items()},
    }


def write_bag(
    folder: Path,
    namespace: str,
    simulator: SimulatorName,
    run: RunRecord,
    about: Mapping[str, str],
    level: Level = "telemetry",
    observations: Iterable[Observation] | None = None,
    translate: Translation | None = None,
) -> int:
    """Write the bag of one run, and return the number of its camera images; stamps count from 1 s.

    A run record holds no images. A level with images re-simulates the recorded commands in this process, which yields
    the same images bit by bit and does not slow down the run itself.

    Args:
        folder: bag to write; appears whole or not at all, and replaces an existing bag.
        namespace: namespace of the simulator, such as `/ds1`.
        simulator: name of the simulator in the registry.
        run: the recorded run.
        about: custom data in addition to road, seed, versions and outcome, which are always written.
        level: whether the bag holds images, and how they are encoded.
        observations: the run's observations with images, if available; empty images are left out.
        translate: how the driver saw the images, which a level with images writes, too; None if as they are.

    Raises:
        BagError: the folder cannot be written.
        ds_sim.resimulation.ResimulationError: re-simulation differs from the recorded run, so there are no images.

    Examples:
        >>> from pathlib import Path
        >>> from ds_bags import BagReader, read_run, write_bag
        >>> from ds_driver import drive_road, make_driver
        >>> from ds_road import Road
        >>> from ds_sim import make_simulator
        >>> simulator = make_simulator("softbody")
        >>> road = Road([(125, 0), (125, 25), (125, 50), (125, 75)])
        >>> run = drive_road(simulator, make_driver("autopilot", simulator.spec), road, seed=1)
        >>> write_bag(Path("straight"), "/ds2", "softbody", run, about={"driver": "autopilot"})
        0
        >>> with BagReader(Path("straight")) as bag:
        ...     recorded = read_run(bag)
        >>> recorded.run.outcome.name, recorded.run.commands == run.commands
        ('COMPLETED', True)
    """
    # The files inside are named after the bag, so the partial bag has the same name, one level deeper.
    hidden = partial_path(folder)
    facts = facts_of(simulator, run, level) | dict(about)
    if observations is None:
        observations = run.observations if level == "telemetry" else resimulate(simulator, run)
    try:
        shutil.rmtree(hidden, ignore_errors=True)
        with Rosbag2Writer(hidden / folder.name, facts) as writer:
            messages = RunWriter(writer, namespace, spec_of(simulator), run, level, translate)
            messages.begin()
            messages.frames(None if level == "telemetry" else observations)
            messages.end()
            results = {
                "outcome": run.outcome.name,
                "message": run.message,
                "steps": str(run.steps),
                "fitness": repr(run.fitness),
                "max_lateral_position": repr(run.max_lateral_position),
                **({"images": str(messages.images)} if level != "telemetry" else {}),
            }
            writer.close(facts | results)
        shutil.rmtree(folder, ignore_errors=True)
        place_folder(hidden / folder.name, folder)
    except OSError as error:
        raise BagError(f"bag {folder} cannot be written ({error.strerror}): check the disk and the folder") from None
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return messages.images


class RunWriter:
    """Writes the messages of one run in order, frame by frame; see `write_bag`."""

    def __init__(
        self,
        writer: Rosbag2Writer,
        namespace: str,
        spec: SimulatorSpec,
        run: RunRecord,
        level: Level,
        translate: Translation | None = None,
    ) -> None:
        self._writer, self._spec, self._run, self._translate = writer, spec, run, translate
        self._make, self._store = message_builder(namespace), typestore()
        self._image = _IMAGE_TOPIC.get(level, "")
        self._translated = self._image.replace("camera", TRANSLATED, 1) if translate is not None else ""
        self.images = 0
        pictured = {self._image, self._translated, "camera/camera_info"} if self._image else set()
        self._channels: dict[str, int] = {}
        for topic, (kind, depth, latched) in _TOPICS.items():
            if topic in pictured or not topic.startswith(("camera/", TRANSLATED)):
                name = topic if topic[0] == "/" else f"{namespace}/{topic}"
                described = topic_of(self._store, name, kind, depth=depth, latched=latched)
                self._channels[topic] = writer.channel(described)

    def begin(self) -> None:
        """Write what is constant over the run: the road and the camera's mount."""
        start = self._make.stamp(START)
        self._put("road", START, self._make.road(self._run.road))
        self._put("road_markers", START, self._make.road_markers(self._run.road, self._spec.look, start))
        self._put("/tf_static", START, self._make.camera_transform(self._spec.camera, start))

    def frames(self, observations: Iterable[Observation] | None = None) -> None:
        """Write all frames and the commands that answer them, and the images of the observations if there are any."""
        run, make = self._run, self._make
        images = run.observations if observations is None else observations
        for index, (frame, pictured, time) in enumerate(
            zip(run.observations, images, (START + frame_times(run)).tolist(), strict=True)
        ):
            header = make.header(time, ROAD_FRAME)
            self._put("state", time, make.state(frame, header, run.road.road_id))
            self._put("odom", time, make.odometry(frame.vehicle, header.stamp))
            self._put("/tf", time, make.body_transform(frame.vehicle, header.stamp))
            if observations is not None:
                self._put_image(pictured, time)
            if index < len(run.commands):
                self._put("drive", time, make.command(run.commands[index], header))

    def _put_image(self, frame: Observation, time: int) -> None:
        if not frame.image.size:
            return
        self.images += 1
        image = self._make.image if self._image == "camera/image_raw" else self._make.compressed_image
        header = self._make.header(time, self._make.camera_frame)
        self._put(self._image, time, image(frame.image, header))
        if self._translate is not None:
            translated = self._translate(frame.image)
            self._put(self._translated, time, image(translated, header))
        self._put("camera/camera_info", time, self._make.camera_info(self._spec.camera, header))

    def end(self) -> None:
        """Write the outcome."""
        ended = START + round(self._run.simulated_seconds * 1e9)
        self._put("outcome", ended, self._make.outcome(int(self._run.outcome)))

    def _put(self, topic: str, nanoseconds: int, message: Any) -> None:
        data = bytes(self._store.serialize_cdr(message, _TOPICS[topic][0]))
        self._writer.write(self._channels[topic], nanoseconds, data)
