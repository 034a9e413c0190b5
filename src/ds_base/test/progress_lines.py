# SPDX-License-Identifier: Apache-2.0
"""Progress whose lines tests read."""

from __future__ import annotations

from ds_base.progress import Progress


class ProgressLines(Progress):
    """Keeps lines in order, and the amounts of work, done and in total, since the last start."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.done = self.total = 0.0

    def start(self, total: float) -> None:
        self.done, self.total = 0.0, total

    def advance(self, amount: float = 1, line: str = "") -> None:
        self.done += amount
        if line:
            self.describe(line)

    def describe(self, line: str) -> None:
        self.lines.append(line)
