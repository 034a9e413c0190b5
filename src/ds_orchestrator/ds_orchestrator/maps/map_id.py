"""Identity of a campaign's feature map: which tests it holds and on which simulator they were driven."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Kind = Literal["search", "migration", "union", "merged", "twin"]
"""search: a sibling's tests on itself; migration: one sibling's tests on another simulator; union: all tests on a
sibling; merged: the siblings' unions merged; twin: all tests on the twin."""


@dataclass(frozen=True, kw_only=True)
class MapId:
    """Identity of one feature map; use the constructors, which set the attributes of each kind.

    Attributes:
        kind: which tests on which simulator.
        simulator: simulator on which the tests were driven; "" for a merged map.
        origin: sibling whose search generated the tests; "" if the map holds tests of all siblings.
        operator: operator that merged the siblings; "" for the configured ones and for maps that are not merged.

    Examples:
        >>> from ds_orchestrator import MapId
        >>> MapId.union("bullet").name, MapId.twin("donkey").title
        ('union_bullet', 'Twin donkey')
    """

    kind: Kind
    simulator: str = ""
    origin: str = ""
    operator: str = ""

    @classmethod
    def search(cls, sibling: str) -> MapId:
        """Tests of a sibling's search, driven on that sibling."""
        return cls(kind="search", simulator=sibling, origin=sibling)

    @classmethod
    def migration(cls, origin: str, target: str) -> MapId:
        """Tests of one sibling's search, driven on another sibling or on the twin."""
        return cls(kind="migration", simulator=target, origin=origin)

    @classmethod
    def union(cls, sibling: str) -> MapId:
        """Tests of all searches, driven on one sibling (paper 3.4)."""
        return cls(kind="union", simulator=sibling)

    @classmethod
    def merged(cls, operator: str = "") -> MapId:
        """Unions of all siblings merged (paper 3.5), by the configured operators if none is named."""
        return cls(kind="merged", operator=operator)

    @classmethod
    def twin(cls, twin: str) -> MapId:
        """Tests of all searches, driven on the twin (paper 3.6)."""
        return cls(kind="twin", simulator=twin)

    @property
    def name(self) -> str:
        """Key in JSON documents and stem of file names, such as `migration_bullet_to_softbody`."""
        rest = f"{self.origin}_to_{self.simulator}" if self.kind == "migration" else self.simulator or self.operator
        return f"{self.kind}_{rest}" if rest else self.kind

    @property
    def title(self) -> str:
        """Heading of a picture, such as `All tests on bullet`."""
        if self.kind == "migration":
            return f"Migration: {self.origin} to {self.simulator}"
        words = {"search": "Search on", "union": "All tests on", "merged": "Siblings merged", "twin": "Twin"}
        return f"{words[self.kind]} {self.simulator or self.operator}".strip()


def map_ids(siblings: Sequence[str], twin: str | None, operators: Sequence[str] = ()) -> list[MapId]:
    """Identities of every map of a campaign, in the order in which they are written.

    Args:
        siblings: names of the siblings, in order.
        twin: name of the twin, or None.
        operators: further operators, each of which adds a merged map.
    """
    targets = [*siblings, *([twin] if twin else [])]
    return [
        *(MapId.search(sibling) for sibling in siblings),
        *(MapId.migration(origin, target) for origin in siblings for target in targets if target != origin),
        *(MapId.union(sibling) for sibling in siblings),
        MapId.merged(),
        *(MapId.merged(operator) for operator in operators),
        *([MapId.twin(twin)] if twin else []),
    ]


def compared_ids(ids: Iterable[MapId]) -> list[MapId]:
    """Select the maps to show side by side: unions, their merge by the configured operators, the twin."""
    return [map_id for map_id in ids if map_id.kind in ("union", "twin") or map_id == MapId.merged()]
