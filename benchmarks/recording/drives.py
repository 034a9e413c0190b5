# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings with known truth: cars of this project, jerky steering, a tub of 160 x 120 JPEGs.

The tub holds images, commands and times alone; `truth.csv` lies beside it, and is never read by `ds recording locate`.
Settings were fixed before results were looked at.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ds_driver.control.autopilot import throttle
from ds_recording.floor_camera import FloorCamera, Lens, write_camera
from ds_road import LANE_WIDTH, Road
from ds_road.generation import generate
from ds_sim.camera.rendered_scene import PaintedScene
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import Conditions
from ds_sim.parts import Scene, Vehicle
from ds_sim.registry import spec_of
from ds_sim.simulator import FRAME_TIME, Command, SimulatorSpec, VehicleState
from ds_twin_donkey.parameters import DonkeyParameters

Array = NDArray[np.float64]
WIDTH, HEIGHT = 160, 120
"""Size of a Donkey Car's images, px."""
COVER, COVER_LENGTH = 0.4, 2.0
"""Share of every line without paint, and length of a bare piece, m."""
DROPPED, BLURRED, JITTER = 0.03, 0.05, 0.003
"""Share of dropped and of blurred frames, and standard deviation of the recorded times, s."""
BLUR = 1.5
"""Standard deviation of the blur, px."""
MOSTLY_BLURRED = 0.5, 5.0
"""Both where images mostly lose the floor."""
ENCODER_SCALE, ENCODER_NOISE = 0.02, 0.03
"""Standard deviation of an encoder's scale from car to car, and of its single values, as shares of the speed."""
SLIP, SLIP_SHARE, SLIP_FRAMES = 0.3, 0.05, 10
"""How much faster a slipping wheel turns, share of the time that it slips, and length of a slip, frames."""
GYRO_SCALE, GYRO_BIAS, GYRO_NOISE = 0.01, 2.0, 0.5
"""Standard deviation of a gyroscope's scale, of its bias and of its single values, degrees/s."""
SPEED = 20.0
"""Speed threshold of the throttle's law, km/h."""
LOOP = 0.9 * np.array([
    *((x, 0) for x in range(-14, 58, 4)), (80, 8), (88, 30), (70, 44), (50, 38), (30, 46), (10, 58), (-20, 54),
    (-40, 30), (-34, 6),
], float)  # fmt: skip
"""Corners of the closed track, m; it begins with a straight, along which the painted road ends."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One recording: simulator, seed, `loop` or `open` road, frames at most, what is wrong, sensors, `donkey`'s car.

    Sensors are `good`, or `bad`: the encoder reads a fifth too much, and the gyroscope is upside down.
    """

    simulator: str
    seed: int
    course: str = "open"
    frames: int = 1500
    fault: str = ""
    sensors: str = ""
    car: DonkeyParameters | None = None


def line_distance(spec: SimulatorSpec) -> float:
    """Distance from the middle of the centre line to the middle of an edge line, m: what a person would measure."""
    return LANE_WIDTH - spec.look.line_width / 2


def camera_of(spec: SimulatorSpec) -> CameraSpec:
    """The simulator's camera with the size of a Donkey Car's images."""
    return replace(spec.camera, width=WIDTH, height_px=HEIGHT)


def polynomial(camera: CameraSpec) -> list[float]:
    """OpenCV's k1, k2, p1, p2, k3 closest to the camera's lens in its image, by linear least squares."""
    if camera.lens == "pinhole":
        return [0.0] * 5
    angles = np.linspace(0.01, math.radians(66.0), 200)
    radius = np.tan(angles)
    powers = np.stack([radius**3, radius**5, radius**7], axis=1)
    k1, k2, k3 = np.linalg.lstsq(powers, angles - radius, rcond=None)[0].tolist()
    return [k1, k2, 0.0, 0.0, k3]


def floor_camera(camera: CameraSpec) -> FloorCamera:
    """The true camera as `ds recording locate --camera` reads it."""
    k = camera.intrinsics
    return FloorCamera(
        width_px=camera.width,
        height_px=camera.height_px,
        focal_px=(float(k[0, 0]), float(k[1, 1])),
        centre_x_px=float(k[0, 2]),
        centre_y_px=float(k[1, 2]),
        height_m=camera.height,
        pitch_rad=camera.pitch,
        forward_m=camera.forward,
        lens=Lens(coefficients=tuple(polynomial(camera))),
    )


