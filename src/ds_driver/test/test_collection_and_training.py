# SPDX-License-Identifier: Apache-2.0
"""Data collection and training on a small scale: the twin drives, Dave-2 trains, and both resume when stopped."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from progress_lines import ProgressLines

from ds_base.progress import SILENT
from ds_driver.data.collection import CollectionPlan, collect, given_roads, roads_both_ways
from ds_driver.data.dataset import DatasetError, Sample, balance, check_equal, decode, read_samples, write_manifest
from ds_driver.networks.weights import load_weights
from ds_driver.training import CHECKPOINT, TrainingError, TrainingPlan, augment, device_of, schedule_of, split, train
from ds_road import RoadError, road_to_json
from ds_sim import DONKEY
from ds_sim.camera.encodings import jpeg

JPEG = jpeg(np.zeros((160, 320, 3), np.uint8))
PLAN = CollectionPlan(roads=2, seed=5, max_angle=60, every=12)
PLAN_OF_TRAINING = TrainingPlan(epochs=1, batch_size=16, learning_rate=1e-3, validation=0.5, threads=1)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    collect(PLAN, [DONKEY], folder, SILENT)
    return folder


def test_every_road_is_driven_both_ways_and_labelled_by_the_autopilot(data: Path) -> None:
    roads = {road.road_id for road in roads_both_ways(PLAN.roads, PLAN.seed, max_angle=PLAN.max_angle)}
    files = sorted(path.name for path in (data / "donkey").glob("*.parquet"))
    assert files == sorted(f"{road}-{way}.parquet" for road in roads for way in ("forward", "reverse"))
    table = pq.read_table(data / "donkey" / files[0]).to_pylist()
    assert [row["step"] for row in table] == list(range(0, 12 * len(table), 12))
    assert decode(table[3]["image"]).shape == (160, 320, 3)
    assert all(-1.0 <= row["steering"] <= 1.0 and 0.0 <= row["throttle"] <= 1.0 for row in table)


def test_a_stopped_collection_resumes_with_the_same_result(data: Path) -> None:
    told = ProgressLines()
    first = sorted((data / "donkey").glob("*.parquet"))[1]
    before = {p.name: p.read_bytes() for p in (data / "donkey").glob("*.parquet")}
    first.unlink()
    collect(PLAN, [DONKEY], data, told)
    assert told.lines[0] == "3 drives are there already" and len(told.lines) == 2
    assert {p.name: p.read_bytes() for p in (data / "donkey").glob("*.parquet")} == before
    with pytest.raises(DatasetError, match="another plan"):
        collect(replace(PLAN, every=1), [DONKEY], data, SILENT)
    write_manifest(data, {"seed": 5})
    manifest = json.loads((data / "manifest.json").read_text())
    assert manifest["images"]["donkey"] == sum(manifest["steering"]["donkey"]) > 50


def test_given_roads_are_driven_under_the_conditions_of_their_tests(tmp_path: Path) -> None:
    """In fog the camera sees less contrast; the mutant is the road's family, and a second test adds nothing."""
    (road,), text = roads_both_ways(1, 5, max_angle=60), "visibility=20"
    test = {"control_points": road_to_json(road), "test_id": "bullet-0-0001", "outcomes": {"bullet": "STUCK"}}
    file = tmp_path / "failures.json"
    file.write_text(json.dumps([test, {**test, "conditions": text}, {**test, "seed": 9}]))
    given = given_roads(file, mutants=1, seed=1)
    assert [one.road.road_id == road.road_id for one in given] == [True, False, True, False, False]
    assert {one.family for one in given} == {road.road_id} and len({one.name for one in given}) == 5
    moved = [one.road for one in given if one.road.road_id != road.road_id]
    for mutant in moved:  # as the search does: one coordinate of one of the points 4 to 6, by at most 6 m
        moved_by = np.abs(np.array(mutant.control_points) - np.array(road.control_points))
        ((index, _),) = np.argwhere(moved_by)
        assert index in (4, 5, 6) and moved_by.max() <= 6
    assert [one.name for one in given_roads(file, mutants=1, seed=1)] == [one.name for one in given]
    collect(PLAN, [DONKEY], tmp_path / "new", SILENT, [given[0], given[2]])
    files = sorted((tmp_path / "new" / "donkey").glob("*-forward.parquet"))
    fog, clear = sorted(files, key=lambda path: "+" not in path.name)
    seen = [decode(pq.read_table(path)["image"][1].as_py()) for path in (fog, clear)]
    assert seen[0].std() < 0.8 * seen[1].std()
    assert pq.read_table(fog)["road_id"].unique().to_pylist() == [road.road_id]
    with pytest.raises(DatasetError, match="another plan"):
        collect(PLAN, [DONKEY], tmp_path / "new", SILENT, given[:1])
    for content, problem in (("[]", "holds no road"), (json.dumps([{**test, "conditions": 3}]), "road 0: its cond")):
        file.write_text(content)
        with pytest.raises(DatasetError, match=problem):
            given_roads(file, mutants=0, seed=1)
    file.write_text(json.dumps([[[125, 0], [125, 25], [125, 50]]]))
    with pytest.raises(RoadError, match="failures.json: road 0: a road has 3 control points"):
        given_roads(file, mutants=0, seed=1)


