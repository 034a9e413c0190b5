# SPDX-License-Identifier: Apache-2.0
"""Runs the command line in the test's process, where a test may have replaced parts of it."""

from __future__ import annotations

import io
import subprocess
from contextlib import redirect_stderr, redirect_stdout

from ds_cli import application, main


def ds(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a verb; the result has its exit status and what it printed."""
    given = [str(argument) for argument in arguments]
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main.answer_without_libraries(given)
        status = application.run(given) if status is None else status
    return subprocess.CompletedProcess(given, status, out.getvalue(), err.getvalue())
