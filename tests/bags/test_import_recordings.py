# SPDX-License-Identifier: Apache-2.0
"""Recorded drives become a data set for training and RQ1."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ds_base.progress import SILENT
from ds_driver.data.dataset import DatasetError, crops_of, decode, read_samples
from ds_driver.data.recordings import Imported, Reading, import_recordings, open_recording
from ds_driver.networks.images import Crop, fit_to_network
from ds_driver.training import TrainingPlan, split
from ds_sim.registry import UntrustedSimulatorError

COUNT = 250


@pytest.fixture
def tub(tmp_path: Path) -> Path:
    """A drive of 250 images of 160 x 120, each brighter than the one before; the last one without steering."""
    folder = tmp_path / "tub"
    (folder / "images").mkdir(parents=True)
    rows = []
    for index in range(COUNT):
        cv2.imwrite(str(folder / "images" / f"{index}.png"), picture(index))
        row = {"_index": index, "_timestamp_ms": 1000 + 50 * index, "cam/image_array": f"{index}.png"}
        rows.append(row | ({"user/angle": index / COUNT, "user/throttle": 0.5} if index < COUNT - 1 else {}))
    (folder / "catalog_0.catalog").write_text("".join(json.dumps(row) + "\n" for row in rows))
    last = json.dumps({"paths": ["catalog_0.catalog"], "deleted_indexes": [2]})
    (folder / "manifest.json").write_text(f"[]\n[]\n{{}}\n{{}}\n{last}\n")
    return folder


def picture(index: int) -> np.ndarray:
    return np.full((120, 160, 3), index, np.uint8)


def imported(tub: Path, out: Path, name: str = "car") -> Imported:
    return import_recordings([open_recording(tub, Reading())], out, name, SILENT)


def test_a_tub_becomes_part_of_a_data_set(tub: Path, tmp_path: Path) -> None:
    assert imported(tub, tmp_path / "data") == Imported(name="car", images=COUNT - 2, unlabelled=1, files=3)
    samples = read_samples(tmp_path / "data")
    kept = [i for i in range(COUNT - 1) if i != 2]
    assert [s.steering for s in samples] == pytest.approx([i / COUNT for i in kept])
    for sample, index in list(zip(samples, kept, strict=True))[::50]:
        assert np.abs(decode(sample.jpeg).astype(int) - fit_to_network(picture(index))).max() <= 2
    training, validation = split(samples, TrainingPlan())
    assert {s.road_id for s in training} | {s.road_id for s in validation} == {f"tub.000{k}" for k in range(3)}
    assert crops_of(tmp_path / "data", ["car", "donkey"])["car"] == Crop()
    assert crops_of(tmp_path / "data", ["donkey"])["donkey"] != Crop()


def test_a_failed_import_is_reported_in_one_line(tub: Path, tmp_path: Path) -> None:
    for name in ("donkey", "../car", "my car", ".."):
        with pytest.raises(DatasetError, match=r"choose another --name$"):
            imported(tub, tmp_path / "data", name)
    imported(tub, tmp_path / "data")
    with pytest.raises(DatasetError, match="is there already"):
        imported(tub, tmp_path / "data")
    with pytest.raises(UntrustedSimulatorError, match="'car'"):
        crops_of(tmp_path / "elsewhere", ["car"])
    (tub / "images" / "7.png").write_bytes(b"\x89PNG cut")
    with pytest.raises(DatasetError, match=r"7\.png: an image is damaged, or neither JPEG nor PNG: remove that record"):
        imported(tub, tmp_path / "other")
    assert not list((tmp_path / "other").glob("*/*.parquet"))  # no incomplete file
    rows = [json.loads(line) for line in (tub / "catalog_0.catalog").read_text().splitlines()]
    for row in rows:
        row.pop("user/angle", None)
    (tub / "catalog_0.catalog").write_text("".join(json.dumps(row) + "\n" for row in rows if row["_index"] != 7))
    with pytest.raises(DatasetError, match="no image has a steering"):
        imported(tub, tmp_path / "third")
