# SPDX-License-Identifier: Apache-2.0
"""The code of docs/python_api.md, with shorter searches and a faster driver, for tests that run it."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "python_api.md"


def short_script(*, gymnasium: bool = True) -> str:
    """The page's blocks as one script, in which ROS cannot be imported."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    if not gymnasium:
        blocks = [block for block in blocks if "gymnasium" not in block]
    script = "import sys\nsys.modules['rclpy'] = None\n" + "\n".join(blocks)
    for long, quick in (
        ("population=10, iterations=20", "population=1, iterations=0"),
        ('"iterations": 1', '"iterations": 0'),
        ('make_driver("dave2_short", ', 'make_driver("autopilot", '),
    ):
        assert script.count(long) == 1, long
        script = script.replace(long, quick)
    return script
