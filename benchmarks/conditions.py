# SPDX-License-Identifier: Apache-2.0
"""Pictures of operating conditions on each simulator, for `docs/conditions.md`.

    python -m benchmarks.conditions --out docs/images [--sim bullet ...]
    python -m benchmarks.conditions --out docs/images --set indoor_track [--sim donkey ...]

`conditions.jpg`: a row for each condition, the unchanged image first, and a column for each simulator. With `--set`
`conditions_<sim>_translated.jpg`: what the simulator's generator makes of some of them, next to the camera's image.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from benchmarks.camera import draw_sheet, road_simulator, standing
from numpy.typing import NDArray

from ds_driver.sim2real.image_translation import open_set
from ds_road import Road
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import STANDARD

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
ROAD = Road([(125.0, 0.0), (125.0, 25.0), (125.0, 50.0), (130.0, 75.0), (145.0, 95.0), (170.0, 105.0), (195.0, 110.0)])
"""A straight with a bend to the right."""
SEED = 7


def pictures(name: str, conditions: Sequence[str]) -> list[NDArray[np.uint8]]:
    """Images of a simulator under each condition, from the lane, 8 m after its start."""
    lane = ROAD.lane_centre
    index = int(np.searchsorted(np.cumsum(np.hypot(*np.diff(lane, axis=0).T)), 8.0))
    simulator = road_simulator(name)
    taken = []
    for text in conditions:
        simulator.load(ROAD, seed=SEED, conditions=parse_conditions(text))
        taken.append(simulator.scene.still(standing(lane, index), np.random.default_rng(SEED)))
    simulator.close()
    return taken


def main() -> None:
    """Draw the sheets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--sim", nargs="*", default=list(STANDARD), help="simulators")
    parser.add_argument("--set", help="shipped set of sim2real generators, or a folder")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    sheets = {}
    if arguments.set:
        stage = open_set(arguments.set)
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
