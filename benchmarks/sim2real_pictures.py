# SPDX-License-Identifier: Apache-2.0
"""One road place on each simulator, plain and pseudo-real, beside real photographs, for `docs/sim2real.md`.

    python -m benchmarks.sim2real_pictures --set SET --real TUB --out docs/images/sim2real.jpg

Columns: simulators, then photographs with the lane where translations have it, cropped as for the first generator.
Rows: camera images, translations.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from benchmarks.conditions import picture
from numpy.typing import NDArray

from ds_driver.sim2real.generator import prepare
from ds_driver.sim2real.image_translation import ImageTranslation, open_set
from ds_driver.sim2real.lane_pairs import lane_shapes
from ds_driver.sim2real.pictures import read_photographs, split
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.conditions.model import Conditions
from ds_sim.registry import SIMULATORS, make_simulator
from ds_sim.road_simulator import RoadSimulator

GAP = 4
"""White pixels between pictures."""
APART = 100
"""Photographs between the two that are shown, so that they do not show the same moment."""


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
    parser.add_argument(
        "--real", type=Path, required=True, help="photographs: shows the two held-out ones that fit best"
    )
    parser.add_argument("--out", type=Path, required=True, help="JPEG file")
    arguments = parser.parse_args()
    generators = open_set(arguments.set)
    stage = ImageTranslation(generators)
    columns, translated = [], []
    for name in (name for name in SIMULATORS if name in generators):
        simulator = make_simulator(name)
        assert isinstance(simulator, RoadSimulator)
        image = picture(simulator, Conditions())
        columns.append(column([image, stage.translate(image, simulator.spec.name)], name))
        simulator.close()
        translated.append(columns[-1][IMAGE_HEIGHT + GAP : 2 * IMAGE_HEIGHT + GAP])
    window = generators.generator(next(iter(generators.files))).real_window
    held_out = split(read_photographs(arguments.real))[1]
    photographs = np.stack([prepare(image, window, (IMAGE_HEIGHT, IMAGE_WIDTH)) for image in held_out])
    lanes = lane_shapes(np.concatenate((np.stack(translated), photographs)))
    wanted, found = np.nanmean(lanes[: len(translated)], axis=0), lanes[len(translated) :]
    distances = np.nan_to_num(np.abs(found - wanted).max(axis=1), nan=np.inf)
    best = np.argsort(distances)
    other = next(i for i in best if abs(i - best[0]) > APART)
    columns.append(column([photographs[best[0]], photographs[other]], "photographs"))
    gap = np.full((columns[0].shape[0], GAP, 3), 255, np.uint8)
    page = np.hstack([part for each in columns for part in (each, gap)][:-1])
    cv2.imwrite(str(arguments.out), page[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
