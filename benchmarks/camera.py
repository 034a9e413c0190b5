# SPDX-License-Identifier: Apache-2.0
"""Times cameras, draws what they see, and compares the twin's images with photographs.

`python -m benchmarks.camera painted` times the painting camera of each simulator that has one at 320 x 160 and
640 x 480; `photographs FOLDER` compares the twin with the JPEG images in FOLDER; `panda` prints what loading a road and
an image take in processor time, next to the camera of `bullet` in the same seconds; `views [--out docs/images]` writes
`cameras.jpg`, the view of each simulator.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ds_base.figures import WIDTH, draw_figure
from ds_road import Road, generate
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.renderer import Camera
from ds_sim.camera.sensor import Sensor
from ds_sim.conditions.model import Conditions
from ds_sim.registry import STANDARD, make_simulator, spec_of
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import VehicleState
from ds_sim_panda.scene.panda_scene import PandaScene

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(9)])
RNG = np.random.default_rng(0)
LOADS = 10


def poses(seed: int) -> list[VehicleState]:
    """Poses along the lane of a random road at 6 m/s, slightly rolled and pitched."""
    lane = generate(np.random.default_rng(seed), max_angle=60).lane_centre
    headings = np.unwrap(np.arctan2(*np.diff(lane, axis=0).T[::-1]))
    rates = np.gradient(headings) / np.hypot(*np.diff(lane, axis=0).T) * 6.0
    return [
        VehicleState(x=x, y=y, yaw=yaw, speed=6.0, yaw_rate=rate, steering_angle=0.0, roll=0.01, pitch=0.004)
        for (x, y), yaw, rate in zip(lane[:-1], headings, rates, strict=True)
    ]


def median_ms(call: Callable[[VehicleState], object], states: list[VehicleState]) -> float:
    """Median processor time of a call over some poses, ms."""
    times = []
    for state in states:
        started = time.process_time()
        call(state)
        times.append(1e3 * (time.process_time() - started))
    return float(np.median(times))


def image_statistics(image: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Brightness, contrast and sharpness of an RGB image.

    They are mean and standard deviation of its luma (ITU-R BT.601), grey levels, and the standard deviation of the
    luma's Laplacian over the contrast.
    """
    luma = image.astype(np.float64) @ (0.299, 0.587, 0.114)
    edges = cv2.Laplacian(luma, cv2.CV_64F)[1:-1, 1:-1]
    return float(luma.mean()), float(luma.std()), float(edges.std() / luma.std())


def compare(folder: Path) -> None:
    """Compare percentiles 5, 50, 95 of photographs (central 2:1 part) and of images of the twin at their size."""
    files = sorted(p for p in folder.rglob("*.jpg") if not p.name.startswith("._"))
    if not files:
        sys.exit(f"{folder}: contains no .jpg files: name a folder of photographs, such as the images of a tub")
    photographs, size = [], (0, 0)
    for file in files[::5]:
        image = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        rows = image.shape[1] // 2
        top = (image.shape[0] - rows) // 2
        size = (image.shape[1], rows)
        photographs.append(image_statistics(np.asarray(image[top : top + rows], np.uint8)))
    spec = spec_of("donkey")
    frames = []
    for seed in range(4):
        ground = paint_ground(generate(np.random.default_rng(seed), max_angle=60), spec.look)
        camera, sensor = Camera(spec.camera, spec.look), Sensor(spec.camera, np.random.default_rng(seed))
        for state in poses(seed)[::4]:
            frame = sensor.deliver(camera.render(ground, replace(state, roll=0.0, pitch=0.0)))
            resized = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
            frames.append(image_statistics(np.asarray(resized, np.uint8)))
    for index, name in enumerate(("brightness", "contrast", "sharpness")):
        shares = (np.percentile([one[index] for one in images], (5, 50, 95)) for images in (photographs, frames))
        print(f"{name:<11} photographs, twin: {'  '.join('/'.join(f'{v:.2f}' for v in values) for values in shares)}")


def painted() -> None:
    """Time the painting cameras."""
    road, states = generate(np.random.default_rng(4), max_angle=60), poses(4) * 2
    for name in (name for name in STANDARD if name != "panda"):
        spec = spec_of(name)
        ground = paint_ground(road, spec.look)
        for width, height in ((320, 160), (640, 480)):
            camera = Camera(replace(spec.camera, width=width, height_px=height), spec.look)
            camera.render(ground, states[0])
            milliseconds = median_ms(partial(camera.render, ground), states)
            print(f"{name:<9} {width} x {height}: {1e3 / milliseconds:5.0f} frames/s")


