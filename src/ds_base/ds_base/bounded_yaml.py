# SPDX-License-Identifier: Apache-2.0
"""YAML that somebody else may have written: bounded in size, depth and what aliases expand to, built of JSON's types.

PyYAML's safe loader runs no code, but a file of a few hundred bytes whose aliases refer to each other ("billion
laughs") expands to gigabytes, and one of 100,000 brackets exhausts the stack. So events are counted first.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ds_base.bounded_file import LARGEST_INTEGER, FileError, read_regular

_Loader: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The C library's parser is ten times faster; a wheel without it has the other."""
_CONTROL = re.compile(r"[^\t\n\r -~\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, kw_only=True)
class YamlLimits:
    """Bounds of one document."""

    size: int = 2**20  # bytes of the text, and characters of all scalars with aliases expanded
    nodes: int = 200_000  # mappings, sequences and scalars, with aliases expanded
    depth: int = 50  # mappings and sequences inside each other


DEFAULT_LIMITS = YamlLimits()
"""Chosen: a hundred times the longest configuration in the documentation, read within a second."""


class BoundedYamlError(FileError):
    """Text that is not YAML, or beyond the limits; the message is one line without the file's name."""

    def __init__(self, message: str, mark: Any = None) -> None:
        place = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
        super().__init__(" ".join(f"{place}{message}".split()))


def read_yaml(path: Path) -> Any:
    """Read a YAML file in which no key comes twice; errors as in `load_yaml` and `read_regular`."""
    return load_yaml(read_regular(path, DEFAULT_LIMITS.size), unique_keys=True)


def load_yaml(text: str | bytes, *, limits: YamlLimits = DEFAULT_LIMITS, unique_keys: bool = False) -> Any:
    """Build the value of one YAML document, bytes of which are UTF-8, or say where it is wrong by a BoundedYamlError.

    Of a key that comes twice in one mapping the last is kept, unless keys have to be unique. A date stays text.
    """
    try:
        text = text.decode() if isinstance(text, bytes) else text
    except UnicodeDecodeError as error:
        raise BoundedYamlError(f"not UTF-8 text (byte {error.start})") from None
    if len(text) > limits.size:
        raise BoundedYamlError(f"longer than {limits.size / 2**20:g} MiB, the limit for such a text")
    if control := _CONTROL.search(text):
        raise BoundedYamlError(f"the character {control.group()!r} at position {control.start()} is not text")
    try:
        _check(text, limits)
        loader = _Unique(text) if unique_keys else _Json(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = "".join(text.split("\n")[mark.line : mark.line + 1]) if mark is not None else ""
        at_tab = mark is not None and line[mark.column : mark.column + 1] == "\t"
        tab = " (a tab: indent with spaces)" if at_tab else ""
        raise BoundedYamlError(f"{error.problem or error.context}{tab}", error.problem_mark) from None
    except yaml.YAMLError as error:
        raise BoundedYamlError(str(error)) from None


def _check(text: str, limits: YamlLimits) -> None:
    """Count nodes, characters and depth in the stream of events, with every alias as large as its anchor."""
    nodes = characters = 0
    open_nodes: list[tuple[str | None, int, int]] = []
    anchors: dict[str, tuple[int, int]] = {}
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.ScalarEvent):
            nodes, characters = nodes + 1, characters + len(event.value)
            if event.anchor is not None:
                anchors[event.anchor] = 1, len(event.value)
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, nodes, characters))
            if event.anchor is not None:
                anchors.pop(event.anchor, None)
            nodes += 1
            if len(open_nodes) > limits.depth:
                raise BoundedYamlError(f"nested deeper than {limits.depth} levels", event.start_mark)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, nodes_before, characters_before = open_nodes.pop()
            if anchor is not None:
                anchors[anchor] = nodes - nodes_before, characters - characters_before
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise BoundedYamlError(f"the alias *{event.anchor} refers to nothing before it", event.start_mark)
            more, longer = anchors[event.anchor]
            nodes, characters = nodes + more, characters + longer
        if nodes > limits.nodes or characters > limits.size:
            raise BoundedYamlError(
                f"more than {limits.nodes} values or {limits.size} characters, aliases expanded", event.start_mark
            )


class _Json(_Loader):  # type: ignore[misc, valid-type]
    """Builds the types of JSON alone; errors of single values name their place."""

    def construct_json_int(self, node: yaml.ScalarNode) -> int:
        digits = len(node.value)
        value = self.construct_yaml_int(node) if digits <= 100 else LARGEST_INTEGER
        if abs(value) >= LARGEST_INTEGER:
            raise BoundedYamlError(f"a whole number of {digits} digits, expected one of 64 bits", node.start_mark)
        return int(value)

    def construct_json_scalar(self, node: yaml.ScalarNode) -> Any:
        kind = node.tag.rpartition(":")[2]
        try:
            return self.construct_json_int(node) if kind == "int" else getattr(self, f"construct_yaml_{kind}")(node)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            if isinstance(error, BoundedYamlError):
                raise
            raise BoundedYamlError(f"{node.value[:40]!r} is not of the type {kind}", node.start_mark) from None

    def construct_json_mapping(self, node: yaml.Node) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise BoundedYamlError("expected keys with values", node.start_mark)
        self.flatten_mapping(node)
        mapping: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise BoundedYamlError("a key is a list or a mapping, expected text", key_node.start_mark)
            mapping[key] = self.construct_object(value_node, deep=True)
        return mapping

    def construct_json_list(self, node: yaml.Node) -> list[Any]:
        if not isinstance(node, yaml.SequenceNode):
            raise BoundedYamlError("expected a list", node.start_mark)
        return [self.construct_object(child, deep=True) for child in node.value]

    def refuse(self, node: yaml.Node) -> Any:
        raise BoundedYamlError(f"the tag {node.tag[:60]!r} is not allowed here", node.start_mark)


class _Unique(_Json):
    """A key that comes twice is an error, not overwritten silently."""

    def construct_json_mapping(self, node: yaml.Node) -> dict[Any, Any]:
        names: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and key.value in names:
                raise BoundedYamlError(f"the key {key.value} comes twice", key.start_mark)
            if isinstance(key, yaml.ScalarNode):
                names.add(key.value)
        return super().construct_json_mapping(node)


for _kind in ("int", "float", "bool", "null", "str"):
    _Json.add_constructor(f"tag:yaml.org,2002:{_kind}", _Json.construct_json_scalar)
_Json.add_constructor("tag:yaml.org,2002:timestamp", lambda loader, node: loader.construct_yaml_str(node))
_Json.add_constructor("tag:yaml.org,2002:map", lambda loader, node: loader.construct_json_mapping(node))
_Json.add_constructor("tag:yaml.org,2002:seq", _Json.construct_json_list)
for _kind in ("binary", "omap", "pairs", "set"):
    _Json.add_constructor(f"tag:yaml.org,2002:{_kind}", _Json.refuse)
_Json.add_constructor(None, _Json.refuse)