def sample(simulator: str, road: int) -> Sample:
    return Sample(jpeg=b"", steering=0.0, simulator=simulator, road_id=str(road))


def test_simulators_are_equally_represented_and_no_road_is_in_both_parts() -> None:
    samples = [sample("a", i % 10) for i in range(300)] + [sample("b", i % 10) for i in range(120)]
    training, validation = split(samples, TrainingPlan(seed=3))
    for part in (training, validation):
        assert sum(s.simulator == "a" for s in part) == sum(s.simulator == "b" for s in part) > 0
    assert not {s.road_id for s in training} & {s.road_id for s in validation}
    assert len({s.road_id for s in validation}) == 2
    assert len(balance(samples, np.random.default_rng(1), limit=7)) == 14


def test_training_learns_stops_and_resumes(data: Path, tmp_path: Path) -> None:
    short, plan = PLAN_OF_TRAINING, replace(PLAN_OF_TRAINING, epochs=2)
    whole = train(data, tmp_path / "whole", plan, SILENT)
    train(data, tmp_path / "parts", short, SILENT)
    parts = train(data, tmp_path / "parts", plan, SILENT)
    assert [e.training_loss for e in whole] == [e.training_loss for e in parts]
    assert whole[1].training_loss < whole[0].training_loss
    best = (tmp_path / "whole" / "dave2.safetensors").read_bytes()
    assert best == (tmp_path / "parts" / "dave2.safetensors").read_bytes()
    train(data, tmp_path / "steps", replace(plan, weights_at=(4, 8)), SILENT)
    kept = [(tmp_path / "steps" / f"dave2_{step}.safetensors").read_bytes() for step in (4, 8)]
    lowest = min((0, 1), key=lambda k: whole[k].validation_loss)
    assert kept[lowest] == best != kept[1 - lowest]
    with pytest.raises(TrainingError, match="other settings or images: choose another --out"):
        train(data, tmp_path / "parts", replace(plan, seed=9), SILENT)
    with pytest.raises(DatasetError, match="75 images for training, expected at least one batch of 128"):
        train(data, tmp_path / "few", replace(short, batch_size=128), SILENT)
    for content in (b"", b"no checkpoint"):
        (tmp_path / "parts" / CHECKPOINT).write_bytes(content)
        with pytest.raises(TrainingError, match="cannot be read"):
            train(data, tmp_path / "parts", plan, SILENT)


