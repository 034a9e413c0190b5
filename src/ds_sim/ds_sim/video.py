# SPDX-License-Identifier: Apache-2.0
"""Renders a run as a video: camera image, map of the road, speed, commands and lateral position."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_base.figures import draw_figure
from ds_base.folder_files import make_parents
from ds_base.palette import FAIL_ON_DARK, PASS, SERIES, rgb
from ds_road import Road
from ds_road.picture import map_axes
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import format_3sf
from ds_sim.session import RunRecord
from ds_sim.simulator import FRAME_RATE, Command, Observation, Outcome

MAGNIFICATION = 3
"""Video pixels per camera pixel; chosen: a camera image fills half of a common screen."""
PAIRED_MAGNIFICATION = 2
"""The same where a translated image is shown below the camera's; chosen: both fit on a common screen."""
PANEL = 300
"""Width of the panel beside the camera image, pixels."""
CODEC = "mp4v"
"""MPEG-4 part 2: OpenCV's wheels write it without a system codec, and desktop players read it."""
_MAP = 280
_BACKGROUND, _TEXT, _FAINT, _TRAJECTORY = (24, 26, 30), (235, 235, 235), (110, 115, 120), rgb(SERIES[2])
_GOOD, _BAD = rgb(PASS), rgb(FAIL_ON_DARK)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
_LINE = 46
"""Characters of a line of conditions, which fills the panel."""


class VideoError(InputError):
    """A video cannot be written."""


def check_path(path: Path) -> None:
    """Check before driving whether a video can be written; VideoError for another ending or a missing folder."""
    if path.suffix != ".mp4":
        raise VideoError(f"video {path.name!r}: expected a name that ends with .mp4")
    if not path.parent.is_dir():
        raise VideoError(f"{path.parent} is not a folder: create it first, or choose another --video")


def write_video(
    path: Path,
    title: str,
    road: Road,
    observations: Iterable[Observation],
    commands: list[Command],
    conditions: Conditions = DEFAULT,
    translate: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None,
) -> None:
    """Write a run as a video at the speed of simulated time; the last frame is shown for one second.

    Args:
        path: name that ends with `.mp4`; the file appears complete or not at all.
        title: text above the panel, such as simulator and driver.
        road: road that was driven.
        observations: one per frame, with images.
        commands: command k led from frame k to frame k + 1.
        conditions: operating conditions of the run, named below the gauges.
        translate: how the driver saw the images, which are shown below the camera's; None if as they are.

    Raises:
        VideoError: the video cannot be written.
    """
    _write_frames(path, _frames(title, road, observations, commands, conditions, translate))


def write_together(path: Path, drives: Sequence[tuple[str, RunRecord, Iterable[Observation]]]) -> None:
    """Write drives, each a title, a run and its observations with images, one below the other, as `write_video` does.

    One that has ended shows its last frame until all have.
    """
    films = [
        _frames(title, run.road, observations, run.commands, run.conditions) for title, run, observations in drives
    ]
    _write_frames(path, map(np.vstack, _held(films)))


def _held(films: Sequence[Iterator[NDArray[np.uint8]]]) -> Iterator[list[NDArray[np.uint8]]]:
    """Frames of all films at a time, the last one of those that have ended."""
    shown: list[NDArray[np.uint8]] = []
    for frames in zip_longest(*films):
        shown = [new if new is not None else shown[place] for place, new in enumerate(frames)]
        yield shown


