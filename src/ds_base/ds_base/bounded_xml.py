# SPDX-License-Identifier: Apache-2.0
"""Parses XML that a stranger may have sent: of bounded size, and without a document type."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ds_base.bounded_file import FileError

MOST_ELEMENTS = 1_000_000
"""Elements of a file; chosen: those of 16 MiB of points of roads, read within seconds."""


class _BoundedTree(ElementTree.TreeBuilder):
    _left = MOST_ELEMENTS

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse a document type, before anything that it defines."""
        raise FileError("XML with a document type: remove it, as definitions in it could fill the memory")

    def start(self, tag: str, attrs: dict[str, str]) -> Any:
        """Open an element."""
        self._left -= 1
        if self._left < 0:
            raise FileError(f"more than {MOST_ELEMENTS} elements, the limit for such a file: divide it")
        return super().start(tag, attrs)


def parse_xml(content: bytes) -> Element:
    """Return the root of a document in any encoding, or raise a FileError of one line."""
    try:
        return ElementTree.fromstring(content, ElementTree.XMLParser(target=_BoundedTree()))
    except FileError:
        raise
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise FileError(f"not XML ({error})") from None
