"""Recovers unfinished bags: keeps every chunk that a killed writer got to the disk, in order."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Footer, McapRecord, Message, Metadata, Schema

from ds_bags.layout import BagError, image_spool_path, new_folder, partial_path
from ds_bags.limits import MAX_METADATA, custom_data, regular_file
from ds_bags.mcap_records import DamagedFileError, records, topic_of_channel
from ds_bags.rosbag2_writer import ABOUT_RECORD, Rosbag2Writer
from ds_sim.bounded_yaml import BoundedYamlError, load_yaml

UNFINISHED = "UNFINISHED"
"""Outcome in the custom data of a recovered bag."""


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """Result of a recovery.

    Attributes:
        source: file that was read.
        folder: recovered bag.
        messages: number of recovered messages.
        seconds: time from the first message to the last.
        lost_bytes: bytes at the end of the file that could not be read.
    """

    source: Path
    folder: Path
    messages: int
    seconds: float
    lost_bytes: int


def unfinished_file(path: Path) -> Path:
    """Find the MCAP file that a killed writer left behind.

    Args:
        path: intended path of the bag, its hidden folder, a folder with an MCAP file, or that file.

    Raises:
        BagError: there is no such file, or the bag is whole.
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
            raise BagError(f"{folder} is whole: `ds bag info {folder}` describes it")
        if found:
            return found[0]
    raise BagError(f"{path}: nothing to recover: expected an .mcap file in it, or in {partial_path(path)}")


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Make a whole bag from an unfinished one, which stays as it is.

    Keeps every record up to the first damaged one, in order.

    Args:
        path: unfinished bag, see `unfinished_file`.
        out: folder to create; None for a folder next to the unfinished bag whose name ends in `_recovered`.

    Raises:
        BagError: there is no unfinished bag, nothing in it can be read, or `out` exists.
    """
    source = regular_file(unfinished_file(path))
    if out is None:
        beside = source.parent.parent if source.parent.parent.name.endswith(".partial") else source.parent
        out = beside.parent / f"{source.stem}_recovered"
    with new_folder(out) as hidden:
        return _copy(source, hidden, out)


def _copy(source: Path, folder: Path, out: Path) -> Recovered:
    facts: dict[str, str] = {}
    schemas: dict[int, Schema] = {}
    channels: dict[int, int] = {}
    writer: Rosbag2Writer | None = None
    ended: dict[str, str] = {}
    count, first, last, readable = 0, 0, 0, 0
    for record, position in _readable(source):
        # After the footer comes only the closing magic.
        readable = source.stat().st_size if isinstance(record, Footer) else position
        if isinstance(record, Metadata) and record.name == ABOUT_RECORD:
            facts = dict(record.metadata)
        elif isinstance(record, Metadata) and record.name == "rosbag2":
            # The file was finished but its folder was not: use the outcome that the file states.
            ended = _ending(record)
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
    lost = source.stat().st_size - readable
    cut = {"outcome": UNFINISHED, "message": f"recovered: the last {lost} bytes could not be read"}
    writer.close(facts | (ended or cut))
    return Recovered(source=source, folder=out, messages=count, seconds=(last - first) / 1e9, lost_bytes=lost)


def _readable(source: Path) -> Iterator[tuple[McapRecord, int]]:
    """Yield the records up to the first damaged one, with the number of bytes read so far."""
    with contextlib.suppress(DamagedFileError):
        yield from records(source)


def _ending(record: Metadata) -> dict[str, str]:
    """Return the custom data at the end of a finished file; empty if it is malformed."""
    try:
        information = load_yaml(record.metadata["serialized_metadata"], limits=MAX_METADATA)
        return custom_data(information)
    except (BoundedYamlError, KeyError, AttributeError, TypeError):
        return {}
