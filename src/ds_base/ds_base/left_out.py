# SPDX-License-Identifier: Apache-2.0
"""What a reader leaves out of a file of others: counted, named, and said in one line."""

from __future__ import annotations

from dataclasses import dataclass, field

from ds_base.errors import DsError

NAMED = 3
"""Items that are named with their reasons; the others are counted."""


@dataclass
class LeftOut:
    """Collects items that cannot be read."""

    kind: str  # plural noun, such as "roads"
    strict: bool = False  # raise the first error instead of leaving its item out
    total: int = 0  # items so far, good ones included
    items: list[tuple[str, str]] = field(default_factory=list)  # name and reason of each that is left out

    def add(self, name: str, error: DsError | str, kind: type[DsError] = DsError) -> None:
        """Leave an item out, or raise its error if none may be left out."""
        if self.strict:
            raise error if isinstance(error, DsError) else kind(error)
        self.items.append((name, " ".join(str(error).split())))

    def line(self) -> str:
        """One line for a person; empty if nothing is left out."""
        if not self.items:
            return ""
        named = "; ".join(f"{name} ({reason})" for name, reason in self.items[:NAMED])
        rest = len(self.items) - NAMED
        more = f"; and {rest} more" if rest > 0 else ""
        return f"{len(self.items)} of {self.total} {self.kind} left out: {named}{more}"
