# SPDX-License-Identifier: Apache-2.0
"""Compiled functions are kept, loaded without Numba, and compiled again when their source changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = """
from numba import cfunc, types
from numba.np.numpy_support import carray

@cfunc(types.void(types.CPointer(types.float64), types.float64), error_model="numpy")
def compiled(target, value):
    carray(target, 1)[0] += value / 3.0
"""
USE = """
import ctypes, sys
from ds_sim.machine_code import load
target = ctypes.c_double(1.0)
load("compiled_here.addition", ctypes.c_void_p, ctypes.c_double)(ctypes.addressof(target), 1.0)
print(target.value, "numba" in sys.modules)
"""

THREADS = """
import ctypes, threading
from concurrent.futures import ThreadPoolExecutor
from ds_sim.machine_code import load
barrier = threading.Barrier(8)
def address(_):
    barrier.wait()
    return ctypes.cast(load("compiled_here.addition", ctypes.c_void_p, ctypes.c_double), ctypes.c_void_p).value
with ThreadPoolExecutor(8) as pool:
    print(len(set(pool.map(address, range(8)))))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    package = tmp_path / "compiled_here"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "addition.py").write_text(SOURCE)
    return package


def used(folder: Path, use: str = USE) -> list[str]:
    code = f"import sys; sys.path[:0] = {[str(folder), *sys.path]!r}" + use
    environment = {"XDG_CACHE_HOME": str(folder / "cache")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    return done.stdout.split()


def test_a_function_is_compiled_once_and_again_when_its_source_changes(package: Path, tmp_path: Path) -> None:
    assert used(tmp_path) == [repr(1.0 + 1.0 / 3.0), "True"]
    assert used(tmp_path) == [repr(1.0 + 1.0 / 3.0), "False"]
    assert used(tmp_path, THREADS) == ["1"]  # all threads have the code of one engine, which is kept
    (package / "addition.py").write_text(SOURCE.replace("+=", "-="))
    assert used(tmp_path) == [repr(1.0 - 1.0 / 3.0), "True"]
    assert used(tmp_path) == [repr(1.0 - 1.0 / 3.0), "False"]


def test_where_its_package_cannot_be_written_the_users_cache_has_it(package: Path, tmp_path: Path) -> None:
    (package / "__pycache__").touch()  # a file is no folder, whoever asks
    assert [used(tmp_path)[1], used(tmp_path)[1]] == ["True", "False"]
    assert [path.name for path in (tmp_path / "cache").rglob("*.o")] == [f"addition.{sys.implementation.cache_tag}.o"]
