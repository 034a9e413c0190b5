"""One road place on each simulator, plain and pseudo-real, beside real photographs, for `docs/sim2real.md`.

    python -m benchmarks.sim2real_pictures --set SET --real TUB --out docs/images/sim2real.jpg

Columns: simulators, then photographs, cropped as for the first generator. Rows: camera images, translations.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from benchmarks.condition_pictures import picture
from numpy.typing import NDArray

from ds_driver.sim2real.generator_set import open_set
from ds_driver.sim2real.photographs import read_photographs, split
from ds_driver.sim2real.stage import Sim2RealStage
from ds_driver.sim2real.window import prepare
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.conditions.model import Conditions
from ds_sim.registry import make_simulator
from ds_sim.road_simulator import RoadSimulator

GAP = 4
"""White pixels between pictures."""


def column(images: list[NDArray[np.uint8]], label: str) -> NDArray[np.uint8]:
    """Images below each other, (rows, IMAGE_WIDTH, 3), with a label below them."""
    gap = np.full((GAP, IMAGE_WIDTH, 3), 255, np.uint8)
    text = np.full((24, IMAGE_WIDTH, 3), 255, np.uint8)
    cv2.putText(text, label, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack((images[0], gap, images[1], text))


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", required=True, help="shipped set of generators, or a folder")
    parser.add_argument("--real", type=Path, required=True, help="photographs, of which two held-out ones are shown")
    parser.add_argument("--show", type=int, nargs=2, default=(0, 300), help="which of the held-out photographs")
    parser.add_argument("--out", type=Path, required=True, help="JPEG file")
    arguments = parser.parse_args()
    generators = open_set(arguments.set)
    stage = Sim2RealStage(generators)
    columns = []
    for name in generators.files:
        simulator = make_simulator(name)
        assert isinstance(simulator, RoadSimulator)
        image = picture(simulator, Conditions())
        columns.append(column([image, stage.translate(image, simulator.spec.name)], name))
        simulator.close()
    window = generators.generator(next(iter(generators.files))).real_window
    held_out = split(read_photographs(arguments.real))[1]
    photographs = [prepare(held_out[i], window, (IMAGE_HEIGHT, IMAGE_WIDTH)) for i in arguments.show]
    columns.append(column(photographs, "photographs"))
    gap = np.full((columns[0].shape[0], GAP, 3), 255, np.uint8)
    page = np.hstack([part for each in columns for part in (each, gap)][:-1])
    cv2.imwrite(str(arguments.out), page[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
