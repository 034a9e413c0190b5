# SPDX-License-Identifier: Apache-2.0
"""Received bags: no code that they name runs, nothing is written outside, memory and time are bounded."""

from __future__ import annotations

import json
import shutil
import sqlite3
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from backports import zstd
from foreign_bags import foreign_bag
from rosbags.convert.converter import convert
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg

from ds_bags.bounded_rosbags import check_types
from ds_bags.copying import recover, rewrite_bag
from ds_bags.donkey_tub import TubError, read_tub
from ds_bags.info import describe
from ds_bags.layout import BagError, TooLargeError
from ds_bags.reader import STATE, BagReader, read_run
from ds_bags.run_writer import write_bag
from ds_bags.verification import verify_bag
from ds_driver.data.recordings import Reading, open_recording
from ds_sim.registry import DONKEY, UntrustedSimulatorError
from ds_sim.session import RunRecord

pytestmark = pytest.mark.graph

FOOTER = b"\x0f" + struct.pack("<Q", 4) + bytes(4) + b"\x02" + struct.pack("<Q", 20) + bytes(20) + b"\x89MCAP0\r\n"


@pytest.fixture
def bag(bags: Path, tmp_path: Path) -> Path:
    """A copy of a bag that the test may change."""
    return Path(shutil.copytree(bags / "telemetry", tmp_path / "sent" / "telemetry"))


