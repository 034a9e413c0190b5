# SPDX-License-Identifier: Apache-2.0
"""Public names of a package that are imported on first use, as its `__init__.pyi` lists them (SPEC 1)."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from ds_base.bounded_file import read_words


def names_of_stub(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make `__getattr__`, `__dir__` and `__all__` of a package, given its `__name__` and `__file__`."""
    stub = ast.parse(read_words(Path(file).with_suffix(".pyi")))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom) and node.level == 1]
    modules = {alias.name: f"{package}.{node.module}" for node in imports for alias in node.names}

    def imported(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return imported, lambda: sorted(modules), sorted(modules)
