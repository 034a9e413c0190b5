# SPDX-License-Identifier: Apache-2.0
"""A killed writer loses nothing that it flushed, and a campaign recognises its unfinished bag."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from ds_bags.copying import UNFINISHED, recover
from ds_bags.info import describe
from ds_bags.layout import BagError, partial_path
from ds_bags.reader import BagReader, read_run
from ds_bags.rosbag2_writer import Rosbag2Writer, topic_of, typestore
from ds_bags.run_writer import message_builder, write_bag
from ds_bags.verification import verify_bag
from ds_sim.registry import DONKEY
from ds_sim.session import RunRecord

pytestmark = pytest.mark.graph

KIND = "sensor_msgs/msg/CompressedImage"


def in_child(work: Callable[[], object], moment: Callable[[], bool]) -> None:
    """Fork, and kill the child with SIGKILL when its moment has come or it is done."""
    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    assert child.pid is not None
    while child.is_alive() and not moment():
        time.sleep(0.0005)
    os.kill(child.pid, signal.SIGKILL)
    child.join()


def payloads(folder: Path) -> list[bytes]:
    with AnyReader([folder]) as reader:
        return [raw for _, _, raw in reader.messages()]


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=[pytest.mark.long] * (seed > 4)) for seed in range(20)])
def test_everything_flushed_survives_a_kill(tmp_path: Path, seed: int) -> None:
    """Frames of random size, flushed at random; a file's length tells the test what the child has flushed."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(100, 60_000, 400)
    flushed = rng.random(400) < 0.3
    target, delay = int(rng.integers(1, 200)), float(rng.uniform(0.0, 0.004))
    store, make = typestore(), message_builder("/x")
    header, nothing = make.header(5, "camera"), np.zeros(0, np.uint8)
    empty = make._make("sensor_msgs/CompressedImage", header=header, format="jpeg", data=nothing)

    def message(number: int) -> bytes:
        empty.data = np.random.default_rng(number).integers(0, 255, int(sizes[number]), dtype=np.uint8)
        return bytes(store.serialize_cdr(empty, KIND))

    def work() -> None:
        writer = Rosbag2Writer(tmp_path / "bag", {"seed": str(seed)})
        channel = writer.channel(topic_of("/x", KIND, depth=1))
        with (tmp_path / "told").open("wb", buffering=0) as told:
            for number in range(400):
                writer.write(channel, number, message(number))
                if flushed[number]:
                    writer.flush()
                    told.write(b"." * (number + 1 - told.tell()))
        time.sleep(60.0)

    def moment() -> bool:
        if not (tmp_path / "told").exists() or (tmp_path / "told").stat().st_size < target:
            return False
        time.sleep(delay)
        return True

    in_child(work, moment)
    safe = (tmp_path / "told").stat().st_size
    with pytest.raises(BagError, match="ds bag recover"):
        describe(tmp_path / "bag")
    found = recover(tmp_path / "bag")
    read = payloads(found.folder)
    assert len(read) == found.messages >= safe >= target
    assert read == [message(number) for number in range(len(read))]
    facts = describe(found.folder)["facts"]
    assert (facts["seed"], facts["outcome"]) == (str(seed), UNFINISHED)


def test_a_killed_campaign_s_bag_is_unfinished_and_can_be_driven_again(run: RunRecord, tmp_path: Path) -> None:
    """`write_bag`, killed while its hidden file grows: no bag appears, and what is there re-simulates bit for bit."""
    hidden = partial_path(tmp_path / "bag") / "bag" / "bag.mcap"

    def moment() -> bool:
        return hidden.exists() and hidden.stat().st_size > 2_000_000

    in_child(lambda: write_bag(tmp_path / "bag", "/twin", DONKEY, run, {"driver": "autopilot"}, "raw"), moment)
    assert not (tmp_path / "bag").exists()
    with pytest.raises(BagError, match="was never finished"):
        describe(tmp_path / "bag")
    found = recover(tmp_path / "bag", tmp_path / "saved")
    again = verify_bag(found.folder)
    assert again.step is None and 5 < again.frames == again.images < 41
    assert f"recovered: {again.frames} frames, " in describe(found.folder)["facts"]["message"]
    with BagReader(found.folder) as bag:
        recorded = read_run(bag)
    assert recorded.run.road == run.road and recorded.run.seed == run.seed
    # The same test runs again: its bag replaces the remains.
    write_bag(tmp_path / "bag", "/twin", DONKEY, run, {"driver": "autopilot"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "saved"]


def test_a_bag_without_its_folder_s_metadata_keeps_its_outcome(bags: Path, tmp_path: Path) -> None:
    shutil.copytree(bags / "compressed", tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    found = recover(tmp_path / "bag")
    facts = describe(found.folder)["facts"]
    assert found.lost_bytes == 0 and facts == describe(bags / "compressed")["facts"]
    assert payloads(found.folder) == payloads(bags / "compressed")


def test_what_cannot_be_recovered_is_reported(bags: Path, run: RunRecord, tmp_path: Path) -> None:
    with pytest.raises(BagError, match="nothing to recover"):
        recover(tmp_path)
    with pytest.raises(BagError, match="is whole"):
        recover(bags / "raw")
    with Rosbag2Writer(tmp_path / "bag", {}) as writer:
        channel = writer.channel(topic_of("/outcome", "ds_interfaces/msg/Outcome", depth=1))
        writer.write(channel, 1, bytes(6))
    with pytest.raises(BagError, match="before its first flush"):
        recover(tmp_path / "bag")
    (tmp_path / "bag_recovered").mkdir()
    with pytest.raises(BagError, match="exists already"):
        recover(tmp_path / "bag")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "bag_recovered"]


def test_a_changed_byte_ends_what_is_kept(bags: Path, tmp_path: Path) -> None:
    """The chunk with the changed byte is left out, and so are the following ones, which would be out of order."""
    data = bytearray((bags / "raw" / "raw.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "broken.mcap").write_bytes(data)
    found: Any = recover(tmp_path / "broken.mcap", tmp_path / "out")
    kept = payloads(tmp_path / "out")
    whole = payloads(bags / "raw")
    assert 50 < len(kept) < len(whole) and kept == whole[: len(kept)] and found.lost_bytes > 0
