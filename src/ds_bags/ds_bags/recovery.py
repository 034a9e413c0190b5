"""Makes a whole bag of one whose writer was killed: every chunk that reached the disk is kept, in its order."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml
from mcap.records import Channel, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from ds_bags.layout import BagError, image_spool_path, partial_path
from ds_bags.packs import topic_of_channel
from ds_bags.rosbag2_writer import ABOUT_RECORD, Rosbag2Writer

UNFINISHED = "UNFINISHED"
"""What a recovered bag's custom data has as outcome."""


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """What was found.

    Attributes:
        source: file that was read.
        folder: bag that was made.
        messages: number of messages in it.
        seconds: from the first to the last.
        lost_bytes: at the end of the file, of which nothing could be made.
    """

    source: Path
    folder: Path
    messages: int
    seconds: float
    lost_bytes: int


def unfinished_file(path: Path) -> Path:
    """The MCAP file that a killed writer left of a bag.

    Args:
        path: where the bag should have been, its hidden folder, a folder with an MCAP file, or that file.

    Raises:
        BagError: there is none, or the bag is whole.
    """
    if path.is_file():
        return path
    for folder in (
        path,
        path / path.name.removeprefix(".").removesuffix(".partial"),
        partial_path(path) / path.name,
        image_spool_path(path),
    ):
        found = sorted(folder.glob("*.mcap"))
        if found and (folder / "metadata.yaml").exists():
            raise BagError(f"{folder} is whole: `ds bag info {folder}` says what it holds")
        if found:
            return found[0]
    raise BagError(f"{path}: nothing to recover: expected an .mcap file in it, or in {partial_path(path)}")


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Make a bag of what a killed writer left; the remains stay as they are.

    Args:
        path: see `unfinished_file`.
        out: folder to make; None for a name beside the remains that ends with `_recovered`.

    Raises:
        BagError: nothing is there, nothing of it can be read, or `out` exists.
    """
    source = unfinished_file(path)
    if out is None:
        beside = source.parent.parent if source.parent.parent.name.endswith(".partial") else source.parent
        out = beside.parent / f"{source.stem}_recovered"
    if out.exists():
        raise BagError(f"{out} exists already: choose another --out")
    hidden = partial_path(out)
    shutil.rmtree(hidden, ignore_errors=True)
    try:
        found = _copy(source, hidden / out.name, out)
        (hidden / out.name).rename(out)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return found


def _copy(source: Path, folder: Path, out: Path) -> Recovered:
    facts: dict[str, str] = {}
    schemas: dict[int, Schema] = {}
    channels: dict[int, int] = {}
    writer: Rosbag2Writer | None = None
    ended: dict[str, str] = {}
    count, first, last, understood = 0, 0, 0, 0
    for record, position in _records(source):
        # What follows the footer is the end mark, which belongs to it.
        understood = source.stat().st_size if isinstance(record, Footer) else position
        if isinstance(record, Metadata) and record.name == ABOUT_RECORD:
            facts = dict(record.metadata)
        elif isinstance(record, Metadata) and record.name == "rosbag2":
            # Everything was written, but the folder was not: the bag's own last words count.
            ended = yaml.safe_load(record.metadata["serialized_metadata"]).get("custom_data") or {}
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel | Message):
            writer = writer or Rosbag2Writer(folder, facts)
            if isinstance(record, Channel):
                if record.id not in channels:
                    channels[record.id] = writer.channel(
                        topic_of_channel(record, schemas[record.schema_id], record.topic)
                    )
                continue
            writer.write(channels[record.channel_id], record.log_time, record.data)
            first = record.log_time if not count else min(first, record.log_time)
            last, count = max(last, record.log_time), count + 1
    if writer is None or not count:
        raise BagError(f"{source} holds no whole chunk: the writer was killed before its first flush")
    lost = source.stat().st_size - understood
    cut = {"outcome": UNFINISHED, "message": f"recovered: {lost} bytes at the end were of no use"}
    writer.close(facts | (ended or cut))
    return Recovered(source=source, folder=out, messages=count, seconds=(last - first) / 1e9, lost_bytes=lost)


def _records(source: Path) -> Iterator[tuple[McapRecord, int]]:
    """Every record that can be read, and how far into the file it is; ends where the file does not make sense."""
    with source.open("rb") as file:
        records = iter(StreamReader(file, validate_crcs=True).records)
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception:  # half a record raises whatever the reader stumbles on
                return
            yield record, file.tell()
