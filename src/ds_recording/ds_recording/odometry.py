# SPDX-License-Identifier: Apache-2.0
"""What wheels, gyroscopes and given poses say about the motion between images, checked against the images themselves.

Only relative motion counts: speeds are ways ahead over a time, yaw rates are turns, and poses give both, so neither a
frame of reference nor a place is asked for. Nothing is believed unseen: over the recording a source must turn and move
as the images do, or it is reported and left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ds_bags.clock import time_of
from ds_bags.donkey_tub import read_tub
from ds_bags.reader import BagReader
from ds_base.words import multiple
from ds_driver.data.recordings import MOTION, Recording
from ds_recording import RecordingError
from ds_recording.motion import NOTHING, Hint
from ds_road.road import abbreviated

Array = NDArray[np.float64]
AHEAD, TURN = 0, 2
"""Part of a motion that a source speaks about."""
SPEEDS = ("enc/speed", "pos/speed")
"""Speeds of a tub, m/s: of Donkey Car's encoders, and of its simulator."""
GYROSCOPES = (("imu/gyr_z", math.radians(1.0)), ("imu/gyr_y", -1.0))
"""Yaw rates of a tub, and the factor to rad/s to the left. Donkey Car's parts/imu.py (MPU-6050 and MPU-9250) writes
degrees/s, about z upwards on a board that lies flat; parts/realsense435i.py rad/s, about y downwards."""
ODOMETRY, IMU, POSE = MOTION
LARGEST = 50.0
"""Largest speed (m/s) and yaw rate (rad/s); chosen: beyond, it is no measurement of a car."""
FARTHEST = 1e6
"""Farthest place, m."""
MOST_SAMPLES = 5_000_000
"""Values of a source; chosen: three hours at 400 Hz."""
GAP = 0.25
"""Longest time between two values, s; chosen: a sensor slower than this says nothing about a motion between images."""
HANGS = 0.5
"""Time for which a value may stay exactly the same, s; chosen: noise and a car change it, a hung sensor repeats it."""
DELAYS = np.arange(-0.1, 0.2001, 0.025)
"""Times by which images may be later than a source, s; chosen: an exposure, a frame or two of delivery, smoothing."""
TOGETHER = 0.5
"""Time over which motions are added up before they are compared, s; chosen: errors of a single time even out."""
LEAST_STEPS = 60
"""Motions that must be seen by both."""
CONTRADICTS = 4.0
"""Deviations, over `TOGETHER`, beyond which a source is left out for a while: a wheel slips, a gyroscope hangs."""
LEAST_AGREEING = 0.7
"""Share of the time that a source must agree."""
MOST_LEFT = 0.5
"""Largest share of the motion's deviation that a source may leave unexplained; chosen: one that hangs leaves all."""
EVEN = 0.03
"""Deviation, as a share of the way, that is little enough even where the speed hardly varies."""
TURN_SCALE = (0.8, 1.25)
"""Turns in images over those of a gyroscope; chosen: its scale is right within 3%, images are worse."""
CLOSE, LEAST_CLOSE = 0.1, 0.25
"""Ways within this share of the source's, at the scale that most have, and how many there must be where images lose the
floor too often to follow it; chosen: of ways that have nothing to do with each other it is an eighth."""
SCALE_STD, IMAGE_STD = 0.02, 0.05
"""Deviations of an encoder's metre (a tyre under load) and of one in images (half of 9% on soft texture); chosen."""
SURPRISE = 2.0 * math.hypot(SCALE_STD, IMAGE_STD)
"""Difference of an encoder's metre from that of images from which on it is a surprise: two deviations of both."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """One source of ways or turns."""

    name: str  # field or topic
    device: str  # what it is of; sources of one device are different readings of the same values
    part: int  # `AHEAD` or `TURN`
    times: Array  # s, as those of the images, increasing, (m,)
    values: Array  # way or turn since the start, m or rad, (m,); or places, m, (m, 2), for ways without a sign

    def steps(self, seconds: Array) -> Array:
        """Ways or turns between times, (n,): (n - 1,); NaN in gaps."""
        if len(self.times) < 2:
            return np.full(len(seconds) - 1, np.nan)
        step = np.diff(np.stack([np.interp(seconds, self.times, v) for v in np.atleast_2d(self.values.T)]), axis=1)
        after = np.clip(np.searchsorted(self.times, seconds), 1, len(self.times) - 1)
        long = np.concatenate(([False], np.diff(self.times) > GAP))
        covered = (seconds >= self.times[0]) & (seconds <= self.times[-1]) & ~long[after]
        covered = covered[1:] & covered[:-1] & (np.diff(np.cumsum(long)[after]) == 0)
        return np.where(covered, step[0] if len(step) == 1 else np.hypot(*step), np.nan)


@dataclass(frozen=True, kw_only=True)
class Checked:
    """A source beside the images."""

    source: Source
    scale: float = math.nan  # motion in images over that of the source, NaN if unknown
    bias: float = 0.0  # of a turn, rad/s; 0 for a way
    delay: float = 0.0  # by which images are later, s
    residual: float = math.nan  # deviation of a motion between two images from theirs, m or rad
    std: float = math.nan  # deviation of the source's own motions, m or rad
    left: float = math.inf  # share of the motion's deviation that is left unexplained
    steps: Array  # what it says about each motion, m or rad, in the images' scale, (n - 1,); NaN where nothing
    reason: str = ""  # why it is not used; empty if it is

    @property
    def about(self) -> dict[str, Any]:
        """For `recording.json`."""
        turn = self.source.part == TURN
        values = {
            "scale": self.scale,
            "bias_radps": self.bias,
            "delay_s": self.delay,
            "residual_rad" if turn else "residual_m": self.residual,
            "known": float(np.isfinite(self.steps).mean()),
        }
        return {
            "source": self.source.name,
            "gives": "turns" if turn else "ways",
            "used": not self.reason,
            "reason": self.reason,
        } | {k: v if math.isfinite(v) else None for k, v in values.items()}


def read_sources(recording: Recording, start: float, wanted: str | None = None) -> list[Source]:
    """Read what a bag or tub says about motion beside its images, whose second zero is at `start` on its clock, s.

    `wanted` is a tub's field or a bag's topic; `none` for nothing; all sensors if None, but no odometry of a bag of
    this project, a simulator's truth. RecordingError if there is no such field or topic, or far too much of it.
    """
    if wanted == "none" or (wanted is None and recording.kind not in ("tub", "bag")):
        return []
    read = _tub_sources if recording.kind == "tub" else _bag_sources
    readings = list(read(recording, start, wanted))
    if wanted is not None and not readings:
        raise RecordingError(
            f"{recording.path}: --odometry {abbreviated(wanted)}: expected a field ({', '.join(SPEEDS)}, "
            f"{', '.join(name for name, _ in GYROSCOPES)}) of a tub, or a topic of {ODOMETRY}, {IMU} or {POSE}"
        )
    return readings


def _rate(name: str, device: str, part: int, times: Array, rates: Array) -> Source:
    """Source of a rate, per second, by the trapezoid rule; what cannot be is a gap."""
    times, rates = _sound(times, rates, LARGEST)
    run = np.cumsum(np.diff(rates, prepend=np.nan) != 0.0)  # the same value to the last bit
    held = times[np.searchsorted(run, run, side="right") - 1] - times[np.searchsorted(run, run)]
    times, rates = times[held < HANGS], rates[held < HANGS]
    total = np.concatenate(([0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(times))))
    return Source(name=name, device=device, part=part, times=times, values=total[: len(times)])


def _sound(times: Array, values: Array, largest: float) -> tuple[Array, Array]:
    """Rows that are numbers, of possible size and later than those before."""
    rows = values if values.ndim == 2 else values[:, None]
    usable = np.isfinite(times) & np.isfinite(rows).all(axis=1) & (np.abs(rows) <= largest).all(axis=1)
    times, values = times[usable], values[usable]
    later = np.concatenate(([True], times[1:] > np.maximum.accumulate(times)[:-1]))[: len(times)]
    return times[later], values[later]


def _tub_sources(recording: Recording, start: float, wanted: str | None) -> Iterator[Source]:
    tub = read_tub(recording.path)  # poses are in none that Donkey Car writes on a car
    readings = [(name, name, AHEAD, 1.0) for name in SPEEDS]
    readings += [(name, name.rpartition("_")[0], TURN, factor) for name, factor in GYROSCOPES]
    for name, device, part, factor in readings:
        if wanted in (None, name) and np.isfinite(values := factor * tub.numbers(name)).any():
            yield _rate(name, device, part, tub.seconds - start, values)


def _bag_sources(recording: Recording, start: float, wanted: str | None) -> Iterator[Source]:
    with BagReader(recording.path) as bag:
        for connection in bag.connections:
            topic, kind = connection.topic, connection.msgtype
            if kind not in (ODOMETRY, IMU, POSE) or wanted not in (None, topic):
                continue
            rows: list[tuple[float, ...]] = []
            for _, logged, message in bag.decoded([connection]):
                if len(rows) > MOST_SAMPLES:
                    raise RecordingError(f"{bag.path}: more than {MOST_SAMPLES} messages of {topic}: split the bag")
                try:
                    values = _IN_MESSAGE[kind](message)
                except (AttributeError, TypeError, ValueError, IndexError, OverflowError):
                    continue  # another message of the same name
                rows.append((time_of(message, logged, headers=recording.headers) / 1e9 - start, *values))
            table = np.array(rows, dtype=np.float64).reshape(-1, 6)
            times, speed, rate = table[:, :3].T
            # Many publishers fill in one of both: a twist, with the car's own axes (REP-105), or a pose.
            if np.nan_to_num(speed).any():
                yield _rate(f"{topic} twist", topic, AHEAD, times, speed)
            if np.nan_to_num(rate).any():
                yield _rate(f"{topic} twist" if kind == ODOMETRY else topic, topic, TURN, times, rate)
            at, pose = _sound(times, table[:, 3:], FARTHEST)
            if len(at) and np.ptp(pose, axis=0).any():
                name = f"{topic} pose" if kind == ODOMETRY else topic
                yield Source(name=name, device=topic, part=AHEAD, times=at, values=pose[:, :2])
                yield Source(name=name, device=topic, part=TURN, times=at, values=np.unwrap(pose[:, 2]))


def _numbers(message: Any, *paths: str) -> list[float]:
    return [float(reduce(getattr, path.split("."), message)) for path in paths]


def _of_pose(pose: Any) -> tuple[float, ...]:
    x, y, *q = _numbers(pose, "position.x", "position.y", *(f"orientation.{axis}" for axis in "xyzw"))
    is_unit = abs(sum(v * v for v in q) - 1.0) < 0.1
    yaw = math.atan2(2.0 * (q[3] * q[2] + q[0] * q[1]), 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2)) if is_unit else math.nan
    return x, y, yaw


def _of_imu(message: Any) -> tuple[float, ...]:
    # REP-103: the axes of an optical frame are right, down, ahead; REP-145: -1 says that there is no such value.
    optical = str(message.header.frame_id).endswith(("_optical", "_optical_frame"))
    (rate,) = _numbers(message, "angular_velocity.y" if optical else "angular_velocity.z")
    rate = math.nan if float(message.angular_velocity_covariance[0]) == -1.0 else -rate if optical else rate
    return math.nan, rate, math.nan, math.nan, math.nan


def _of_odometry(message: Any) -> tuple[float, ...]:
    return *_numbers(message.twist.twist, "linear.x", "angular.z"), *_of_pose(message.pose.pose)


def _of_stamped(message: Any) -> tuple[float, ...]:
    return math.nan, math.nan, *_of_pose(message.pose)


_IN_MESSAGE: dict[str, Callable[[Any], tuple[float, ...]]] = {ODOMETRY: _of_odometry, IMU: _of_imu, POSE: _of_stamped}
"""Speed, yaw rate, x, y and yaw in a message; NaN where it has none."""


def check(sources: Sequence[Source], seconds: Array, by_camera: Array, stds: Array, lane_width: float) -> list[Checked]:
    """Compare sources with what n images say; of each part the best one is used.

    `by_camera` is the motion of the car between images, lane widths, lane widths, rad, (n - 1, 3), NaN where unseen;
    `stds` are its standard deviations.
    """
    units = np.array([lane_width, lane_width, 1.0])
    by_camera, stds = by_camera * units, stds * units
    every = [
        min((_checked(s, seconds, by_camera[:, s.part], stds[:, s.part], d) for d in DELAYS), key=lambda c: c.left)
        for s in sources
    ]
    best: dict[tuple[str, int], Checked] = {}
    used: dict[int, str] = {}
    for checked in sorted(every, key=lambda c: (bool(c.reason), c.left)):
        part, name = checked.source.part, checked.source.name
        if not checked.reason and used.setdefault(part, name) != name:
            checked = replace(checked, reason=f"{used[part]} is closer to the images")
        best.setdefault((checked.source.device, part), checked)
    return list(best.values())


def _checked(source: Source, seconds: Array, by_camera: Array, stds: Array, delay: float) -> Checked:
    steps, dt = source.steps(seconds - delay), np.diff(seconds)
    both = np.isfinite(steps) & np.isfinite(by_camera)
    nothing = np.full(len(steps), np.nan)
    if both.sum() < LEAST_STEPS:
        return Checked(source=source, steps=nothing, reason="it hangs, or has hardly any values while there are images")
    count = max(round(TOGETHER / float(np.median(dt))), 1)

    def together(values: Array) -> Array:
        weights = np.convolve(both, np.ones(count), "same")
        return np.convolve(np.where(both, values, 0.0), np.ones(count), "same") / np.maximum(weights, 1.0)

    turn = source.part == TURN
    x, y, t = (together(values)[both] for values in (steps, by_camera, dt))
    columns = np.stack((x, t) if turn else (x,), axis=1)
    start, unit = np.linalg.lstsq(columns, y, rcond=None)[0], 0.2 * max(float(y.std()), 1e-6)
    fit = least_squares(lambda p: (columns @ p - y) / unit, start, loss="cauchy")
    scale = float(fit.x[0])
    if turn:  # a gyroscope's own scale is better known than that of images
        bias = float(np.median((y - x) / t))
        steps = steps + bias * dt
    else:
        bias, steps = 0.0, steps * scale
    error = by_camera - steps
    off = together(error)
    agree = np.abs(off) <= CONTRADICTS * max(_deviation(off[both]), 1e-9)
    deviation = float(np.sqrt(np.mean(off[both & agree] ** 2)))
    left = deviation / max(float(y[agree[both]].std()), 1e-9)
    if not turn and deviation < EVEN * float(np.median(np.abs(y))) and abs(scale - 1.0) < SURPRISE:
        left = min(left, MOST_LEFT)
    residual = _deviation(error[both & agree])
    # What images leave of it, but at least half: they may be worse than they say.
    std = math.sqrt(max(residual**2 - float(np.median(stds[both])) ** 2, 0.25 * residual**2))
    reason = ""
    if scale <= 0.0:
        reason = f"it {'turns' if turn else 'drives'} the other way than the images: turn it around, or negate it"
    elif turn and not TURN_SCALE[0] < scale < TURN_SCALE[1]:
        reason = f"the images turn {multiple(scale)} as much: another axis or unit"
    elif (
        not turn and not left <= MOST_LEFT and len(close := _close(steps / scale, by_camera)) > LEAST_CLOSE * both.sum()
    ):
        # Images that lose the floor show too short a way, so most of them may be wrong where the encoder is right.
        steps = steps / scale * (scale := float(np.median(close)))
        agree, std = np.full(len(steps), True), float(np.std(close)) * float(np.median(np.abs(y)))
    elif not left <= MOST_LEFT:
        reason = f"it leaves {left:.0%} of what varies in the images unexplained"
    elif agree[both].mean() < LEAST_AGREEING:
        reason = f"it contradicts the images for {1.0 - agree[both].mean():.0%} of the time"
    return Checked(source=source, scale=scale, bias=bias, delay=float(delay), residual=residual, std=std,
                   left=left, steps=np.where(agree, steps, np.nan), reason=reason)  # fmt: skip


def _close(steps: Array, by_camera: Array) -> Array:
    """Ways in images over those of an encoder in metres, around the most frequent of these ratios."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.sort((by_camera / steps)[np.abs(by_camera / steps - 1.0) < SURPRISE + CLOSE])
    if not len(ratios):
        return ratios
    within = np.searchsorted(ratios, ratios + CLOSE) - np.searchsorted(ratios, ratios - CLOSE)
    middle = float(np.median(ratios[within == within.max()]))
    return ratios[np.abs(ratios - middle) < CLOSE] if abs(middle - 1.0) < SURPRISE else ratios[:0]


