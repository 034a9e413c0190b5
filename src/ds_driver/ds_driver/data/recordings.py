# SPDX-License-Identifier: Apache-2.0
"""Reads and imports images and steering from recordings: bags of this project, other bags, Donkey Car tubs."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ds_bags.clock import headers_are_shared, time_of
from ds_bags.donkey_tub import is_tub, read_tub
from ds_bags.layout import TRANSLATED, BagError
from ds_bags.reader import COMPRESSED, IMAGE, STATE, BagReader, read_run
from ds_base.folder_files import place_folder
from ds_base.left_out import LeftOut
from ds_base.progress import Progress, counted, logger_of
from ds_driver.control.autopilot import Autopilot
from ds_driver.control.bicycle import Geometry
from ds_driver.data.dataset import DatasetError, drive_path, keep_import, write_drive
from ds_driver.networks.images import Crop, ImageError, fit_to_network, read_rgb, rgb_of_message
from ds_driver.networks.pilot import NOT_SIMULATED, Frame
from ds_sim.camera.encodings import jpeg
from ds_sim.registry import label_of, received_simulator, simulators, spec_of

LOG = logger_of(__name__)
MOTION = ("nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped")
"""Types whose times are compared with those of the images."""
NEAR = 0.1
"""Largest time between an image and its steering value in other bags, s; chosen: two frames at 20 Hz."""
_PROJECT_BAG = "bag of ours"
"""Kind of a bag of this project; existing data sets store this text."""
Truth = Literal["recorded", "autopilot"]
BLOCK = 100
"""Frames that are together in training or in validation, as consecutive ones look alike; chosen: 5 s at 20 Hz."""
DIRECTION = "recorded"
UNFINISHED = ".importing"
"""Folder of an unfinished import, which readers of data sets ignore."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Settings for reading a recording.

    Attributes:
        camera: topic of the images; None if there is only one.
        steering: topic and field of the steering, such as `/cmd:drive.steering_angle`; None for the
            commands in a bag of this project or a tub.
        factor: converts the field to steering, -1 full left to +1 full right.
        rows: image rows to keep, see `ds_driver.networks.images.fit_to_network`.
        truth: reference for a driver: the recorded steering, or the autopilot's (bags of this project).
        trusted: user-provided simulators whose code may run.
        whole: keep images as they were recorded, of any size, instead of fitting them to the networks.
    """

    camera: str | None = None
    steering: str | None = None
    factor: float = 1.0
    rows: tuple[int, int] | None = None
    truth: Truth = "recorded"
    trusted: tuple[str, ...] = ()
    whole: bool = False

    def fitted(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Fit an image to the networks, unless it is to stay whole."""
        return image if self.whole else fit_to_network(image, self.rows)


