"""Packing bags into one and unpacking: the same bytes, and a pack that other readers open."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from ds_bags.info import describe
from ds_bags.layout import LEVELS, BagError
from ds_bags.packs import pack, topic_prefix, unpack
from ds_bags.run_writer import write_bag
from ds_bags.verification import verify_bag
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.selection import groups_of
from ds_orchestrator.store.model import NO_DRIVE, Execution, Test
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store
from ds_road.geometry import minimum_radius
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

pytestmark = pytest.mark.graph


def test_what_is_unpacked_is_what_was_packed_byte_for_byte(bags: Path, tmp_path: Path) -> None:
    packed = pack([bags / level for level in LEVELS], tmp_path / "pack", {"group": "all"})
    assert packed.bags == 3 and sorted(p.name for p in tmp_path.iterdir()) == ["pack"]
    with AnyReader([tmp_path / "pack"]) as reader:
        topics = {connection.topic: connection.msgcount for connection in reader.connections}
        assert topics["/telemetry/twin/state"] == topics["/raw/twin/state"] == 41 and topics["/raw/tf"] == 41
    for level, made in zip(LEVELS, unpack(tmp_path / "pack", tmp_path / "out"), strict=True):
        assert made == tmp_path / "out" / level
        for file in (bags / level).iterdir():
            assert (made / file.name).read_bytes() == file.read_bytes(), file.name
    assert unpack(tmp_path / "pack", tmp_path / "one", "telemetry") == [tmp_path / "one" / "telemetry"]
    assert verify_bag(tmp_path / "one" / "telemetry").step is None
    assert describe(tmp_path / "pack")["facts"]["packed"] == "3"


def test_a_campaign_s_bags_are_grouped_by_its_own_features_or_by_run(run: RunRecord, tmp_path: Path) -> None:
    features = ["minimum_radius:20", "turns_count"]
    raw = {"siblings": ["bullet", "softbody"], "twin": "donkey", "driver": "autopilot", "features": features}
    store = Store(tmp_path / "campaign.sqlite", config=parse_config(raw, "here").identity())
    for number, sibling in enumerate(("bullet", "softbody")):
        name = f"{sibling}-0-000{number}"
        store.add_test(Test(test_id=name, sibling=sibling, run=0, number=number, road=run.road, seed=3))
        for simulator in ("bullet", "donkey"):
            bag = f"bags/{name}-on-{simulator}"
            store.add_execution(
                Execution(
                    test_id=name, simulator=simulator, outcome=Outcome.COMPLETED, message="", fitness=1.0,
                    max_lateral_position=0.5, steps=0, simulated_seconds=0.0,
                    trajectory_sha256=trajectory_sha256(np.zeros((0, 5))), drive=NO_DRIVE, bag=bag,
                )
            )  # fmt: skip
    store.close()
    with pytest.raises(BagError, match="has no bags"):
        groups_of(tmp_path, "cell")
    (tmp_path / "bags").mkdir()
    write_bag(tmp_path / "bags" / "bullet-0-0000-on-donkey", "/twin", "donkey", run, {})
    for name in ("bullet-0-0000-on-bullet", "softbody-0-0001-on-bullet"):
        shutil.copytree(tmp_path / "bags" / "bullet-0-0000-on-donkey", tmp_path / "bags" / name)
    radius_in_feet = int(minimum_radius(run.road.points) * 3.280839895)
    cell = f"cell_{radius_in_feet // 20}_{run.road.turns_count}"
    assert {name: len(found) for name, found in groups_of(tmp_path, "cell").items()} == {cell: 3}
    assert {name: len(found) for name, found in groups_of(tmp_path, "run").items()} == {"bullet-0": 2, "softbody-0": 1}


def test_what_cannot_be_packed_or_unpacked_is_reported(bags: Path, tmp_path: Path) -> None:
    with pytest.raises(BagError, match="it is no pack"):
        unpack(bags / "telemetry", tmp_path)
    with pytest.raises(BagError, match="no whole bag"):
        pack([tmp_path], tmp_path / "pack", {})
    pack([bags / "telemetry"], tmp_path / "pack", {})
    with pytest.raises(BagError, match="it holds telemetry"):
        unpack(tmp_path / "pack", tmp_path, "other")
    with pytest.raises(BagError, match="exists already"):
        pack([bags / "telemetry"], tmp_path / "pack", {})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pack"]


def test_names_become_topics() -> None:
    assert topic_prefix("bullet-0-0001-on-donkey@a.yaml") == "bullet_0_0001_on_donkey_a_yaml"
    assert topic_prefix("7up") == "run_7up"