def _deviation(errors: Array) -> float:
    """Robust standard deviation from zero."""
    return 1.4826 * float(np.median(np.abs(errors)))


def hints_of(sources: Sequence[Checked], frames: int, lane_width: float) -> list[Hint]:
    """What the used sources say about the motion to each image, in the images' scale."""
    step, std = np.zeros((frames, 3)), np.full((frames, 3), np.inf)
    for checked in (c for c in sources if not c.reason):
        unit, part = (1.0 if checked.source.part == TURN else lane_width), checked.source.part
        finite = np.isfinite(checked.steps)
        step[1:, part] = np.where(finite, checked.steps, 0.0) / unit
        std[1:, part] = np.where(finite, checked.std / unit, np.inf)
    return [Hint(*pair) if np.isfinite(pair[1]).any() else NOTHING for pair in zip(step, std, strict=True)]


def stretch(sources: Sequence[Checked]) -> float:
    """Factor on the ways in images, from an encoder's metre and theirs by inverse variance.

    1 if none is used, or if they differ by more than is no surprise: then the encoder is not calibrated.
    """
    scales = [c.scale for c in sources if not c.reason and c.source.part == AHEAD]
    if not scales or abs(scales[0] - 1.0) > SURPRISE:
        return 1.0
    share = IMAGE_STD**2 / (SCALE_STD**2 + IMAGE_STD**2)
    return (share + (1.0 - share) * scales[0]) / scales[0]


def summary(about: dict[str, Any]) -> str:
    """One line about the sources in a `recording.json`."""
    said = []
    for source in about["odometry"]:
        scale, bias = source["scale"], math.degrees(source["bias_radps"] or 0.0)
        if not source["used"]:
            said.append(f"{source['source']} not used for {source['gives']}: {source['reason']}")
        elif source["gives"] == "turns":
            said.append(f"turns of {source['source']}, corrected by {bias:+.2g} degrees/s")
        else:
            said.append(f"ways of {source['source']}, {scale:.3g} of which images show")
    return "; ".join(said) or "images alone"