def loaded(road: Road, spec: Any) -> PandaScene:
    """Scene of a road, ready to draw."""
    scene = PandaScene(spec)
    scene.load(road, RNG)
    return scene


def standing(lane: NDArray[np.float64], index: int, roll: float = 0.0) -> VehicleState:
    """A vehicle that stands on a point of a lane, along it."""
    (x, y), ahead = lane[index].tolist(), lane[index + 1] - lane[index]
    yaw = math.atan2(ahead[1], ahead[0])
    return VehicleState(x=x, y=y, yaw=yaw, roll=roll, speed=0.0, yaw_rate=0.0, steering_angle=0.0)


def draw_sheet(columns: Mapping[str, Sequence[NDArray[np.uint8]]], rows: Sequence[str]) -> NDArray[np.uint8]:
    """Draw titled columns of pictures, with the name of each row above it."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(rows), len(columns), squeeze=False)
        for column, (title, images) in enumerate(columns.items()):
            for row, (image, name) in enumerate(zip(images, rows, strict=True)):
                axes = panels[row, column]
                axes.imshow(image)
                axes.set_axis_off()
                if row == 0:
                    axes.set_title(title or "unchanged", fontsize="medium", fontweight="bold", pad=20)
                if column == 0:
                    label = axes.text(0, -8, name.replace(",", ", ") or "unchanged", fontsize="small")
                    label.set_in_layout(False)

    height = 50 + len(rows) * (22 + WIDTH * 160 // (320 * len(columns)))
    return draw_figure(WIDTH, height, draw)


def views() -> NDArray[np.uint8]:
    """Draw what each simulator's camera sees of a straight road, of a bend, and with the car rolled by 0.08 rad."""
    bend = generate(np.random.default_rng(21), max_angle=270)
    places = {
        "straight": (STRAIGHT, 0.3, 0.0),
        "bend": (bend, 0.3, 0.0),
        "the same, rolled by 0.08 rad": (bend, 0.3, 0.08),
    }
    columns: dict[str, list[NDArray[np.uint8]]] = {}
    for name in STANDARD:
        simulator = make_simulator(name)
        assert isinstance(simulator, RoadSimulator)
        for road, share, roll in places.values():
            simulator.load(road, seed=0, conditions=Conditions())
            state = standing(road.right_lane_centre, int(share * len(road.right_lane_centre)), roll)
            columns.setdefault(name, []).append(simulator.scene.still(state, np.random.default_rng(0)))
        simulator.close()
    return draw_sheet(columns, list(places))


def speed() -> None:
    """Print median processor times, beside the camera of bullet."""
    road, states, bullet = generate(np.random.default_rng(4), max_angle=60), poses(4), spec_of("bullet")
    scene, ground = loaded(road, spec_of("panda").camera), paint_ground(road, bullet.look)
    part = loaded(road, spec_of("panda").camera)
    part.draw_rows(spec_of("panda").crop_top, 160)
    part.load(road, RNG)
    large = loaded(road, replace(spec_of("panda").camera, width=640, height_px=480))
    camera = Camera(bullet.camera, bullet.look)
    calls: dict[str, Callable[[VehicleState], object]] = {
        "bullet, 320 x 160": lambda state: camera.render(ground, state),
        "panda, 320 x 160": scene.image,
        "panda, rows that a network sees": part.image,
        "panda, 640 x 480": large.image,
    }
    for name, call in calls.items():
        call(states[0])
        print(f"{name:<34} {median_ms(call, states):6.2f} ms")

    def load(state: VehicleState) -> None:
        part.load(road, RNG)
        part.image(state)

    print(f"panda, load with its first image   {median_ms(load, states[:LOADS]):6.2f} ms")


def main() -> None:
    """Measure what the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("painted", "photographs", "panda", "views"))
    parser.add_argument("folder", type=Path, nargs="?", help="with photographs")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.what == "painted":
        painted()
    elif arguments.what == "panda":
        speed()
    elif arguments.what == "views":
        image = views()[:, :, ::-1]
        cv2.imwrite(str(arguments.out / "cameras.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    elif arguments.folder is None:
        parser.error("photographs: name a folder of photographs, such as the images of a tub")
    else:
        compare(arguments.folder)


if __name__ == "__main__":
    main()
