# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause, and can mend: one line says what is wrong, what was expected, and what to do.

`ds` prints that line. Whatever else is raised is a bug of this project: `ds` says so, and keeps the traceback.
"""

from __future__ import annotations


class DsError(Exception):
    """Base of everything that a user can cause; its message is one line."""


class InputError(DsError, ValueError):
    """Something that was given cannot be used: a file, an option, a name; `ds` ends with the status 2."""


class RunError(DsError, RuntimeError):
    """Something that was tried did not work: a process, a connection, a drive; `ds` ends with the status 1."""
