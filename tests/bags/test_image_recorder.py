"""Images recorded from the graph of a user-defined simulator equal those that its driver received."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ds_bags.verification import verify_bag
from ds_road import Road

pytestmark = pytest.mark.graph


def test_a_subscribed_bag_has_every_image_bit_by_bit(tmp_path: Path) -> None:
    """The twin under its class's name is not in the registry, so it is recorded instead of re-simulated."""
    road = Road([(125.0, 25.0 * i) for i in range(4)])
    (tmp_path / "road.json").write_text(json.dumps(road.control_points))
    bag = tmp_path / "bag"
    command = [
        sys.executable, "-m", "ds_orchestrator.cli.main", "drive", "--sim", "ds_twin_donkey.simulator:DonkeySimulator",
        "--driver", "autopilot", "--road", str(tmp_path / "road.json"), "--bag", str(bag), "--level", "raw", "--json",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    steps = json.loads(done.stdout)["steps"]
    found = verify_bag(bag)
    assert (found.step, found.frames, found.images) == (None, steps + 1, steps + 1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "road.json"]
