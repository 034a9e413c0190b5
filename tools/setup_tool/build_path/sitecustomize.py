# SPDX-License-Identifier: Apache-2.0
"""Keeps what rosidl has parsed, for all generators of a build: each would parse every definition again.

Python imports this module by its name when it starts with this folder on PYTHONPATH.
"""

import os
import sys

if any("rosidl" in word for word in sys.orig_argv[:2]):
    import hashlib
    import pickle
    from pathlib import Path

    from rosidl_parser import parser

    parse = parser.parse_idl_string

    def parse_once(idl_string: str, png_file: str | None = None) -> object:
        """Parse a definition, or read what an earlier generator parsed from the same text."""
        kept = Path(os.environ["DS_PARSED"], hashlib.sha256(idl_string.encode()).hexdigest())
        if kept.exists():
            return pickle.loads(kept.read_bytes())
        content = parse(idl_string, png_file)
        new = kept.with_suffix(f".{os.getpid()}")
        new.write_bytes(pickle.dumps(content))
        new.replace(kept)
        return content

    parser.parse_idl_string = parse_once
