# SPDX-License-Identifier: Apache-2.0
"""Every source file names its licence in its first line, where tools that collect licences look (spdx.dev)."""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SUFFIXES = {".py", ".pyi", ".sh", ".in", ".cpp", ".js", ".css", ".j2"}
OF_TORCS = "plugins/ds_sim_torcs/host/"
"""Folder of the program that links against TORCS, which is under the GPL."""


def first_line(text: str) -> str:
    """Return a file's first line that is not for the system."""
    lines = [*text.splitlines(), ""]
    return lines[1] if lines[0].startswith("#!") else lines[0]


def test_every_source_file_names_its_licence() -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True, timeout=60)
    names = [name for name in tracked.stdout.splitlines() if (ROOT / name).is_file()]
    sources = [name for name in names if Path(name).suffix in SUFFIXES or (ROOT / name).read_bytes().startswith(b"#!")]
    assert len(sources) > 700
    missing = []
    for name in sources:
        licence = "GPL-2.0-or-later" if name.startswith(OF_TORCS) else "Apache-2.0"
        if f"SPDX-License-Identifier: {licence}" not in first_line((ROOT / name).read_text()):
            missing.append(name)
    assert not missing, f"the first line must be `# SPDX-License-Identifier: Apache-2.0`: {missing}"
