# SPDX-License-Identifier: Apache-2.0
"""Makes the camera images with which `@openvino-int8` is calibrated (`ds_driver.networks.calibration`).

    python -m benchmarks.calibration_frames --out src/ds_driver/ds_driver/models/calibration

The disturbed autopilot of `ds collect` drives two roads both ways on each simulator, from a seed that nothing else
uses; of eight of each simulator's images, evenly spaced, the first seven are kept, below each other in one JPEG. They
are shipped rather than rendered again, so that quantised networks do not change with a camera.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq

from ds_base.atomic_files import write_json
from ds_base.progress import SILENT
from ds_driver.data.collection import CollectionPlan, collect
from ds_driver.data.dataset import decode
from ds_sim.camera.encodings import JPEG_QUALITY
from ds_sim.registry import STANDARD, spec_of

SEED = 5_150_021
"""Seed of the roads and disturbances; used nowhere else."""
SPACED, IMAGES = 8, 7
"""Images of a simulator chosen, and kept: 28 in all take a fraction of a second to calibrate with. With all of them the
wheel would be larger than the 100 MiB that package indexes take."""


def main() -> None:
    """Drive; write one JPEG for each simulator, and the rows that networks do not see of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True)
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    crops = {}
    with tempfile.TemporaryDirectory() as folder:
        collect(CollectionPlan(roads=2, seed=SEED, disturbance=0.5), list(STANDARD), Path(folder), SILENT)
        for simulator in STANDARD:
            files = sorted((Path(folder) / simulator).glob("*.parquet"))
            images = [image for file in files for image in pq.read_table(file)["image"].to_pylist()]
            kept = np.linspace(0, len(images) - 1, SPACED).astype(int)[:IMAGES]
            crops[simulator] = [spec_of(simulator).crop_top, spec_of(simulator).crop_bottom]
            pixels = cv2.cvtColor(np.concatenate([decode(images[index]) for index in kept]), cv2.COLOR_RGB2BGR)
            cv2.imwrite(
                str(out / f"{simulator}.jpg"),
                pixels,
                [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
            )
    write_json(out / "crops.json", crops)


if __name__ == "__main__":
    main()
