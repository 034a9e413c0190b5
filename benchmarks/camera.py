# SPDX-License-Identifier: Apache-2.0
"""Times cameras, draws what they see, and compares the twin's images with photographs.

`python -m benchmarks.camera times` prints the processor time of an image of each simulator; `photographs FOLDER`
compares the twin with the JPEG images in FOLDER; `views [--out docs/images]` writes `cameras.jpg`, the view of each
simulator.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ds_base.figures import WIDTH, draw_figure
from ds_road import Road, generate
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.rendered_scene import Sensor
from ds_sim.camera.renderer import Camera
from ds_sim.conditions.model import DEFAULT
from ds_sim.registry import STANDARD, make_simulator, spec_of
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import VehicleState

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(9)])


def poses(seed: int) -> list[VehicleState]:
    """Poses along the lane of a random road at 6 m/s, slightly rolled and pitched."""
    lane = generate(np.random.default_rng(seed), max_angle=60).lane_centre
    headings = np.unwrap(np.arctan2(*np.diff(lane, axis=0).T[::-1]))
    rates = np.gradient(headings) / np.hypot(*np.diff(lane, axis=0).T) * 6.0
    return [
        VehicleState(x=x, y=y, yaw=yaw, speed=6.0, yaw_rate=rate, steering_angle=0.0, roll=0.01, pitch=0.004)
        for (x, y), yaw, rate in zip(lane[:-1], headings, rates, strict=True)
    ]


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


def times() -> None:
    """Print the median processor time of an image of every simulator, ms."""
    for name in STANDARD:
        simulator = road_simulator(name)
        simulator.load(generate(np.random.default_rng(4), max_angle=60), seed=0, conditions=DEFAULT)
        taken = []
        for state in poses(4):
            started = time.process_time()
            simulator.scene.image(state)
            taken.append(1e3 * (time.process_time() - started))
        simulator.close()
        print(f"{name:<9} {np.median(taken):5.2f} ms")


def road_simulator(name: str) -> RoadSimulator:
    """Make one of the simulators that are shipped."""
    simulator = make_simulator(name)
    assert isinstance(simulator, RoadSimulator)
    return simulator


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
        simulator = road_simulator(name)
        for road, share, roll in places.values():
            simulator.load(road, seed=0, conditions=DEFAULT)
            state = standing(road.right_lane_centre, int(share * len(road.right_lane_centre)), roll)
            columns.setdefault(name, []).append(simulator.scene.still(state, np.random.default_rng(0)))
        simulator.close()
    return draw_sheet(columns, list(places))


def main() -> None:
    """Measure what the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("times", "photographs", "views"))
    parser.add_argument("folder", type=Path, nargs="?", help="with photographs")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.what == "times":
        times()
    elif arguments.what == "views":
        image = views()[:, :, ::-1]
        cv2.imwrite(str(arguments.out / "cameras.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    elif arguments.folder is None:
        parser.error("photographs: name a folder of photographs, such as the images of a tub")
    else:
        compare(arguments.folder)


if __name__ == "__main__":
    main()
