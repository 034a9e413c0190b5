# SPDX-License-Identifier: Apache-2.0
"""Output of the set-up and execution of programs: one line per step on screen, the rest in the log."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

SHOWN_LINES = 15
"""Last lines of a failed program's output to show; chosen: a compiler's message with its context."""

NETWORK = "is the network there? see the log, then try again: what is done is kept"
"""Advice where a program that fetches has failed."""


class SetupError(Exception):
    """Set-up that cannot continue; the text is one line that says what is wrong and what to do."""


class CommandFailedError(SetupError):
    """Failure of a program that set-up ran.

    Attributes:
        output: output of the program.
    """

    def __init__(self, message: str, output: str) -> None:
        super().__init__(message)
        self.output = output


class Console:
    """Prints one line per step, and writes the log.

    Args:
        log: file for the output of all programs; created anew if its folder exists.
        inherited_descriptor: open file that every program keeps open, so that its lock outlives this process.
    """

    def __init__(self, log: Path, inherited_descriptor: int) -> None:
        self.log = log
        self._inherited = inherited_descriptor

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Print a step, and its duration in seconds when it is done."""
        begin = time.monotonic()
        print(f"  {what} ...", end="", flush=True)
        self._write(f"\n=== {what}\n")
        try:
            yield
        except BaseException:
            print(" failed", flush=True)
            raise
        print(f" {time.monotonic() - begin:.1f} s", flush=True)

    def leave_terminal(self) -> None:
        """Go on in a session of its own, with a lower priority, and with all output in the log."""
        os.setsid()
        os.nice(10)
        log = os.open(self.log, os.O_WRONLY | os.O_APPEND)
        null = os.open(os.devnull, os.O_RDWR)
        for descriptor, target in ((null, 0), (null, 1), (log, 2)):
            os.dup2(descriptor, target)

    def note(self, line: str) -> None:
        """Print one line outside a step."""
        print(line, flush=True)
        self._write(line + "\n")

    def run(
        self, command: Sequence[str | Path], *, environment: Mapping[str, str], folder: Path, advice: str = NETWORK
    ) -> str:
        """Run a program to its end, with its output in the log.

        Args:
            command: program and arguments.
            environment: all environment variables of the program.
            folder: working directory.
            advice: what the user can do if it fails, in a few words.

        Returns:
            Standard output and standard error of the program.

        Raises:
            CommandFailedError: the program could not be started, or its exit status was not 0.
        """
        words = [str(word) for word in command]
        self._write("$ " + " ".join(words) + "\n")
        lines: list[str] = []
        try:
            with subprocess.Popen(
                words,
                env=dict(environment),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                pass_fds=[self._inherited],
            ) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    lines.append(line)
                    self._write(line)
        except OSError as error:
            raise CommandFailedError(f"{words[0]} cannot be run ({error.strerror}): {advice}", "") from None
        output = "".join(lines)
        if process.returncode in (-signal.SIGINT, 128 + signal.SIGINT):
            raise KeyboardInterrupt  # Ctrl-C reached the program before this process
        if process.returncode:
            name = os.path.basename(words[0])
            raise CommandFailedError(f"{name} ended with status {process.returncode}: {advice}", output)
        return output

    def show_failure(self, error: SetupError) -> None:
        """Print the last lines of a program that failed, indented, and what to do."""
        if isinstance(error, CommandFailedError):
            for line in error.output.splitlines()[-SHOWN_LINES:]:
                print(f"    {line}", file=sys.stderr)
        print(f"set-up stopped: {error}", file=sys.stderr, flush=True)

    def _write(self, text: str) -> None:
        if self.log.parent.is_dir():
            with self.log.open("a") as log:
                log.write(text)
