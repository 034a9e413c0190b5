# SPDX-License-Identifier: Apache-2.0
"""Keeps functions that Numba compiled as object files, and loads them without Numba.

Numba takes seconds to compile, and even for what it has compiled before most of a second and 50 MB in every process;
LLVM alone loads an object file in milliseconds. The code is for the plainest processor of the machine's type, and
nothing in it is rearranged, so that it computes the bits of the same source run by Python.
"""

from __future__ import annotations

import ctypes
import dataclasses
import hashlib
import importlib
import os
import platform
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_type_hints

import llvmlite.binding as llvm
import numpy as np

from ds_base.bounded_file import read_regular
from ds_base.folder_files import write_whole

_LOADING = threading.Lock()
"""Held while an engine is made: of two that threads made at once, one would be freed with code that is in use."""


def layout(structure: type) -> np.dtype[np.void]:
    """Layout of a dataclass of floats and integers as a record, which compiled code uses like an instance."""
    hints = get_type_hints(structure)
    return np.dtype([(field.name, hints[field.name]) for field in dataclasses.fields(structure)])


def values(instance: Any) -> tuple[float | int, ...]:
    """Values of such a dataclass, to be assigned to a record."""
    return tuple(getattr(instance, field.name) for field in dataclasses.fields(instance))


def load(module: str, *arguments: Any, symbols: Mapping[str, int] | None = None) -> Callable[..., None]:
    """Load the function `compiled` of a module, a `numba.cfunc` that neither allocates nor raises, with ctypes' types.

    The module is imported, and its function compiled, only where no object file has the present code of its package.
    The symbols are addresses of the C functions that it calls, except those of the C library.
    """
    for name, address in (symbols or {}).items():
        llvm.add_symbol(name, address)
    with _LOADING:
        engine = _engine(module)
    return ctypes.PYFUNCTYPE(None, *arguments)(engine.get_function_address(_symbol(module)))


@cache
def _engine(module: str) -> llvm.ExecutionEngine:
    """Owner of a module's loaded code, which is kept as long as the process."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _processor())
    engine.add_object_file(llvm.ObjectFileRef.from_data(_object_file(module)))
    engine.finalize_object()
    return engine


def _processor() -> llvm.TargetMachine:
    """Plainest processor of this machine's type."""
    return llvm.Target.from_default_triple().create_target_machine(opt=3)


def _symbol(module: str) -> str:
    return module.replace(".", "_")


def _object_file(module: str) -> bytes:
    """Object file of a module's function; compiled first, and kept if there is a folder for it, where it is missing."""
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    source, stamp = Path(spec.origin), _stamp(Path(spec.origin).parent)
    kept = [folder / f"{source.stem}.{sys.implementation.cache_tag}.o" for folder in _folders(source.parent)]
    for path in kept:
        with suppress(OSError):
            content = read_regular(path)
            if content.startswith(stamp):
                return content[len(stamp) :]
    compiled = _compile(module)
    for path in kept:
        with suppress(OSError):
            write_whole(path, stamp + compiled)
            break
    return compiled


def _stamp(package: Path) -> bytes:
    """Hash of everything that the object file depends on."""
    names = ("numba", "llvmlite", "numpy")
    digest = hashlib.sha256(" ".join((platform.machine(), *map(version, names))).encode())
    for path in (Path(__file__), *sorted(package.glob("*.py"))):
        digest.update(read_regular(path))
    return digest.digest()


def _folders(package: Path) -> Iterator[Path]:
    """Folders for the object files of a package, like those of Numba: beside its bytecode, else in the user's cache."""
    yield package / "__pycache__"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(home):  # a user of a container may have no home
        yield Path(home) / "digital-siblings" / hashlib.sha256(str(package).encode()).hexdigest()[:12]


def _compile(module: str) -> bytes:
    function = importlib.import_module(module).compiled
    code = llvm.parse_assembly(function.inspect_llvm())
    code.get_function(function.native_name).name = _symbol(module)
    # Alone in its module, the function is merged with what it calls, and its branches for exceptions disappear.
    for other in code.functions:
        if not other.is_declaration and other.name != _symbol(module):
            other.linkage = "internal"
    machine = _processor()
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(code, passes)
    return bytes(machine.emit_object(code))