@dataclass(frozen=True, kw_only=True)
class RecordedFrame:
    """One recorded image.

    Attributes:
        index: of the image in its recording.
        seconds: since the first image.
        image: (160, 320, 3) uint8 RGB, or of any size if read whole; None if it cannot be read.
        steering: reference, -1 full left to +1 full right, or None.
        throttle: as recorded, at most 1, or None.
        start: time of the first image on the recording's clock, s.
        speed: of the vehicle, m/s; 0 if not recorded.
        trouble: reason why there is no image.
        simulator: whose camera took the image, or `ds_driver.networks.pilot.NOT_SIMULATED`.
    """

    index: int
    seconds: float
    image: NDArray[np.uint8] | None
    steering: float | None
    speed: float = 0.0
    trouble: str = ""
    simulator: str = NOT_SIMULATED
    throttle: float | None = None
    start: float = 0.0

    def seen(self, crop: Crop) -> Frame:
        """Return what a driver gets of an image that can be read; the first begins a run."""
        assert self.image is not None
        spec = spec_of(self.simulator) if self.simulator in simulators() else None
        return Frame(
            image=self.image,
            speed=self.speed,
            crop=crop,
            step=self.index,
            simulator=self.simulator,
            vehicle=None if spec is None else Geometry.of(spec),
        )


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Bag or tub whose images can be read any number of times.

    Attributes:
        group: name under which recordings are pooled: the simulator for a bag of this project, else the folder's name.
        kind: `_PROJECT_BAG`, `bag` or `tub`.
        simulator: see `RecordedFrame`.
    """

    path: Path
    group: str
    kind: str
    reading: Reading
    crop: Crop = Crop()
    simulator: str = NOT_SIMULATED

    @cached_property
    def headers(self) -> bool:
        """Whether times are those of headers, not of logging; a BagError if images and steering share no clock."""
        if self.kind != "bag":
            return True
        with BagReader(self.path) as bag:
            topic = (self.reading.steering or "").partition(":")[0]
            moving = [one for one in bag.connections if one.topic == topic or one.msgtype in MOTION]
            images = [_camera(bag, self.reading)] if bag.of_type(IMAGE) or bag.of_type(COMPRESSED) else []
            shared = headers_are_shared(bag, [*images, *moving], topic)
        if not shared:
            LOG.info("%s: times are those of logging, as the headers have no common clock", self.path)
        return shared

    def frames(self) -> Iterator[RecordedFrame]:
        """Iterate over the images in order; a BagError if the recording is damaged, or has no such topic."""
        return counted(self._frames(), str(self.path))

    def _frames(self) -> Iterator[RecordedFrame]:
        images, second = (_tub_images(self), 1.0) if self.kind == "tub" else (_bag_images(self), 1e9)
        first: float | None = None
        for index, time, place, decode, (steering, speed, throttle) in images:
            first = time if first is None else first
            image, trouble = None, ""
            try:
                image = self.reading.fitted(decode())
            except ImageError as error:
                trouble = f"{place}: {error}"
            yield RecordedFrame(
                index=index,
                seconds=(time - first) / second,
                image=image,
                steering=steering,
                speed=speed,
                trouble=trouble,
                simulator=self.simulator,
                throttle=throttle,
                start=first / second,
            )


def open_recording(path: Path, reading: Reading) -> Recording:
    """Open a bag or a tub.

    Raises:
        ds_bags.layout.BagError: the folder is neither a bag nor a tub, or has no images.
    """
    if is_tub(path):
        if reading.truth == "autopilot":
            raise BagError(f"{path} is a tub: the autopilot's commands are known only for bags of this project")
        return Recording(path=path, group=path.resolve().name, kind="tub", reading=reading)
    with BagReader(path) as bag:
        camera = _camera(bag, reading)
        if "simulator" not in bag.facts or not bag.of_type(STATE):
            if reading.truth == "autopilot":
                raise BagError(f"{path} is no bag of this project: the autopilot's commands are known only for those")
            return Recording(path=path, group=path.resolve().name, kind="bag", reading=reading)
        name = received_simulator(bag.facts["simulator"], confirmed=reading.trusted)
        spec = spec_of(name)
        recording = Recording(path=path, group=name, kind=_PROJECT_BAG, reading=reading)
        if TRANSLATED in bag.facts or _is_translated(camera):
            return recording
        return replace(recording, crop=Crop.of(spec), simulator=spec.name)


_Labels = tuple[float | None, float, float | None]
"""Steering, or None, speed, m/s, and throttle, or None."""
_Recorded = tuple[int, float, str, Callable[[], NDArray[np.uint8]], _Labels]
"""Index, time, place for messages and decoder of an image, and what is recorded beside it."""


def _tub_images(recording: Recording) -> Iterator[_Recorded]:
    for record, file in read_tub(recording.path).pictures:
        yield record.index, record.seconds, str(file), partial(read_rgb, file), (record.steering, 0.0, record.throttle)


def _bag_images(recording: Recording) -> Iterator[_Recorded]:
    """Yield images of a bag, whose times are in ns."""
    with BagReader(recording.path) as bag:
        camera, headers = _camera(bag, recording.reading), recording.headers
        labels = _labels(bag, recording)
        for index, (_, logged, message) in enumerate(bag.decoded([camera])):
            time = time_of(message, logged, headers=headers)
            yield index, time, f"{recording.path}, image {index}", partial(rgb_of_message, message), labels(time)


def _camera(bag: BagReader, reading: Reading) -> Any:
    cameras = [c for c in bag.connections if c.msgtype in (IMAGE, COMPRESSED)]
    if reading.camera is not None:
        cameras = [c for c in cameras if c.topic == reading.camera]
    else:
        cameras = [c for c in cameras if not _is_translated(c)] or cameras
    names = ", ".join(c.topic for c in cameras)
    if not cameras:
        wanted = f"of topic {reading.camera}" if reading.camera else "at all"
        raise BagError(f"{bag.path} has no images {wanted}: record with --level compressed or raw, or choose --camera")
    if len(cameras) > 1:
        raise BagError(f"{bag.path} has several cameras: choose one of {names} with --camera")
    return cameras[0]


def _is_translated(connection: Any) -> bool:
    """Whether a topic has images as a driver saw them."""
    return f"/{TRANSLATED}/" in connection.topic


def _labels(bag: BagReader, recording: Recording) -> Callable[[int], _Labels]:
    """Return what gives the labels at a time in ns."""
    if recording.reading.steering is not None:
        return _nearest(_field(bag, recording))
    if recording.kind != _PROJECT_BAG:
        return lambda _time: (None, 0.0, None)
    recorded = read_run(bag, trusted=recording.reading.trusted)
    observations = recorded.run.observations
    speed = {stamp: o.vehicle.speed for stamp, o in zip(recorded.stamps, observations, strict=True)}
    if recording.reading.truth == "autopilot":
        pilot = Autopilot(spec_of(recorded.simulator).autopilot)
        steering = [pilot.command(o.lane.preview_lateral_position, o.vehicle.speed).steering for o in observations]
    else:
        steering = [command.steering for command in recorded.run.commands]
    # The last frame of a run has no command.
    labels = dict(zip(recorded.stamps, steering, strict=False))
    throttle = {stamp: c.throttle for stamp, c in zip(recorded.stamps, recorded.run.commands, strict=False)}
    return lambda time: (labels.get(time), speed.get(time, 0.0), throttle.get(time))


def _nearest(steering: dict[int, float]) -> Callable[[int], _Labels]:
    """Look up the value that is nearest in time, within `NEAR`."""
    times = np.array(sorted(steering), dtype=np.int64)

    def at(time: int) -> _Labels:
        after = int(np.searchsorted(times, time))
        near = min(map(int, times[max(0, after - 1) : after + 1]), key=lambda t: abs(t - time), default=None)
        return (None if near is None or abs(near - time) > NEAR * 1e9 else steering[near]), 0.0, None

    return at


def _field(bag: BagReader, recording: Recording) -> dict[int, float]:
    reading = recording.reading
    topic, _, path = (reading.steering or "").partition(":")
    connections = [connection for connection in bag.connections if connection.topic == topic]
    if not connections or not path:
        names = ", ".join(sorted({c.topic for c in bag.connections}))
        raise BagError(f"{bag.path}: steering {reading.steering!r}: expected TOPIC:FIELD with one of {names}")
    values = {}
    for connection, logged, message in bag.decoded(connections):
        try:
            value = reading.factor * float(attrgetter(path)(message))
        except (AttributeError, TypeError, ValueError):
            raise BagError(f"{bag.path}: {connection.msgtype} has no number {path!r}: see `ds bag info`") from None
        if math.isfinite(value):
            values[time_of(message, logged, headers=recording.headers)] = min(max(value, -1.0), 1.0)
    return values


@dataclass(frozen=True, kw_only=True)
class Imported:
    """Result of an import: its `images` are in the data set, `unlabelled` ones, without steering, are left out."""

    name: str
    images: int
    unlabelled: int
    files: int


def import_recordings(
    recordings: list[Recording], out: Path, name: str, progress: Progress, left_out: LeftOut | None = None
) -> Imported:
    """Write recordings into a data set under a name of their own, as images of (160, 320, 3) RGB, which stay uncropped.

    Images that cannot be read are `left_out`; the first one is a DatasetError if that is None.
    """
    if name in simulators() or name != label_of(name) or not name.strip("."):
        raise DatasetError(
            f"name {name!r}: expected one without {', '.join(simulators())}, slashes and spaces: choose another --name"
        )
    if (out / name).exists():
        raise DatasetError(f"{out / name} is there already: choose another --name, or delete it")
    stems = [recording.path.resolve().name for recording in recordings]
    if len(set(stems)) < len(stems):
        raise DatasetError("two recordings have the same name: rename the folder of one")
    unfinished = out / UNFINISHED
    shutil.rmtree(unfinished, ignore_errors=True)
    left_out = left_out or LeftOut("images", strict=True)
    images = unlabelled = files = 0
    progress.start(len(recordings))
    for recording, stem in zip(recordings, stems, strict=True):
        rows: list[dict[str, object]] = []
        for frame in recording.frames():
            left_out.total += 1
            if frame.image is None:
                left_out.add(recording.path.name, frame.trouble, DatasetError)
                continue
            if frame.steering is None:
                unlabelled += 1
                continue
            block = f"{stem}.{len(rows) // BLOCK:04d}"
            rows.append(
                {
                    "image": jpeg(frame.image),
                    "steering": frame.steering,
                    "speed": frame.speed,
                    "step": frame.index,
                    "simulator": name,
                    "road_id": block,
                    "direction": DIRECTION,
                }
            )
        for first in range(0, len(rows), BLOCK):
            part = rows[first : first + BLOCK]
            write_drive(drive_path(unfinished, name, str(part[0]["road_id"]), DIRECTION), part)
            files += 1
        images += len(rows)
        progress.advance(line=f"{recording.path}: {len(rows)} images")
    if not images and left_out.items:
        raise DatasetError(left_out.line())
    if not images:
        named = recordings[0].reading.steering
        advice = (
            "name its topic with --steering TOPIC:FIELD" if named is None else f"{named} has none within {NEAR:g} s"
        )
        raise DatasetError(f"no image has a steering beside it: {advice}")
    about: dict[str, Any] = {"recordings": stems, "kinds": sorted({r.kind for r in recordings}), "images": images}
    keep_import(unfinished, name, about | {"unlabelled": unlabelled, "rows": recordings[0].reading.rows})
    place_folder(unfinished / name, out / name)
    unfinished.rmdir()
    return Imported(name=name, images=images, unlabelled=unlabelled, files=files)
