#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Check subjects of commits: at most 72 characters, no full stop, no absolute paths.

Usage: python3 tools/check_subjects.py [FILE | RANGE]

    FILE    one message, as git hands it to its hook commit-msg
    RANGE   commits as `git log` takes them; the newest 100 if nothing is given
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

LONGEST = 72
NEWEST = "--max-count=100"
ABSOLUTE_PATH = re.compile(r"(?:^|[\s\"'`(=])~?/\w+")


def faults(subject: str) -> list[str]:
    """List what is wrong with a subject, each in a few words."""
    found = {
        f"is longer than {LONGEST} characters": len(subject) > LONGEST,
        "ends with a full stop": subject.endswith("."),
        "names an absolute path": ABSOLUTE_PATH.search(subject) is not None,
        "is empty": not subject.strip(),
    }
    return [fault for fault, holds in found.items() if holds]


def subjects_of(what: str) -> list[tuple[str, str]] | None:
    """List commits as (name, subject), without merges; None where there is no such history."""
    if Path(what).is_file():
        return [(what, (Path(what).read_text().splitlines() or [""])[0])]
    command = ["git", "log", "--no-merges", "--format=%h %s", what, "--"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except OSError:
        return None
    if done.returncode:
        return None
    return [(name, subject) for name, _, subject in (line.partition(" ") for line in done.stdout.splitlines())]


def main() -> int:
    """Check what the arguments name; the result is the exit status."""
    what = sys.argv[1] if len(sys.argv) > 1 else NEWEST
    subjects = subjects_of(what)
    if subjects is None:
        print(f"subjects of commits: not checked, no history of {what} here")
        return 0
    wrong = [f"{name}: the subject {fault}: {subject}" for name, subject in subjects for fault in faults(subject)]
    print("\n".join(wrong) if wrong else f"subjects of commits: {len(subjects)} checked")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
