# SPDX-License-Identifier: Apache-2.0
"""Donkey Car's own pilots, made by its own package, against their descriptions as `ds check` writes them.

`benchmarks/donkeycar_pilots.py` makes the files, and the answers of Donkey Car's interpreter to the same frames.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.pilot import Frame
from ds_studies.network_check.description import forms_of

FILES = Path(__file__).parent / "data/donkeycar_pilots.zip"
KINDS = ["linear", "categorical", "inferred", "memory", "behavior", "imu", "localizer", "rnn", "3d"]
WITHOUT_THROTTLE = {
    "inferred": "Donkey Car computes it from the angle, and here the paper's equation 2 does",
    "rnn": "second number of its only output, which has no name",
    "3d": "second number of its only output, which has no name",
}


def unpacked(kind: str, folder: Path) -> tuple[Path, NDArray[np.uint8], NDArray[np.float64]]:
    with zipfile.ZipFile(FILES) as packed:
        packed.extract(f"{kind}.onnx", folder)
        blocks, answers = (np.load(io.BytesIO(packed.read(name))) for name in ("frames.npy", f"{kind}.npy"))
    return folder / f"{kind}.onnx", np.kron(blocks, np.ones((32, 32, 1), np.uint8)), answers


@pytest.mark.parametrize("kind", KINDS)
def test_it_answers_as_in_donkey_car(kind: str, tmp_path: Path) -> None:
    file, images, answers = unpacked(kind, tmp_path)
    (described,) = forms_of(file)
    assert described.has_memory == (kind in ("memory", "rnn", "3d"))
    pilot = DescribedNetworkPilot(file, described=described)
    for _ in range(2):  # a second run begins afresh
        pilot.start()
        found = [pilot.predict(Frame(image=image, speed=0.0, step=k)) for k, image in enumerate(images)]
        assert [one.steering for one in found] == pytest.approx(answers[:, 0], abs=2e-6)
        if kind not in WITHOUT_THROTTLE:
            assert [one.throttle for one in found] == pytest.approx(answers[:, 1], abs=2e-6)
    assert len(set(answers[:, 0])) > 1 or kind == "behavior"
