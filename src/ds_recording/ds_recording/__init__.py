# SPDX-License-Identifier: Apache-2.0
"""Recordings of a real car as siblings: where the car was, on which track, seen by which camera."""

from ds_base.errors import InputError


class RecordingError(InputError):
    """A recording, or a file beside it, cannot be used; the message is one line with the remedy."""
