# SPDX-License-Identifier: Apache-2.0
"""Loads parts that other packages add: installed ones by their entry points, and the user's own as `module:NAME`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from ds_base.bounded_file import read_words
from ds_base.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Group = Literal["simulators", "drivers", "features", "operators"]
"""Kinds of parts; the entry points are in the group `digital_siblings.KIND`."""
TRUST_VARIABLE = "DS_TRUST"
"""Environment variable with names that may be loaded, separated by commas."""

Part = TypeVar("Part")
_confirmed: set[str] = set()


class ExtensionError(InputError):
    """A name that nobody confirmed, or that leads to no such part."""


@cache
def installed(group: Group) -> Mapping[str, EntryPoint]:
    """List the parts that installed packages add: name -> entry point, whose `dist` is the package."""
    from importlib.metadata import entry_points  # would delay every help text

    return {entry.name: entry for entry in entry_points(group=f"digital_siblings.{group}")}


def plugin_of(simulator: str) -> str:
    """Folder of this checkout, such as `plugins/ds_sim_mine`, whose package adds a simulator; "" without one."""
    import tomllib

    for file in sorted(Path(__file__).resolve().parents[3].glob("plugins/*/pyproject.toml")):
        groups = tomllib.loads(read_words(file))["project"].get("entry-points", {})
        if simulator in groups.get("digital_siblings.simulators", ()):
            return f"plugins/{file.parent.name}"
    return ""


def is_extension(name: str) -> bool:
    """Whether a name has the form `module:NAME`.

    Examples:
        >>> is_extension("my_parts.features:HAIRPINS"), is_extension("minimum_radius:20")
        (True, False)
    """
    module, colon, attribute = name.partition(":")
    return bool(colon) and all(part.isidentifier() for part in module.split(".")) and attribute.isidentifier()


def confirm(names: Iterable[str]) -> None:
    """Let names be loaded in this process; only the user's own words count, never those of a received file."""
    _confirmed.update(names)


def load_extension(name: str, kind: type[Part], what: str) -> Part:
    """Import what `module:NAME` leads to, an instance of `kind`, called `what` in messages.

    ExtensionError if nobody confirmed the name, if it cannot be imported, or if it is of another kind.
    """
    if name not in _confirmed and name not in os.environ.get(TRUST_VARIABLE, "").split(","):
        raise ExtensionError(
            f"{what} {name:.100} is Python code that is not shipped, and a received file must not run code: if you "
            f"trust it, set {TRUST_VARIABLE}={name:.100}"
        )
    module, _, attribute = name.partition(":")
    advice = "expected module:NAME, with the module in this folder or on PYTHONPATH"
    return _loaded(lambda: getattr(import_module(module), attribute), name, kind, what, advice)


def load_installed(name: str, group: Group, kind: type[Part], what: str) -> Part:
    """Import a part that an installed package adds, as `load_extension`; installing it was the user's consent."""
    entry = installed(group)[name]
    return _loaded(entry.load, name, kind, what, f"install {entry.dist.name if entry.dist else entry.value} again")


def _loaded(load: Callable[[], object], name: str, kind: type[Part], what: str, advice: str) -> Part:
    try:
        part = load()
    except Exception as error:  # importing a module can raise anything
        raise ExtensionError(f"{what} {name} cannot be imported ({type(error).__name__}: {error}): {advice}") from None
    if not isinstance(part, kind):
        raise ExtensionError(f"{what} {name} is a {type(part).__name__}, expected a {kind.__name__}")
    return part
