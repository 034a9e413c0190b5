# SPDX-License-Identifier: Apache-2.0
"""What a user can cause is one line; what only we can have caused says so, and keeps its traceback."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ds_base import InputError, RunError
from ds_cli.application import BUG, run


def failing(error: Exception) -> object:
    def verb(*_: object, **__: object) -> None:
        raise error

    return verb


@pytest.mark.parametrize(
    ("error", "status"),
    [(InputError("road.json: no road"), 2), (RunError("the simulator ended"), 1), (OSError(28, "No space left"), 2)],
)
def test_what_a_user_can_cause_is_one_line(
    error: Exception, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ds_road.read_roads", failing(error))
    monkeypatch.setattr("ds_road.read_raw_roads", failing(error))
    assert run(["road", "check", "roads.json"]) == status
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and "bug" not in lines[0]


@pytest.mark.parametrize("debug", [False, True])
def test_a_shape_error_of_ours_is_a_bug_with_a_traceback_in_a_file(
    debug: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> object:
        return np.ones(3) + np.ones(4)

    monkeypatch.setattr("ds_road.read_raw_roads", broken)
    assert run([*(["--debug"] if debug else []), "road", "check", "roads.json"]) == BUG == 70
    shown = capsys.readouterr().err
    assert ("Traceback" in shown) is debug
    last = shown.splitlines()[-1]
    assert "this is a bug of ds (ValueError), not of your input" in last
    found = re.search(r"report (\S+)$", last)
    assert found
    log = Path(found[1])
    assert "could not be broadcast" in log.read_text() and "ds " in log.read_text().splitlines()[0]
    log.unlink()
