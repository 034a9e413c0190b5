# SPDX-License-Identifier: Apache-2.0
"""Which clock the topics of a bag share: that of their headers, or that of logging."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_bags.layout import BagError
from ds_bags.reader import BagReader, stamp_of

OVERLAP = 0.5
"""Share of the shorter topic's time in which the other one, too, must have messages; chosen: recordings that belong
together share nearly all of it, and clocks that differ nothing."""


def time_of(message: Any, logged: int, *, headers: bool) -> int:
    """Time of a message on the chosen clock, ns."""
    return stamp_of(message) if headers else logged


def headers_are_shared(bag: BagReader, connections: Sequence[Any], needed: str = "") -> bool:
    """Decide the clock of a recording: headers, if those of all topics have stamps of one clock, else logging.

    Stamps of 0, as of nodes that set none, are no stamps; simulated time and wall time have nothing in common. Of the
    connections the images come first; the `needed` topic has a clock in common with them, or there is a BagError.
    """
    stamps: dict[str, list[int]] = {}
    logs: dict[str, list[int]] = {}
    for connection, logged, raw in bag.messages(list(connections)):
        stamps.setdefault(connection.topic, []).append(bag.stamp(connection, raw))
        logs.setdefault(connection.topic, []).append(logged)
    images = connections[0].topic if connections else ""
    if images not in stamps:
        return True
    by_header = {topic: _range(times) for topic, times in stamps.items()}
    by_log = {topic: _range(times) for topic, times in logs.items()}
    if all(all(times) and _overlap(by_header[images], by_header[topic]) for topic, times in stamps.items()):
        return True
    if needed in logs and not _overlap(by_log[images], by_log[needed]):
        spans = [f"{one}: headers {_span(by_header[one])}, logged {_span(by_log[one])}" for one in (images, needed)]
        raise BagError(f"{bag.path}: images and steering have no clock in common: {'; '.join(spans)}")
    return False


def _range(times: Sequence[int]) -> NDArray[np.float64]:
    return np.array([min(times), max(times)]) / 1e9


def _overlap(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    shared = min(one[1], other[1]) - max(one[0], other[0])
    return bool(shared >= OVERLAP * min(np.ptp(one), np.ptp(other)))


def _span(times: NDArray[np.float64]) -> str:
    return f"{times[0]:.1f} to {times[1]:.1f} s"
