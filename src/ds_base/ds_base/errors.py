# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause, and can mend: one line says what is wrong, what was expected, and what to do.

`ds` prints that line. Whatever else is raised is a bug of this project: `ds` says so, and keeps the traceback.
"""

from __future__ import annotations

LONGEST = 1900
"""Characters of a message; chosen: a screen."""


class DsError(Exception):
    """Base of everything that a user can cause; its message is one line, whatever it quotes."""

    def __str__(self) -> str:
        """The message on one line of at most `LONGEST` characters."""
        text = "".join(c if c.isprintable() else " " for c in super().__str__())
        return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


class InputError(DsError, ValueError):
    """Something that was given cannot be used: a file, an option, a name; `ds` ends with the status 2."""


class RunError(DsError, RuntimeError):
    """Something that was tried did not work: a process, a connection, a drive; `ds` ends with the status 1."""
