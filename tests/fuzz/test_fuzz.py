# SPDX-License-Identifier: Apache-2.0
"""Every reader of received files accepts a damaged input, or refuses it in one line.

DS_FUZZ=N tries N inputs of each kind (80 if unset), DS_FUZZ_FIRST=SEED starts at SEED, not 0. Repeat one input:
DS_FUZZ=1 DS_FUZZ_FIRST=SEED pytest tests/fuzz -k KIND
"""

from __future__ import annotations

import math
import os
import time
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path

import pytest
from tests.fuzz.damage import HOSTILE, Rng
from tests.fuzz.harness import Finding, Kind, try_inputs
from tests.fuzz.kinds_tables import BOMBS

COUNT = int(os.environ.get("DS_FUZZ", "80"))
FIRST = int(os.environ.get("DS_FUZZ_FIRST", "0"))
KINDS: list[Kind] = [
    kind
    for path in sorted(Path(__file__).parent.glob("kinds_*.py"))
    for kind in import_module(f"tests.fuzz.{path.stem}").KINDS
]


@pytest.mark.timeout(120 + COUNT)
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_damaged_input_is_accepted_or_refused_in_one_line(
    kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, work = kind.base(tmp_path / "base"), tmp_path / "work"
    work.mkdir()
    whole = try_inputs(replace(kind, damage=lambda path, rng: None), base, work, range(1))
    assert list(whole) == [Finding(seed=0, refused=False, defect="")], "the undamaged input is not accepted"
    monkeypatch.chdir(work)  # writes to relative paths are detected here
    findings = list(try_inputs(kind, base, work, range(FIRST, FIRST + COUNT)))
    defects = [f"seed {finding.seed}: {finding.defect}" for finding in findings if finding.defect]
    assert not defects, f"{len(defects)} of {COUNT}:\n" + "\n".join(defects[:20])
    assert COUNT < 50 or any(finding.refused for finding in findings), "the damage damaged nothing"


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.units], ids=lambda kind: kind.name)
def test_ten_times_the_input_takes_less_than_twenty_times_as_long(kind: Kind, tmp_path: Path) -> None:
    """By turns and in the fastest of several rounds, as the first loads libraries and others may lose the processor."""
    paths, took = [], [math.inf, math.inf]
    for units in (kind.units, 10 * kind.units):
        (tmp_path / str(units)).mkdir()
        paths.append(kind.write(tmp_path / str(units), units))
    rounds = iter(range(10))
    while took[1] >= 20 * max(took[0], 0.005):
        assert next(rounds, None) is not None, f"{took[0]:.3f} s for {kind.units} units, {took[1]:.3f} s for tenfold"
        for at, path in enumerate(paths):
            begun = time.process_time()
            kind.read(path)
            took[at] = min(took[at], time.process_time() - begun)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_no_hostile_file_takes_a_reader_time_or_memory(
    kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, work = kind.base(tmp_path / "base"), tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    files = sorted(path.relative_to(base) for path in base.rglob("*") if path.is_file()) if base.is_dir() else [Path()]
    inputs = list(product(files, HOSTILE))

    def replace_one(copy: Path, rng: Rng) -> None:
        file, what = pending.pop(0)
        (copy / file).unlink()
        HOSTILE[what](copy / file)

    pending = list(inputs)
    findings = try_inputs(replace(kind, damage=replace_one), base, work, range(len(inputs)))
    defects = [
        f"{what} for {file}: {one.defect}" for (file, what), one in zip(inputs, findings, strict=True) if one.defect
    ]
    assert not defects, "\n".join(defects)


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_becomes_a_large_one_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    kind = next(kind for kind in KINDS if kind.name == name)
    base = kind.base(tmp_path / "base")
    bomb = replace(kind, damage=lambda path, rng: BOMBS[name][1](path))
    assert list(try_inputs(bomb, base, tmp_path / "work", range(1))) == [Finding(seed=0, refused=True, defect="")]
