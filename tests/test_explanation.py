"""`ds explain`: shares against their definition, and causes that are known because they were planted."""

from __future__ import annotations

import json
import os
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from benchmarks.explanation import made_name
from tests.command_line import ds

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.control.autopilot import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.executor import execution_of
from ds_orchestrator.store.model import Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import make_simulator
from ds_studies.explanation.shares import Explanation, Subset, shapley, subsets
from ds_studies.sensitivity.measurement import candidate_roads

PARTS = ("camera", "look", "vehicle", "delays")


def campaign(folder: Path, siblings: list[str], conditions: Conditions = DEFAULT) -> Path:
    """A campaign of one short road, driven by the autopilot, which sees no image."""
    folder.mkdir()
    road, seed = candidate_roads(1, 1, segments=2)[0]
    test = Test(
        test_id=f"{siblings[0]}-0-0000", sibling=siblings[0], run=0, number=0, road=road, seed=seed,
        conditions=conditions,
    )  # fmt: skip
    config = CampaignConfig(siblings=siblings, driver=AUTOPILOT, conditions=conditions)
    store = Store(folder / "campaign.sqlite", config=config.identity())
    store.add_test(test)
    for name in siblings:
        made = make_simulator(name)
        run = drive_road(made, make_driver(AUTOPILOT, made.spec), road, seed, conditions)
        store.add_execution(execution_of(test.test_id, name, run))
        made.close()
    store.close()
    return folder


def test_shapley_values_are_the_means_over_all_orders() -> None:
    rng = np.random.default_rng(4)
    value = {subset: float(rng.normal()) for subset in subsets(PARTS)}
    added = {part: [value[frozenset(o[: o.index(part) + 1])] - value[frozenset(o[: o.index(part)])]
                    for o in permutations(PARTS)] for part in PARTS}  # fmt: skip
    found = shapley(PARTS, value)
    assert found == {part: pytest.approx(np.mean(of)) for part, of in added.items()}
    assert sum(found.values()) == pytest.approx(value[frozenset(PARTS)] - value[frozenset()])


def explanation(losses: dict[Subset, float]) -> Explanation:
    return Explanation(test_id="t", fails="a", against="b", parts=("camera", "vehicle"), losses=losses,
                       failed={subset: loss >= 1.0 for subset, loss in losses.items()})  # fmt: skip


def test_the_sentence_says_what_is_the_cause_what_is_not_and_what_cures() -> None:
    nothing, camera, vehicle, both = subsets(("camera", "vehicle"))
    found = explanation({nothing: 0.5, camera: 1.0, vehicle: 0.5, both: 1.0})
    assert found.shares == {"camera": 1.0, "vehicle": 0.0} and found.left_over == 0.0 == found.only_together
    assert found.sentence == (
        "t fails on a because of the camera (1.00), not the vehicle. With the camera of b alone it completes there."
    )
    joint = explanation({nothing: 0.5, camera: 0.5, vehicle: 0.5, both: 1.0})
    assert joint.only_together == 1.0 and "the camera (0.50) and the vehicle (0.50)" in joint.sentence
    twice = explanation({nothing: 0.5, camera: 1.0, vehicle: 1.0, both: 1.0})
    assert "No single part of b makes it complete there." in twice.sentence
    gone = explanation({nothing: 0.5, camera: 0.5, vehicle: 0.5, both: 0.75})
    assert "do not repeat" in gone.sentence and gone.left_over == pytest.approx(0.5)
    assert "do not repeat" in explanation(dict.fromkeys(subsets(("camera", "vehicle")), 1.0)).document()["sentence"]


def test_a_planted_delay_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]), prepend=os.pathsep)
    late = made_name("bullet", "late_commands", 0.6)
    folder = campaign(tmp_path / "c", ["bullet", late])
    for more in ((), ("--test", "bullet-0-0000")):
        refused = ds("explain", folder, *more)
        assert refused.returncode == 2 and "--trust" in refused.stderr
    found_out = ds("explain", folder, "--workers", 2, "--trust", late, "--out", tmp_path / "out", "--json")
    (found,) = json.loads(found_out.stdout)["tests"]
    assert (found["fails"], found["against"]) == (late, "bullet") and found["left_over"] == 0.0
    assert found["shares"] == pytest.approx({"delays": 1.0, "vehicle": 0.0}) and len(found["drives"]) == 4
    assert found["sentence"].endswith("With the delays of bullet alone it completes there.")
    assert (tmp_path / "out" / "explanation.json").exists()


def test_conditions_are_removed_and_what_a_driver_does_not_see_has_no_share(tmp_path: Path) -> None:
    """The autopilot fails on bullet alone with commands 0.4 s late, and sees neither camera nor look."""
    folder = campaign(tmp_path / "c", ["bullet", "softbody"], Conditions(command_delay=0.4))
    (found,) = json.loads(ds("explain", folder, "--test", "bullet-0-0000", "--json").stdout)["tests"]
    assert found["shares"]["camera"] == 0.0 == found["shares"]["look"]
    assert found["shares"]["conditions"] + found["shares"]["vehicle"] == pytest.approx(1.0)
    assert ", partly the vehicle (" in found["sentence"]
    assert "under command_delay 0.4 s" in found["reason"] and len(found["drives"]) == 16
    shown = ds("explain", folder, "--groups", 0)
    assert shown.returncode == 0 and "1 on bullet" in shown.stdout
    for wrong, why in (
        (("--test", "bullet-0-0007"), "has no test"),
        (("--test", "bullet-0-0000", "--sim", "softbody"), "never fails on softbody: expected bullet"),
        (("--sim", "bullet"), "give --test, too"),
        (("--engine", "graph"), "expected local or dask"),
    ):
        refused = ds("explain", folder, *wrong)
        assert refused.returncode == 2 and why in refused.stderr and refused.stderr.count("\n") == 1
