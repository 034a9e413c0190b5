# SPDX-License-Identifier: Apache-2.0
"""Runs the command line: in the test's process, where a test may have replaced parts of it, or in one of its own."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from ds_cli import application, main


def ds(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a verb; the result has its exit status and what it printed."""
    given = [str(argument) for argument in arguments]
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main.answer_without_libraries(given)
        status = application.run(given) if status is None else status
    return subprocess.CompletedProcess(given, status, out.getvalue(), err.getvalue())


def ds_process(*arguments: object, cwd: Path | None = None, timeout: float = 280.0) -> subprocess.CompletedProcess[str]:
    """The same in a new process."""
    command = [sys.executable, "-m", "ds_cli.main", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout)


def document(*arguments: object) -> Any:
    """Run a verb that succeeds; returns its JSON document."""
    done = ds(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def refusal(*arguments: object, status: int = 2) -> str:
    """Run a verb that refuses to; returns its line on standard error, the only one of its output."""
    done = ds(*arguments)
    assert (done.returncode, done.stdout) == (status, "") and done.stderr.count("\n") == 1, done
    return done.stderr.strip()
