# SPDX-License-Identifier: Apache-2.0
"""JSON that a stranger may have sent: nested as deep as Python reads it, larger integers infinite."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from ds_base.bounded_file import LARGEST_FILE, FileError, read_regular

LARGEST_INTEGER = 2**64
"""Integers of JSON and YAML are smaller, so that each is a `float`, too."""


def load_json(text: str | bytes) -> Any:
    """Build the value of a document.

    Raises:
        FileError: not JSON, or nested too deep; one line.
    """
    try:
        return json.loads(text, parse_int=_integer)
    except FileError:
        raise
    except RecursionError:
        raise FileError("not JSON (nested too deeply)") from None
    except ValueError as error:
        raise FileError(f"not JSON ({' '.join(str(error).split())[:150]})") from None


def read_json(path: Path, largest: int = LARGEST_FILE) -> Any:
    """Read a file; arguments and errors as in `read_regular`, errors as in `load_json`, too."""
    return load_json(read_regular(path, largest))


def _integer(digits: str) -> int | float:
    """An integer; infinity beyond 64 bits, as of a float of so many digits, which every reader refuses as no number."""
    if len(digits) <= 20 and abs(int(digits)) < LARGEST_INTEGER:
        return int(digits)
    return -math.inf if digits[0] == "-" else math.inf