Row = tuple[float, NDArray[np.uint8], Command, dict[str, float]]
"""Time, s, RGB image, command and sensor values of one frame of a tub."""


def write_tub(folder: Path, rows: Iterable[Row]) -> None:
    """Write a tub of JPEGs as Donkey Car 5 does."""
    (folder / "images").mkdir(parents=True)
    records: list[dict[str, object]] = []
    for index, (time, image, command, sensors) in enumerate(rows):
        name = f"{index}_cam_image_array_.jpg"
        cv2.imwrite(str(folder / "images" / name), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
        angles = {"user/angle": command.steering, "user/throttle": command.throttle, "user/mode": "user"}
        records.append(
            {"_index": index, "_timestamp_ms": round(1000 * time), "cam/image_array": name, **angles, **sensors}
        )
    paths = json.dumps({"paths": ["catalog_0.catalog"], "deleted_indexes": []})
    (folder / "manifest.json").write_text("\n".join(["[]", "[]", "{}", "{}", paths]))
    (folder / "catalog_0.catalog").write_text("\n".join(map(json.dumps, records)))


def parts_of(plan: Plan) -> tuple[SimulatorSpec, Vehicle, Scene]:
    """Car and world of a simulator, with the smaller camera."""
    spec = spec_of(plan.simulator)
    vehicle: Vehicle
    scene: Scene
    if plan.simulator == "donkey":
        from ds_twin_donkey.simulator import DonkeyVehicle

        vehicle = DonkeyVehicle(plan.car)
        scene = PaintedScene(camera_of(spec), spec.look)
    else:
        from ds_sim_panda.simulator import MultiBodyVehicle, PandaScene
        from ds_sim_panda.vehicle.parameters import MultiBodyParameters

        vehicle, scene = MultiBodyVehicle(MultiBodyParameters()), PandaScene(camera_of(spec))
    return spec, vehicle, scene


def course_of(plan: Plan) -> tuple[Road, Array, bool]:
    """Road to paint, its centre line (n, 2), and whether it is closed."""
    if plan.course == "open":
        road = generate(np.random.default_rng(plan.seed), max_angle=120)
        return road, np.asarray(road.points), False
    corners = np.vstack((LOOP, LOOP[:1]))
    chords = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    spline = CubicSpline(chords, corners, bc_type="periodic")
    line = np.asarray(spline((np.linspace(0.0, chords[-1], 401)[:-1] + 12.0) % chords[-1]))
    return Road.from_road_points(line), line, True


class Course:
    """Nearest point of a centre line, by brute force.

    Args:
        line: (n, 2) points, m.
        closed: whether the last joins the first.
    """

    def __init__(self, line: Array, closed: bool) -> None:
        points = np.vstack((line, line[:1])) if closed else line
        arcs = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        spline = CubicSpline(arcs, points, bc_type="periodic" if closed else "not-a-knot")
        self.length = float(arcs[-1])
        self.stations = np.arange(0.0, self.length, 0.02)
        self.points = np.asarray(spline(self.stations))
        ahead = np.asarray(spline(self.stations, 1))
        self.headings = np.arctan2(ahead[:, 1], ahead[:, 0])

    def place(self, x: float, y: float) -> tuple[float, float, float]:
        """Offset to the right of the line, station, and the line's heading at the nearest point."""
        to = np.array([x, y]) - self.points
        index = int(np.argmin((to**2).sum(axis=1)))
        heading = float(self.headings[index])
        offset = float(to[index, 0] * math.sin(heading) - to[index, 1] * math.cos(heading))
        return offset, float(self.stations[index]), heading


def sensors_of(states: list[VehicleState], bad: bool, rng: np.random.Generator) -> tuple[Array, Array]:
    """What a Donkey Car's encoder (m/s) and MPU-6050 (degrees/s) say of a drive."""
    count = len(states)
    speed = np.array([state.speed for state in states]) * (1.0 + ENCODER_SCALE * rng.normal())
    slips = np.repeat(rng.uniform(size=count // SLIP_FRAMES + 1) < SLIP_SHARE, SLIP_FRAMES)[:count]
    speed = speed * (1.0 + SLIP * slips) * (1.0 + ENCODER_NOISE * rng.normal(size=count))
    rate = np.degrees([state.yaw_rate for state in states]) * (1.0 + GYRO_SCALE * rng.normal())
    rate = rate + GYRO_BIAS * rng.normal() + GYRO_NOISE * rng.normal(size=count)
    return (1.2 * speed, -rate) if bad else (speed, rate)


def record(plan: Plan, folder: Path) -> None:
    """Drive, and write `folder/tub`, `folder/camera.yaml`, `folder/truth.csv` and `folder/track.csv`."""
    spec, vehicle, scene = parts_of(plan)
    road, line, closed = course_of(plan)
    course = Course(line, closed)
    seeds = np.random.SeedSequence(plan.seed).spawn(5)
    rng, spoiled, world, physics, sensed = (np.random.default_rng(seed) for seed in seeds)
    conditions = Conditions(line_cover=1.0 if plan.fault == "no lines" else COVER, line_cover_length=COVER_LENGTH)
    scene.load(road, world, conditions)
    heading, right = float(course.headings[0]), LANE_WIDTH / 2
    x, y = course.points[0] + right * np.array([math.sin(heading), -math.cos(heading)])
    vehicle.reset(float(x), float(y), heading, physics)
    aim, hold, steering = 0.0, 0, 0.0
    images, states, commands = [], [vehicle.state()], []
    for _ in range(plan.frames):
        state = states[-1]
        images.append(scene.image(state).copy())
        ahead = spec.preview_distance
        preview, station, _ = course.place(state.x + ahead * math.cos(state.yaw), state.y + ahead * math.sin(state.yaw))
        if not closed and station > course.length - 12.0:
            break
        gains = spec.autopilot
        # Thumb stick: the aim wanders across the lane, values are held for some frames, and often exactly zero.
        aim += -0.03 * aim + 0.12 * rng.normal()
        if hold <= 0:
            hold = int(rng.integers(2, 6))
            wanted = -gains.proportional * (preview - right + aim) + 0.12 * rng.normal()
            steering = 0.0 if abs(wanted) < 0.08 else float(np.clip(wanted, -1.0, 1.0))
        hold -= 1
        command = Command(steering, throttle(steering, state.speed, max_speed=SPEED, min_speed=SPEED / 2))
        commands.append(command)
        vehicle.advance(command)
        states.append(vehicle.state())
    vehicle.close()
    scene.close()
    count = len(commands)
    kept = spoiled.uniform(size=count) >= DROPPED
    share, blur = MOSTLY_BLURRED if plan.fault == "blurred" else (BLURRED, BLUR)
    blurred = np.repeat(spoiled.uniform(size=count // 5 + 1) < share, 5)[:count]
    times = 1000.0 + FRAME_TIME * np.arange(count) + JITTER * spoiled.normal(size=count).clip(-3, 3)
    speeds, turning = sensors_of(states[:count], plan.sensors == "bad", sensed)
    order = np.arange(count)
    if plan.fault == "shuffled":
        spoiled.shuffle(order)
    if plan.fault == "static":
        order[:] = count // 2
    rows: list[Row] = []
    truth = []
    for index in np.flatnonzero(kept).tolist():
        image = images[order[index]]
        if blurred[index]:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.uint8)
        read = {"enc/speed": float(speeds[index]), "imu/gyr_z": float(turning[index])} if plan.sensors else {}
        rows.append((float(times[index]), image, commands[index], read))
        state = states[max(index - spec.camera.latency, 0)]  # what the image shows
        offset, along, heading = course.place(state.x, state.y)
        turned = (state.yaw - heading + math.pi) % (2 * math.pi) - math.pi
        truth.append((len(rows) - 1, state.x, state.y, state.yaw, along, offset, turned, state.speed, state.yaw_rate))
    write_tub(folder / "tub", rows)
    header = "frame,x_m,y_m,yaw_rad,along_m,lateral_m,heading_rad,speed_mps,yaw_rate_radps"
    for name, head, values in (("truth", header, truth), ("track", "x_m,y_m", course.points[::10].tolist())):
        with (folder / f"{name}.csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([head.split(","), *values])
    write_camera(folder / "camera.yaml", floor_camera(camera_of(spec)))
