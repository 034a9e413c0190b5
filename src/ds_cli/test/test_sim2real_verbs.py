# SPDX-License-Identifier: Apache-2.0
"""`ds sim2real`: bad input ends with status 2 and one line that says what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ds_cli.application import run
from ds_sim.camera.encodings import jpeg


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("train --real {0}/nowhere --out {0}/out", "does not exist"),
        ("train --real {0}/empty --out {0}/out", "no photographs, expected at least 20"),
        ("train --real {0}/noise --out {0}/out", "nothing like a lane"),
        ("train --sim bulet --real {0}/noise --out {0}/out", "unknown simulator 'bulet'"),
        ("train --preset huge --real {0}/noise --out {0}/out", "'huge'"),
        ("translate {0}/noise --generator {0}/missing.safetensors --out {0}/out", "no such generator"),
        ("translate {0}/noise --generator {0}/noise/n00.jpg --out {0}/out", "cannot be read"),
    ],
)
def test_bad_input_ends_in_one_line(
    arguments: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "noise").mkdir()
    rng = np.random.default_rng(1)
    for i in range(20):
        (tmp_path / f"noise/n{i:02d}.jpg").write_bytes(jpeg(rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)))
    assert run(["sim2real", *arguments.format(tmp_path).split()]) == 2
    seen = capsys.readouterr()
    assert expected in seen.err and seen.err.count("\n") == 1 and seen.err.startswith("error: ") and not seen.out
    assert not (tmp_path / "out").exists()