def change(bag: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the metadata of a bag."""
    document = yaml.safe_load((bag / "metadata.yaml").read_text())
    change(document["rosbag2_bagfile_information"])
    (bag / "metadata.yaml").write_text(yaml.safe_dump(document))


def refused(act: Callable[[], object], match: str, kind: type[Exception] = BagError) -> None:
    """Check that an action is refused with one line, within seconds."""
    begun = time.process_time()
    with pytest.raises(kind, match=match) as found:
        act()
    assert "\n" not in str(found.value) and len(str(found.value)) < 1000
    assert time.process_time() - begun < 5.0


def test_a_simulator_that_a_bag_names_is_not_imported(
    bags: Path, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evilmod.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    images = Path(shutil.copytree(bags / "compressed", tmp_path / "sent" / "compressed"))
    for one in (bag, images):
        change(one, lambda information: information["custom_data"].update(simulator="evilmod:S"))
    refused(lambda: verify_bag(bag), r"--trust 'evilmod:S'", UntrustedSimulatorError)
    refused(lambda: verify_bag(bag, trusted=["evilmod:T"]), "evilmod:S", UntrustedSimulatorError)
    refused(lambda: open_recording(images, Reading()), "--trust 'evilmod:S'", UntrustedSimulatorError)
    assert describe(bag)["facts"]["simulator"] == "evilmod:S"
    assert "evilmod" not in sys.modules
    with pytest.raises(SystemExit, match="imported"):
        verify_bag(bag, trusted=["evilmod:S"])


@pytest.mark.parametrize(
    "name", ["../x", "/tmp/ds_absolute", "a/b", "a\\b", "", ".", "..", ".hidden", "a\nb", "x" * 300]
)
def test_a_tub_reads_only_its_own_files(tmp_path: Path, name: str) -> None:
    (tmp_path / "manifest.json").write_text(f"[]\n[]\n{{}}\n{{}}\n{json.dumps({'paths': [name]})}")
    refused(lambda: read_tub(tmp_path), "is not a plain name", TubError)


def test_hidden_folders_of_others_are_left_alone(bags: Path, tmp_path: Path) -> None:
    for folder in (tmp_path / ".two.partial", tmp_path / ".saved.partial"):
        folder.mkdir()
        (folder / "precious").touch()
    rewrite_bag(bags / "telemetry", tmp_path / "two", {}, {})
    shutil.copy(bags / "telemetry" / "telemetry.mcap", tmp_path / "left.mcap")
    recover(tmp_path / "left.mcap", tmp_path / "saved")
    assert len(list(tmp_path.rglob("precious"))) == 2
    (tmp_path / "link").symlink_to("nowhere")
    refused(lambda: recover(tmp_path / "left.mcap", tmp_path / "link"), "exists already")


def bomb_of_320_mib() -> bytes:
    compressor = zstd.ZstdCompressor(level=1)
    return b"".join(compressor.compress(bytes(2**24)) for _ in range(20)) + compressor.flush()


@pytest.mark.parametrize("declared", [6 * 10**9, 1000])
def test_chunks_that_open_to_gigabytes_are_refused(bag: Path, tmp_path: Path, declared: int) -> None:
    data = (bag / "telemetry.mcap").read_bytes()
    header = 17 + struct.unpack("<Q", data[9:17])[0]
    bomb = bomb_of_320_mib()
    assert len(bomb) < 100_000
    body = struct.pack("<QQQII4sQ", 0, 0, declared, 0, 4, b"zstd", len(bomb)) + bomb
    chunk = b"\x06" + struct.pack("<Q", len(body)) + body
    (bag / "telemetry.mcap").write_bytes(data[:header] + chunk + FOOTER)
    match = "the limit for a bag of this size" if declared > 1000 else "opens to more than its 1000 bytes"
    refused(lambda: describe(bag), match)
    refused(lambda: verify_bag(bag), match)
    refused(lambda: rewrite_bag(bag, tmp_path / "out", {}, {}), match)
    (tmp_path / "left.mcap").write_bytes(data[:header] + chunk + data[header:])
    if declared > 1000:
        refused(lambda: recover(tmp_path / "left.mcap", tmp_path / "out"), match, TooLargeError)
    assert not (tmp_path / "out").exists()


def test_a_compressed_file_that_opens_to_gigabytes_is_refused(bag: Path) -> None:
    (bag / "telemetry.mcap.zstd").write_bytes(bomb_of_320_mib())
    new = {"compression_mode": "FILE", "compression_format": "zstd", "relative_file_paths": ["telemetry.mcap.zstd"]}
    change(bag, lambda information: information.update(new))
    refused(lambda: describe(bag), "the limit for a bag of this size")


def test_tables_that_are_computed_are_refused(tmp_path: Path) -> None:
    with foreign_bag(tmp_path / "bag", StoragePlugin.SQLITE3):
        pass
    file = next((tmp_path / "bag").glob("*.db3"))
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id FROM c"
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute(f"CREATE VIEW message_definitions AS {endless}")
    refused(lambda: describe(tmp_path / "bag"), "that no recorder makes")


def test_definitions_become_code_only_within_limits() -> None:
    check_types(get_types_from_msg("float64[36] covariance\nstring[4] names", "a/msg/B"))
    for text in ("string[100000000] x", "uint8[0] x", "Other[-1] x"):
        with pytest.raises((TooLargeError, ValueError), match="fields|array"):
            check_types(get_types_from_msg(text, "a/msg/B"))
    with pytest.raises(ValueError, match="is called"):
        check_types({"a/msg/B": ([], [("x\nimport os", (1, ("int32", 0)))])})


def test_limits_are_not_those_of_everybody_who_imports_rosbags(tmp_path: Path) -> None:
    with foreign_bag(tmp_path / "bag", B="string[6000] names") as writer:
        writer.write("/names", 0, writer.make("car/B", names=["x"] * 6000))
    refused(lambda: describe(tmp_path / "bag"), "the limit is 5000", TooLargeError)
    with AnyReader([tmp_path / "bag"]) as reader:
        assert reader.connections[0].msgtype == "car/msg/B"


@pytest.mark.parametrize(
    ("fact", "value", "match"),
    [
        ("seed", "9" * 400, "seed '9"),
        ("seed", "-1", "seed '-1'"),
        ("road", "[" * 100_000, "nested too deeply"),
        ("road", f"[[0, 0], [{'9' * 400}, 1], [2, 2], [3, 3]]", "control point"),
        ("steps", "400", "40 commands, but 400 steps"),
    ],
)
def test_facts_are_checked(bag: Path, fact: str, value: str, match: str) -> None:
    change(bag, lambda information: information["custom_data"].update({fact: value}))
    refused(lambda: verify_bag(bag), match)


def test_metadata_that_counts_other_messages_than_the_file_has_is_refused(bag: Path) -> None:
    change(bag, lambda information: information.update(message_count=5000))
    refused(lambda: describe(bag), "counts 5000 messages, its files")


def test_a_state_that_is_not_a_number_is_refused(bags: Path, tmp_path: Path) -> None:
    def spoil(state: Any) -> Any:
        state.x = float("nan")
        return state

    rewrite_bag(bags / "telemetry", tmp_path / "nan", {STATE: spoil}, {})
    with BagReader(tmp_path / "nan") as found:
        refused(lambda: read_run(found), "is nan in a state")


def converted(bag: Path, folder: Path) -> Path:
    """A bag as `rosbags-convert` writes it anew."""
    convert([bag], folder / "converted", "mcap", 9, None, "none", None, None, (), (), (), ())
    return folder / "converted"


def test_a_converted_bag_is_redriven_with_what_it_has_lost(bags: Path, tmp_path: Path) -> None:
    """`rosbags-convert` drops custom data; the road is in a message, simulator and seed must be given."""
    made = converted(bags / "telemetry", tmp_path)
    refused(lambda: verify_bag(made), r"does not say its simulator, seed.*give --sim NAME --seed N")
    refused(lambda: verify_bag(made, DONKEY), r"does not say its seed.*give --seed N")
    found = verify_bag(made, DONKEY, seed=3)
    assert (found.step, found.frames) == (None, 41)


def test_a_bag_of_a_drive_in_the_left_lane_comes_out_the_same_with_and_without_custom_data(
    left_run: RunRecord, tmp_path: Path
) -> None:
    write_bag(tmp_path / "left", "/twin", DONKEY, left_run, {})
    made = converted(tmp_path / "left", tmp_path)
    for found in (verify_bag(tmp_path / "left"), verify_bag(made, DONKEY, seed=3)):
        assert (found.step, found.frames) == (None, 6)
