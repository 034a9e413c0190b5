"""Times the rendering of images, and compares images of the twin with photographs.

`python benchmarks/camera.py` times the painting camera of each simulator that has one at 320 x 160 and 640 x 480,
relative to a plain bilinear `cv2.warpPerspective`; `python benchmarks/camera.py FOLDER` also compares the twin with the
JPEG images in FOLDER.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import generate
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.image_statistics import image_statistics, percentiles
from ds_sim.camera.renderer import Camera, Sensor
from ds_sim.registry import SIMULATORS, spec_of
from ds_sim.simulator import VehicleState


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


def bilinear(raster: NDArray[np.uint8], size: tuple[int, int], _: VehicleState) -> object:
    """Baseline: one perspective warp."""
    plain = np.array([[20.0, -3.0, 1e3], [2.0, 9.0, 1500.0], [0.001, 0.004, 1.0]])
    return cv2.warpPerspective(raster, plain, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def main() -> None:
    """Print both tables."""
    cv2.setNumThreads(1)
    road, states = generate(np.random.default_rng(4), max_angle=60), poses(4) * 2
    for name in (name for name in SIMULATORS if name != "panda"):  # see panda_camera.py
        spec = spec_of(name)
        ground = paint_ground(road, spec.look)
        raster = np.ascontiguousarray(ground.levels[0][:, :, :3])
        for width, height in ((320, 160), (640, 480)):
            camera = Camera(replace(spec.camera, width=width, height_px=height), spec.look)
            camera.render(ground, states[0])
            rendering = median_ms(partial(camera.render, ground), states)
            baseline = median_ms(partial(bilinear, raster, (width, height)), states)
            ratio = rendering / baseline
            print(f"{name:<9} {width} x {height}: {1e3 / rendering:5.0f} frames/s, {ratio:.1f} x plain bilinear")
    if len(sys.argv) > 1:
        compare(Path(sys.argv[1]))


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
        photographs.append(image_statistics(np.ascontiguousarray(image[top : top + rows])))  # type: ignore[arg-type]
    spec = spec_of("donkey")
    frames = []
    for seed in range(4):
        ground = paint_ground(generate(np.random.default_rng(seed), max_angle=60), spec.look)
        camera, sensor = Camera(spec.camera, spec.look), Sensor(spec.camera, np.random.default_rng(seed))
        for state in poses(seed)[::4]:
            frame = sensor.deliver(camera.render(ground, replace(state, roll=0.0, pitch=0.0)))
            frames.append(image_statistics(cv2.resize(frame, size, interpolation=cv2.INTER_AREA)))  # type: ignore[arg-type]
    of_twin, of_photographs = percentiles(frames), percentiles(photographs)
    for name in of_twin:
        row = "  ".join("/".join(f"{v:.2f}" for v in values) for values in (of_photographs[name], of_twin[name]))
        print(f"{name:<15} photographs, twin: {row}")


if __name__ == "__main__":
    main()
