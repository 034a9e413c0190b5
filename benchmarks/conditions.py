# SPDX-License-Identifier: Apache-2.0
"""Pictures of operating conditions on each simulator, for `docs/conditions.md`, and what conditions cost.

    python -m benchmarks.conditions --out docs/images [--sim bullet ...]
    python -m benchmarks.conditions --out docs/images --set indoor_track [--sim donkey ...]
    python -m benchmarks.conditions --costs [--frames 40] [--sim bullet ...]

`conditions.jpg`: a row for each condition, the unchanged image first, and a column for each simulator. With `--set`
`conditions_<sim>_translated.jpg`: what the simulator's generator makes of some of them, next to the camera's image.
Costs are processor time, for loading a road and for drawing a frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from benchmarks.camera import draw_sheet, standing
from numpy.typing import NDArray

from ds_driver.sim2real.image_translation import ImageTranslation, open_set
from ds_road import Road, generate
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import STANDARD, make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import VehicleState

CONDITIONS = (
    "",
    "line_contrast=0.3",
    "line_cover=0.5",
    "visibility=60",
    "low_sun=20000,sun_azimuth=80deg,sun_elevation=10deg",
    "shadow_density=0.5,shadow_depth=0.9",
    "camera_pitch=6deg",
)
TRANSLATED = ("", "line_contrast=0.1", "repair_share=0.6", "visibility=30", "veiling_luminance=2500")
COSTLY = (*CONDITIONS, "repair_share=0.3", "veiling_luminance=800", "lens_dirt=0.2", "sensor_noise=15", "exposure=2")
ROAD = Road([(125.0, 0.0), (125.0, 25.0), (125.0, 50.0), (130.0, 75.0), (145.0, 95.0), (170.0, 105.0), (195.0, 110.0)])
"""A straight with a bend to the right."""
SEED = 7


def picture(simulator: RoadSimulator, conditions: Conditions) -> NDArray[np.uint8]:
    """Image from the lane, 8 m after its start."""
    simulator.load(ROAD, seed=SEED, conditions=conditions)
    lane = ROAD.lane_centre
    index = int(np.searchsorted(np.cumsum(np.hypot(*np.diff(lane, axis=0).T)), 8.0))
    return simulator.scene.still(standing(lane, index), np.random.default_rng(SEED))


def pictures(name: str, conditions: Sequence[str]) -> list[NDArray[np.uint8]]:
    """Images of a simulator under each condition."""
    simulator = make_simulator(name)
    assert isinstance(simulator, RoadSimulator)
    try:
        return [picture(simulator, parse_conditions(text)) for text in conditions]
    finally:
        simulator.close()


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
        for text in COSTLY:
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
    arguments.out.mkdir(parents=True, exist_ok=True)
    sheets = {}
    if arguments.set:
        stage = ImageTranslation(open_set(arguments.set))
        for name in arguments.sim:
            images = zip(TRANSLATED, pictures(name, TRANSLATED), strict=True)
            pairs = {condition: [image, stage.translate(image, name)] for condition, image in images}
            sheets[f"conditions_{name}_translated.jpg"] = draw_sheet(pairs, (f"{name}: camera", "translated"))
    else:
        columns = {name: pictures(name, CONDITIONS) for name in arguments.sim}
        sheets["conditions.jpg"] = draw_sheet(columns, CONDITIONS)
    for file, image in sheets.items():
        cv2.imwrite(str(arguments.out / file), image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
