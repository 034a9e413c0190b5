"""Errors of this package."""

from __future__ import annotations


class RecordingError(ValueError):
    """A recording, or a file beside it, cannot be used; the message is one line with the remedy."""
