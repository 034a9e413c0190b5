# SPDX-License-Identifier: Apache-2.0
"""Feeds seeded damage to the readers of received files, and reports defects in their answers.

A damaged input must be accepted, or refused with one of the errors that its reader documents, in one line. Any other
exception, more than a few seconds of CPU time, more than half a gigabyte of memory, or a file written outside the
input's folder is a defect. A module `kinds_*.py` in this folder lists the kinds of files in `KINDS`; `test_fuzz.py`
runs them all.
"""

from __future__ import annotations

import resource
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np

SECONDS = 5.0
"""Limit for the CPU time of one input, s."""
MEMORY = 512 * 2**20
"""Limit by which one input may raise the process's peak memory, bytes."""
ADDRESS_SPACE = 8 * 2**30
"""Address space in addition to what is mapped, bytes: an explosion fails here before it exhausts the machine."""
LONGEST = 2000
"""Limit for the length of an error message, characters."""


class Hang(BaseException):
    """Reader that took too long; a BaseException, so that no reader catches it."""


@dataclass(frozen=True)
class Kind:
    """Kind of received file and the reader under test.

    Attributes:
        name: name in the test's id.
        write: writes an undamaged file or folder of so many units into an empty folder and returns its path.
        damage: changes the copy at a path in place, by the generator alone.
        read: reads a path as the command line would; may write only below the folder of the path.
        errors: errors that the reader documents.
        units: units that take the reader some hundredths of a second; 0 if the size has no such measure.
        small: units of the input that is damaged.
    """

    name: str
    write: Callable[[Path, int], Path]
    damage: Callable[[Path, np.random.Generator], None]
    read: Callable[[Path], object]
    errors: tuple[type[Exception], ...]
    units: int = 0
    small: int = 12

    def base(self, folder: Path) -> Path:
        """Write the input that is damaged into a new folder."""
        folder.mkdir()
        return self.write(folder, self.small)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Whether a reader refused one input as documented, and its defect in one line, or ""."""

    seed: int
    refused: bool
    defect: str


def try_inputs(kind: Kind, base: Path, work: Path, seeds: range) -> Iterator[Finding]:
    """Damage a copy of an undamaged input for each seed, in a working folder, read it, and judge the reader."""
    inside = work / "inside"
    with _bounded_address_space():
        for seed in seeds:
            inside.mkdir()
            copy = inside / base.name
            shutil.copytree(base, copy, symlinks=True) if base.is_dir() else shutil.copy(base, copy)
            kind.damage(copy, np.random.default_rng([seed, *kind.name.encode()]))
            before = _listing(work)
            finding = _judge(kind, copy, seed)
            if not finding.defect and _listing(work) != before:
                finding = Finding(seed=seed, refused=finding.refused, defect="wrote outside the folder of its input")
            shutil.rmtree(inside)
            yield finding


def _judge(kind: Kind, path: Path, seed: int) -> Finding:
    refused, defect = False, ""
    peak, begun = _peak(), time.process_time()
    try:
        with _limited_time():
            kind.read(path)
    except kind.errors as error:
        refused = True
        text = str(error)
        if "\n" in text or not text.strip():
            defect = f"{type(error).__name__} is not one line: {text!r}"
        elif len(text) > LONGEST:
            defect = f"{type(error).__name__} is {len(text)} characters long: {text[:100]!r}..."
    except Hang:
        defect = f"took more than {SECONDS:g} s"
    except BaseException as error:  # any other exception is a defect
        where = error.__traceback__
        while where is not None and where.tb_next is not None:
            where = where.tb_next
        place = f" at {where.tb_frame.f_code.co_filename}:{where.tb_lineno}" if where is not None else ""
        defect = f"{type(error).__name__}: {str(error)[:200]!r}{place}"
    if not defect and time.process_time() - begun > SECONDS:
        defect = f"took {time.process_time() - begun:.1f} s"
    if not defect and _peak() - peak > MEMORY:
        defect = f"took {(_peak() - peak) / 2**20:.0f} MiB"
    return Finding(seed=seed, refused=refused, defect=defect)


def _listing(folder: Path) -> list[str]:
    """List what is next to the input's folder."""
    return sorted(path.name for path in folder.iterdir())


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextmanager
def _limited_time() -> Iterator[None]:
    """Raise `Hang` after too much CPU time; pytest limits the wall-clock time."""

    def end(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def _bounded_address_space() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ADDRESS_SPACE, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
