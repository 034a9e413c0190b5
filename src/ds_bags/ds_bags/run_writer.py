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
from ds_bags.rosbag2_writer import Rosbag2Writer, topic_of, typestore
from ds_base.folder_files import place_folder
from ds_base.installation import versions
from ds_road import road_to_json
from ds_sim.conditions.text import format_conditions
from ds_sim.messages import ROAD_FRAME, START, MessageBuilder
from ds_sim.registry import SimulatorName, spec_of
from ds_sim.session import RunRecord, resimulate
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


def message_builder(namespace: str) -> MessageBuilder:
    """Make the builder of the messages of one simulator's bag, whose namespace prefixes its tf frames."""
    types = typestore().types
    return MessageBuilder(lambda name: types[name.replace("/", "/msg/")], np.asarray, namespace)


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
        ds_sim.session.ResimulationError: re-simulation differs from the recorded run, so there are no images.

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
            images = _write_run(writer, namespace, spec_of(simulator), run, level, observations, translate)
            results = {
                "outcome": run.outcome.name,
                "message": run.message,
                "steps": str(run.steps),
                "fitness": repr(run.fitness),
                "max_lateral_position": repr(run.max_lateral_position),
                **({"images": str(images)} if level != "telemetry" else {}),
            }
            writer.close(facts | results)
        shutil.rmtree(folder, ignore_errors=True)
        place_folder(hidden / folder.name, folder)
    except OSError as error:
        raise BagError(f"bag {folder} cannot be written ({error.strerror}): check the disk and the folder") from None
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return images


def _write_run(
    writer: Rosbag2Writer,
    namespace: str,
    spec: SimulatorSpec,
    run: RunRecord,
    level: Level,
    observations: Iterable[Observation],
    translate: Translation | None,
) -> int:
    """Write the messages of one run, frame by frame, and return the number of its images; see `write_bag`."""
    make, store = message_builder(namespace), typestore()
    image_topic = _IMAGE_TOPIC.get(level, "")
    translated_topic = image_topic.replace("camera", TRANSLATED, 1) if translate is not None else ""
    pictured_topics = {image_topic, translated_topic, "camera/camera_info"} if image_topic else set()
    channels: dict[str, int] = {}
    for topic, (kind, depth, latched) in _TOPICS.items():
        if topic in pictured_topics or not topic.startswith(("camera/", TRANSLATED)):
            name = topic if topic[0] == "/" else f"{namespace}/{topic}"
            channels[topic] = writer.channel(topic_of(name, kind, depth=depth, latched=latched))

    def put(topic: str, nanoseconds: int, message: Any) -> None:
        writer.write(channels[topic], nanoseconds, bytes(store.serialize_cdr(message, _TOPICS[topic][0])))

    start = make.stamp(START)
    put("road", START, make.road(run.road))
    put("road_markers", START, make.road_markers(run.road, spec.look, start))
    put("/tf_static", START, make.camera_transform(spec.camera, start))
    image_of = make.image if level == "raw" else make.compressed_image
    images = 0
    for index, (frame, pictured) in enumerate(zip(run.observations, observations, strict=True)):
        time = START + round(frame.time * 1e9)
        header = make.header(time, ROAD_FRAME)
        put("state", time, make.state(frame, header, run.road.road_id))
        put("odom", time, make.odometry(frame.vehicle, header.stamp))
        put("/tf", time, make.body_transform(frame.vehicle, header.stamp))
        if image_topic and pictured.image.size:
            images += 1
            camera_header = make.header(time, make.camera_frame)
            put(image_topic, time, image_of(pictured.image, camera_header))
            if translate is not None:
                put(translated_topic, time, image_of(translate(pictured.image), camera_header))
            put("camera/camera_info", time, make.camera_info(spec.camera, camera_header))
        if index < len(run.commands):
            put("drive", time, make.command(run.commands[index], header))
    put("outcome", START + round(run.simulated_seconds * 1e9), make.outcome(int(run.outcome)))
    return images