def test_training_continues_from_a_network_on_old_and_new_data(data: Path, tmp_path: Path) -> None:
    """With a step of nearly nothing, the weights stay those of the start, to the precision of the file."""
    plan = replace(PLAN_OF_TRAINING, learning_rate=1e-7, images_per_simulator=32, start="dave2_short")
    new = tmp_path / "new"
    (new / "donkey").mkdir(parents=True)
    shutil.copy(next((data / "donkey").glob("*.parquet")), new / "donkey")
    told = ProgressLines()
    train([data, new], tmp_path / "tuned", plan, told)
    with pytest.raises(TrainingError, match="other settings or images"):
        train(data, tmp_path / "tuned", plan, told)
    tuned, start = (load_weights(str(n)).tensors for n in (tmp_path / "tuned" / "dave2.safetensors", "dave2_short"))
    assert max(float(np.abs(tuned[name] - start[name]).max()) for name in start) < 1e-3
    again = train([data, new], tmp_path / "tuned", replace(plan, epochs=2), told)
    assert len(again) == 2 and any("1 epochs completed before" in line for line in told.lines)
    with pytest.raises(TrainingError, match="other settings or images"):
        train([data, new], tmp_path / "tuned", replace(plan, start="dave2"), told)
    with pytest.raises(TrainingError, match="dave2_short is no chauffeur: leave out --network"):
        train(data, tmp_path / "other", replace(plan, network="chauffeur"), told)
    with pytest.raises(TrainingError, match="dave2_real sees translated images"):
        train(data, tmp_path / "other", replace(plan, start="dave2_real"), told)


def test_unusable_data_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no drives"):
        read_samples(tmp_path)
    with pytest.raises(DatasetError, match="damaged"):
        decode(b"not a jpeg")
    (tmp_path / "sim").mkdir()
    (tmp_path / "sim" / "a.parquet").write_bytes(b"PAR1 cut")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_samples(tmp_path)
    row = {"image": JPEG, "steering": 1.5, "simulator": "sim", "road_id": "r"}
    pq.write_table(pa.Table.from_pylist([row]), tmp_path / "sim" / "a.parquet")
    with pytest.raises(DatasetError, match=r"outside \[-1, 1\]"):
        read_samples(tmp_path)
    for image, state in ((None, "missing"), (b"", "missing"), (JPEG[:-40], "cut"), (b"GIF89a", "cut or no JPEG")):
        rows = [row | {"image": JPEG, "steering": 0.0}, row | {"image": image, "steering": 0.0}]
        pq.write_table(pa.Table.from_pylist(rows), tmp_path / "sim" / "a.parquet")
        with pytest.raises(DatasetError, match=f"a.parquet, row 1: the image is {state}.*collect it again"):
            read_samples(tmp_path)


def test_unequal_simulators_are_refused_in_one_line() -> None:
    check_equal([sample("a", 1)] * 40 + [sample("b", 1)] * 20 + [sample("c", 1)] * 30)
    check_equal([sample("a", 1)])
    with pytest.raises(DatasetError, match=r"^19 images of b and 40 of a: expected at most twice as many"):
        check_equal([sample("a", 1)] * 40 + [sample("b", 1)] * 19 + [sample("c", 1)] * 30)


def test_a_missing_gpu_and_unknown_names_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert device_of("auto").type == "cpu"
    with pytest.raises(TrainingError, match=r"^PyTorch finds no usable GPU.*leave out --device cuda"):
        device_of("cuda")
    with pytest.raises(TrainingError, match="expected auto, cpu or cuda"):
        device_of("tpu")
    with pytest.raises(TrainingError, match="expected laptop or paper"):
        schedule_of("weekend", "dave2")
    assert schedule_of("paper", "dave2").epochs == 50 and schedule_of("paper", "epoch").patience == 20


def test_augmentation_changes_the_label_with_the_image() -> None:
    """Half of the images change; a flipped one steers the other way, a shift to the right steers right (maxitwo)."""
    image = np.zeros((160, 320, 3), np.uint8)
    image[:, 240:244] = 255
    rng = np.random.default_rng(1)
    results = [augment(image, 0.3, rng) for _ in range(2000)]
    untouched = sum(changed is image for changed, _ in results)
    assert 950 < untouched < 1150
    flipped = shifted = 0
    for changed, steering in results:
        assert changed.shape == image.shape and changed.dtype == np.uint8
        bright = changed[80, :, 0] > 0.15 * 255
        column = float(np.mean(np.flatnonzero(bright)))
        flip = column < 160
        flipped += flip
        dx = column - (319 - 241.5 if flip else 241.5)
        shifted += dx != 0
        assert steering == pytest.approx((-0.3 if flip else 0.3) + 0.002 * dx, abs=1e-9)
    assert 400 < flipped < 600 and 400 < shifted < 600
