# SPDX-License-Identifier: Apache-2.0
"""Entry point of the command `ds`.

The overview, `--version`, `doctor` and `completion` need the standard library alone, so that they work before set-up.
Any other verb is imported when it is typed.
"""

from __future__ import annotations

import io
import os
import re
import signal
import sys
from collections.abc import Sequence

from ds_cli import doctor
from ds_cli.verbs import COMPLETION_VARIABLE, VERBS, completion, overview, uses_colour


def answer_without_libraries(arguments: Sequence[str]) -> int | None:
    """Answer what needs no library; returns the exit status, or None if the arguments ask for something else."""
    first, rest = (arguments[0], arguments[1:]) if arguments else ("--help", ())
    if COMPLETION_VARIABLE in os.environ:
        return None
    if first in ("-h", "--help", "help"):
        if rest and rest[0] in VERBS:
            return None
        print(overview(colour=uses_colour()))
        return 0 if arguments else 2
    if first == "--version":
        print(f"ds {version()}")
        return 0
    if first == "doctor":
        return doctor.main(rest)
    if first == "completion":
        program = doctor.repository() / "ds"
        return completion(rest, program if program.is_file() else None)
    return None


def version() -> str:
    """The version in this checkout's pyproject.toml, or that of the installed package."""
    project = doctor.repository() / "pyproject.toml"
    if project.is_file() and (match := re.search(r'^version = "(.*)"$', project.read_text("utf-8"), re.MULTILINE)):
        return match[1]
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    for distribution in ("digital-siblings", "ds_orchestrator"):
        try:
            return installed(distribution)
        except PackageNotFoundError:
            continue
    return "of unknown version"


def keep_standard_output() -> None:
    """Reserve standard output for what Python prints, so that no library can spoil a document.

    From here on file descriptor 1, where Fast DDS logs errors and PyBullet prints its build time, is standard error.
    Child processes inherit that.
    """
    if sys.stdout is not sys.__stdout__:  # a caller has replaced it already
        return
    sys.stdout = sys.stdout or open(os.devnull, "w")  # closed, so the next file would get its descriptor  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    sys.stdout.flush()
    kept = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), 1)
    buffering = 1 if sys.stdout.line_buffering else -1
    sys.stdout = open(kept, "w", buffering, sys.stdout.encoding, sys.stdout.errors, closefd=False)  # noqa: SIM115
    sys.__stdout__ = sys.stdout  # type: ignore[misc]  # holds it after a broken pipe, when it cannot be flushed


def main() -> None:
    """Run `ds`; whatever goes wrong ends in one line on standard error."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be text
    arguments = sys.argv[1:]
    status = answer_without_libraries(arguments)
    if status is not None:
        sys.exit(status)
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    keep_standard_output()
    from ds_orchestrator.graph import signals

    signal.set_wakeup_fd(-1)  # by which a signal ends an executable of ROS while it starts
    signals.listen()
    try:
        from ds_cli.application import run

        status = run(arguments)
    except KeyboardInterrupt:  # while libraries are imported
        print("stopped", file=sys.stderr)
        status = signals.exit_status()
    signals.IgnoreSignals().__enter__()  # a second one would kill the interpreter that takes down its handlers
    sys.exit(status)


if __name__ == "__main__":
    main()
