"""Shares drives out over workers that come and go."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Generic, TypeVar

Worker = TypeVar("Worker")


class NoWorkerError(RuntimeError):
    """No worker became free, because none will."""


class Slots(Generic[Worker]):
    """Counts what each worker drives; safe to use from several threads.

    Args:
        room: worker -> number of drives that it takes at a time.
    """

    def __init__(self, room: Mapping[Worker, int] | None = None) -> None:
        self._room = dict(room or {})
        self._busy = dict.fromkeys(self._room, 0)
        self._changed = threading.Condition()
        self._closed = ""

    @property
    def workers(self) -> list[Worker]:
        """Workers that take drives."""
        with self._changed:
            return list(self._room)

    def add(self, worker: Worker, room: int) -> None:
        """Let a worker take drives."""
        with self._changed:
            self._room[worker] = room
            self._busy.setdefault(worker, 0)
            self._changed.notify_all()

    def remove(self, worker: Worker) -> None:
        """Let a worker take no further drives."""
        with self._changed:
            self._room.pop(worker, None)

    def has(self, worker: Worker) -> bool:
        """Whether a worker takes drives."""
        with self._changed:
            return worker in self._room

    def close(self, reason: str) -> None:
        """End every wait for a worker, now and later, with `NoWorkerError`."""
        with self._changed:
            self._closed = reason
            self._changed.notify_all()

    @contextmanager
    def taken(self) -> Iterator[Worker]:
        """Wait for a free worker, the one with the fewest drives, and occupy it.

        Raises:
            NoWorkerError: `close` was called.
        """
        with self._changed:
            while not (free := [w for w, room in self._room.items() if self._busy[w] < room]):
                if self._closed:
                    break
                self._changed.wait()
            if self._closed:
                raise NoWorkerError(self._closed)
            worker = min(free, key=lambda w: self._busy[w])
            self._busy[worker] += 1
        try:
            yield worker
        finally:
            with self._changed:
                self._busy[worker] -= 1
                self._changed.notify_all()
