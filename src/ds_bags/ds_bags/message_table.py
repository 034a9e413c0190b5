"""Serialises many messages at once that differ in numbers alone: one row of CDR bytes each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

_ENCAPSULATION = 4
"""Bytes before the content of a message; its alignment counts from there (DDSI-RTPS 10.2)."""


class MessageTable:
    """CDR bytes of many messages of one type, first all equal to an example.

    Args:
        store: knows the type of the messages.
        example: message of that store with the strings and array lengths that all messages have.
        count: number of messages.

    Attributes:
        rows: (count, bytes of a message).
    """

    def __init__(self, store: Typestore, example: Any, count: int) -> None:
        message_type = example.__msgtype__
        serialised = np.frombuffer(bytes(store.serialize_cdr(example, message_type)), np.uint8)
        self.rows: NDArray[np.uint8] = np.tile(serialised, (count, 1))
        self._places = {path: (kind, at) for path, kind, at in _Layout(store).numbers(message_type, example)}

    def put(self, path: str, values: ArrayLike) -> None:
        """Put a number into each message.

        Args:
            path: names of the fields down to the number, such as `header.stamp.sec` or `transforms.0.header.stamp.sec`.
            values: (count,) numbers, within the range of the field's type.
        """
        kind, at = self._places[path]
        column = np.ascontiguousarray(values, kind)
        self.rows[:, at : at + kind.itemsize] = column.view(np.uint8).reshape(len(column), kind.itemsize)


class _Layout:
    """Walks through a message as CDR lays it out, little-endian, each value aligned to its size."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._at = 0

    def numbers(self, message_type: str, message: Any, path: str = "") -> Iterator[tuple[str, np.dtype[Any], int]]:
        """Yield path, type and offset of each number of a message."""
        for name, (node, detail) in self._store.fielddefs[message_type][1]:
            yield from self._value(node, detail, getattr(message, name), f"{path}{name}")

    def _value(self, node: Nodetype, detail: Any, value: Any, path: str) -> Iterator[tuple[str, np.dtype[Any], int]]:
        if node is Nodetype.NAME:
            yield from self.numbers(detail, value, f"{path}.")
        elif node is Nodetype.BASE and detail[0] == "string":
            self._skip(4, 4)
            self._at += len(value.encode()) + 1
        elif node is Nodetype.BASE:
            kind = np.dtype(detail[0]).newbyteorder("<")
            yield path, kind, _ENCAPSULATION + self._skip(kind.itemsize, kind.itemsize)
        else:
            if node is Nodetype.SEQUENCE:
                self._skip(4, 4)
            (inner, inner_detail), _ = detail
            for index, member in enumerate(value):
                yield from self._value(inner, inner_detail, member, f"{path}.{index}")

    def _skip(self, size: int, alignment: int) -> int:
        """Move past a value and return where it starts."""
        start = -(-self._at // alignment) * alignment
        self._at = start + size
        return start