def _frames(
    title: str,
    road: Road,
    observations: Iterable[Observation],
    commands: Sequence[Command],
    conditions: Conditions,
    translate: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Frames of a run; see `write_video`."""
    panel = _Panel(title, road, conditions)
    for step, observation in enumerate(observations):
        command = commands[step] if step < len(commands) else None
        translated = None if translate is None else translate(observation.image)
        yield compose(observation, panel.draw(observation, command), translated)


def _write_frames(path: Path, frames: Iterable[NDArray[np.uint8]]) -> None:
    """Write RGB frames of one size as a video."""
    check_path(path)
    partial, writer, last = path.with_name(f".{path.stem}.partial.mp4"), cv2.VideoWriter(), None
    make_parents(path)
    partial.unlink(missing_ok=True)  # OpenCV would follow a link
    try:
        for frame in frames:
            if last is None:
                size = (frame.shape[1], frame.shape[0])
                if not writer.open(str(partial), cv2.VideoWriter.fourcc(*CODEC), FRAME_RATE, size):
                    raise VideoError(f"{path} cannot be written: check the folder and the disk")
            last = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
            writer.write(last)
        if last is None:
            return  # a run that ended before its first frame
        for _ in range(round(FRAME_RATE)):
            writer.write(last)
        writer.release()
        partial.rename(path)
    finally:
        writer.release()
        partial.unlink(missing_ok=True)


def compose(
    observation: Observation, panel: NDArray[np.uint8], translated: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Place camera image and panel side by side, (480, 1260, 3) uint8 RGB; (640, 940, 3) with a translated image."""
    images, scale = [observation.image], MAGNIFICATION
    if translated is not None:
        images, scale = [observation.image, translated], PAIRED_MAGNIFICATION
    size = (IMAGE_WIDTH * scale, IMAGE_HEIGHT * scale)
    pictures = np.vstack([cv2.resize(image, size, interpolation=cv2.INTER_LINEAR) for image in images])
    beside = np.full((len(pictures), PANEL, 3), _BACKGROUND, np.uint8)
    beside[: len(panel)] = panel
    return np.hstack((pictures, beside)).astype(np.uint8)


class _Panel:
    """Panel beside the camera image: a map with the trajectory so far, and gauges."""

    def __init__(self, title: str, road: Road, conditions: Conditions) -> None:
        self._title, self._half_lane = title, road.lane_width / 2
        words = ", ".join(f"{name}={format_3sf(value)}" for name, value in conditions.changed.items())
        self._conditions = textwrap.wrap(words, _LINE, max_lines=2, placeholder=" ...", break_long_words=False)
        surface = np.vstack((road.left_edge, road.right_edge))
        low, high = surface.min(axis=0) - 4.0, surface.max(axis=0) + 4.0
        self._scale = _MAP / float((high - low).max())
        self._origin = (low + high) / 2 - _MAP / 2 / self._scale
        self._map = draw_figure(
            _MAP, _MAP, lambda figure: map_axes(figure, road, self._origin, self._scale, (_MAP, _MAP))
        )
        self._previous: NDArray[np.float64] | None = None

    def draw(self, observation: Observation, command: Command | None) -> NDArray[np.uint8]:
        """Draw the panel of one frame, (480, 300, 3) uint8 RGB."""
        panel = np.full((IMAGE_HEIGHT * MAGNIFICATION, PANEL, 3), _BACKGROUND, np.uint8)
        vehicle, lane = observation.vehicle, observation.lane
        here = np.array([[vehicle.x, vehicle.y]])
        if self._previous is not None:
            cv2.polylines(
                self._map, [self._pixels(np.vstack((self._previous, here)))], False, _TRAJECTORY, 2, cv2.LINE_AA, _SHIFT
            )
        self._previous = here
        top, left = 28, (PANEL - _MAP) // 2
        view = panel[top : top + _MAP, left : left + _MAP]
        view[:] = self._map
        nose = 6.0 / self._scale * np.array([math.cos(vehicle.yaw), math.sin(vehicle.yaw)])
        side = 0.6 * np.array([-nose[1], nose[0]])
        arrow = here + np.array([nose, side - nose, -side - nose])
        cv2.fillPoly(view, [self._pixels(arrow)], _TEXT, cv2.LINE_AA, _SHIFT)
        _write(panel, self._title, (left, 19))
        row = top + _MAP + 26
        _write(panel, f"{observation.time:6.2f} s", (left, row))
        _write(panel, f"{vehicle.speed * 3.6:4.1f} km/h", (left + 100, row))
        failed = observation.outcome not in (Outcome.RUNNING, Outcome.COMPLETED)
        state = "" if observation.outcome is Outcome.RUNNING else observation.outcome.words
        _write(panel, state, (left + 180, row), _BAD if failed else _GOOD)
        lateral, out_of_bounds = lane.lateral_position, lane.lateral_distance < 0.0
        _gauge(panel, row + 34, "lateral", lateral / self._half_lane, f"{lateral:+.2f} m", bad=out_of_bounds)
        steering, throttle = (command.steering, command.throttle) if command else (0.0, 0.0)
        _gauge(panel, row + 66, "steering", steering, f"{steering:+.2f}")
        _gauge(panel, row + 98, "throttle", throttle, f"{throttle:.2f}")
        for line, text in enumerate(self._conditions):
            _write(panel, text, (left, row + 122 + 15 * line), size=0.36)
        return panel

    def _pixels(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        flipped = (points - self._origin) * self._scale * (1.0, -1.0) + (0.0, _MAP)
        return np.round((flipped - 0.5) * (1 << _SHIFT)).astype(np.int32)


def _gauge(panel: NDArray[np.uint8], row: int, name: str, value: float, text: str, *, bad: bool = False) -> None:
    """Draw a value in [-1, 1] as a bar from the middle; right is positive, as on the road."""
    left, right, middle = 82, 212, 147
    _write(panel, name, (10, row + 5))
    cv2.line(panel, (left, row), (right, row), _FAINT, 1)
    cv2.line(panel, (middle, row - 8), (middle, row + 8), _FAINT, 1)
    end = middle + round(max(-1.0, min(1.0, value)) * (right - middle))
    cv2.line(panel, (middle, row), (end, row), _BAD if bad else _GOOD, 7)
    _write(panel, text, (222, row + 5))


def _write(
    panel: NDArray[np.uint8], text: str, at: tuple[int, int], ink: tuple[int, int, int] = _TEXT, *, size: float = 0.45
) -> None:
    cv2.putText(panel, text, at, _FONT, size, ink, 1, cv2.LINE_AA)
