# SPDX-License-Identifier: Apache-2.0
"""Errors of this package."""

from __future__ import annotations

from ds_base.errors import InputError


class RecordingError(InputError):
    """A recording, or a file beside it, cannot be used; the message is one line with the remedy."""
