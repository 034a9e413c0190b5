# SPDX-License-Identifier: Apache-2.0
"""Pictures of each operating condition at three strengths on each simulator, for `docs/conditions.md`, and their cost.

    python -m benchmarks.conditions --out docs/images [--sim bullet ...]
    python -m benchmarks.conditions --costs [--frames 40] [--sim bullet ...]

One sheet per simulator: a row per condition, its strengths from left to right. With `--set SET` only the middle and the
greatest strength, each beside what the simulator's sim2real generator makes of it: `conditions_<sim>_translated.jpg`.
Costs are processor time, for loading a road and for drawing a frame.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from benchmarks.camera import standing
from numpy.typing import NDArray

from ds_driver.sim2real.image_translation import ImageTranslation, open_set
from ds_road import Road, generate
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import STANDARD, make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import VehicleState

STRENGTHS = (
    ("line_contrast=0.6", "line_contrast=0.3", "line_contrast=0.1"),
    ("line_cover=0.2", "line_cover=0.4", "line_cover=0.7"),
    ("pavement_reflectance=0.05", "pavement_reflectance=0.2", "pavement_reflectance=0.4"),
    ("repair_share=0.1", "repair_share=0.3", "repair_share=0.6"),
    ("shadow_density=0.2,shadow_depth=0.6", "shadow_density=0.5", "shadow_density=0.5,shadow_depth=0.9"),
    ("visibility=300", "visibility=80", "visibility=30"),
    ("illuminance=1000", "illuminance=200", "illuminance=30"),
    ("veiling_luminance=200", "veiling_luminance=800", "veiling_luminance=2500"),
    (
        "low_sun=1000,sun_azimuth=80deg,sun_elevation=10deg",
        "low_sun=5000,sun_azimuth=80deg,sun_elevation=10deg",
        "low_sun=20000,sun_azimuth=80deg,sun_elevation=10deg",
    ),
    ("lens_dirt=0.05", "lens_dirt=0.2", "lens_dirt=0.4"),
    ("sensor_noise=5", "sensor_noise=15", "sensor_noise=35"),
    ("exposure=0.4", "exposure=2", "exposure=5"),
    ("camera_height=0.7", "camera_height=1.3", "camera_height=1.8"),
    ("camera_pitch=-3deg", "camera_pitch=3deg", "camera_pitch=6deg"),
    ("camera_yaw=-6deg", "camera_yaw=3deg", "camera_yaw=8deg"),
)
ROAD = Road([(125.0, 0.0), (125.0, 25.0), (125.0, 50.0), (130.0, 75.0), (145.0, 95.0), (170.0, 105.0), (195.0, 110.0)])
"""A straight with a bend to the right."""
SEED = 7


def picture(simulator: RoadSimulator, conditions: Conditions) -> NDArray[np.uint8]:
    """Image from the lane, 8 m after its start."""
    simulator.load(ROAD, seed=SEED, conditions=conditions)
    lane = ROAD.lane_centre
    index = int(np.searchsorted(np.cumsum(np.hypot(*np.diff(lane, axis=0).T)), 8.0))
    return simulator.scene.still(standing(lane, index), np.random.default_rng(SEED))


def sheet(name: str, stage: ImageTranslation | None = None) -> NDArray[np.uint8]:
    """Rows of pictures with their conditions below; with a stage each has its translation beside it."""
    simulator = make_simulator(name)
    assert isinstance(simulator, RoadSimulator)
    rows = []
    for texts in STRENGTHS:
        if texts[0].partition("=")[0] not in simulator.spec.conditions:
            continue
        row = []
        for text in texts if stage is None else texts[1:]:
            image = picture(simulator, parse_conditions(text))
            if stage is not None:
                image = np.hstack((image, stage.translate(image, simulator.spec.name)))
            label = np.full((18, image.shape[1], 3), 255, np.uint8)
            cv2.putText(label, text[:52], (3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
            row.append(np.vstack((image, label)))
        rows.append(np.hstack(row))
    simulator.close()
    return np.vstack(rows)


def print_costs(names: list[str], frames: int) -> None:
    """Print one line per simulator and condition, at its middle strength."""
    road = generate(np.random.default_rng(1), max_angle=120)
    states = [
        VehicleState(x=float(x), y=float(y), yaw=1.57, speed=5.0, yaw_rate=0.0, steering_angle=0.0)
        for x, y in road.lane_centre[:frames]
    ]
    for name in names:
        simulator = make_simulator(name)
        assert isinstance(simulator, RoadSimulator)
        for text in ("", *(texts[1] for texts in STRENGTHS)):
            conditions = parse_conditions(text)
            simulator.scene.load(road, np.random.default_rng(1), conditions)
            simulator.scene.image(states[0])
            begun = time.process_time()
            simulator.scene.load(road, np.random.default_rng(1), conditions)
            loaded = time.process_time()
            for state in states:
                simulator.scene.image(state)
            load, frame = loaded - begun, (time.process_time() - loaded) / len(states)
            print(f"{name:9} load {1e3 * load:6.0f} ms  frame {1e3 * frame:5.2f} ms  {text or 'default'}", flush=True)


def main() -> None:
    """Draw the sheets, or print the costs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    wanted = parser.add_mutually_exclusive_group(required=True)
    wanted.add_argument("--out", type=Path, help="folder for the pictures")
    wanted.add_argument("--costs", action="store_true", help="print what conditions cost instead")
    parser.add_argument("--frames", type=int, default=40, help="frames to time")
    parser.add_argument("--sim", nargs="*", default=list(STANDARD), help="simulators")
    parser.add_argument("--set", help="shipped set of sim2real generators, or a folder")
    arguments = parser.parse_args()
    if arguments.costs:
        return print_costs(arguments.sim, arguments.frames)
    stage = ImageTranslation(open_set(arguments.set)) if arguments.set else None
    suffix = "" if stage is None else "_translated"
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.sim:
        image = sheet(name, stage)
        file = arguments.out / f"conditions_{name}{suffix}.jpg"
        cv2.imwrite(str(file), image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 70])


if __name__ == "__main__":
    main()
