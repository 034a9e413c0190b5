# SPDX-License-Identifier: Apache-2.0
"""`ds explain`: shares against their definition, and causes that are known because they were planted."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from benchmarks.explanation import made_name
from tests.command_line import document, refusal
from tests.drives import driven

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError
from ds_orchestrator.campaign.executor import execution_of
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_orchestrator.store.model import Origin, Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import BULLET, SOFTBODY, SimulatorName
from ds_sim.simulator import Outcome
from ds_studies.explanation import Explanation, experiment_on, shapley, subsets
from ds_studies.steering_roads import candidate_roads

PARTS = ("camera", "look", "vehicle", "delays")


def campaign(folder: Path, siblings: list[SimulatorName], conditions: Conditions = DEFAULT) -> Path:
    """A campaign of one short road, driven by the autopilot, which sees no image."""
    folder.mkdir()
    scenario = replace(candidate_roads(1, 1, segments=2)[0], conditions=conditions)
    test = Test(f"{siblings[0]}-0-0000", scenario, Origin(siblings[0], 0, 0))
    config = CampaignConfig(siblings=siblings, driver=AUTOPILOT, conditions=conditions)
    store = Store(folder / "campaign.sqlite", config=config.identity())
    store.add_test(test)
    for name in siblings:
        run = driven(name, test.road, test.seed, conditions)
        store.add_execution(execution_of(test.test_id, name, run))
    store.close()
    return folder


def test_shapley_values_are_the_means_over_all_orders() -> None:
    rng = np.random.default_rng(4)
    value = {subset: float(rng.normal()) for subset in subsets(PARTS)}
    added: dict[str, list[float]] = {part: [] for part in PARTS}
    for order in permutations(PARTS):
        for place, part in enumerate(order):
            added[part].append(value[frozenset(order[: place + 1])] - value[frozenset(order[:place])])
    found = shapley(PARTS, value)
    assert found == pytest.approx({part: np.mean(of) for part, of in added.items()})
    assert sum(found.values()) == pytest.approx(value[frozenset(PARTS)] - value[frozenset()])


def explanation(*losses: float) -> Explanation:
    """Losses with nothing of a, its camera, its vehicle, and both."""
    of_parts = dict(zip(subsets(("camera", "vehicle")), losses, strict=True))
    return Explanation(test_id="t", fails=SimulatorName("a"), against=SimulatorName("b"), losses=of_parts)


def test_the_sentence_says_what_is_the_cause_what_is_not_and_what_cures() -> None:
    found = explanation(0.5, 1.0, 0.5, 1.0)
    assert found.shares == {"camera": 1.0, "vehicle": 0.0}
    assert found.sentence == (
        "t fails on a because of the camera (1.00), not the vehicle. With the camera of b alone it completes there."
    )
    assert "the camera (0.50) and the vehicle (0.50)" in explanation(0.5, 0.5, 0.5, 1.0).sentence
    assert "the camera (0.70), partly the vehicle (0.30)" in explanation(0.5, 0.8, 0.6, 1.0).sentence
    assert "No single part of b makes it complete there." in explanation(0.5, 1.0, 1.0, 1.0).sentence
    for other in (explanation(0.5, 0.5, 0.5, 0.75), explanation(1.0, 1.0, 1.0, 1.0)):
        assert "do not repeat" in other.document()["sentence"] and not other.shares and not other.table().rows


def test_a_planted_delay_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]), prepend=os.pathsep)
    late = made_name("bullet", "late_commands", 0.6)
    folder = campaign(tmp_path / "c", [BULLET, SimulatorName(late)])
    assert "--trust" in refusal("explain", folder)
    (found,) = document("explain", folder, "--workers", 1, "--trust", late, "--out", tmp_path / "out")["tests"]
    assert (found["fails"], found["against"]) == (late, "bullet")
    assert found["shares"] == pytest.approx({"delays": 1.0, "vehicle": 0.0})
    assert found["sentence"].endswith("With the delays of bullet alone it completes there.")
    assert len(found["drives"]) == 4 and found["reason"]["simulator"] == late
    assert (tmp_path / "out" / "explanation.json").exists()


def test_conditions_are_removed_and_what_cannot_be_explained_is_said(tmp_path: Path) -> None:
    """The autopilot fails on bullet with commands 0.4 s late, and completes the same road without that."""
    folder = campaign(tmp_path / "c", [BULLET, SOFTBODY], Conditions(command_delay=0.4))
    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    experiment = experiment_on(data, "bullet-0-0000")
    assert list(experiment.parts) == ["camera", "look", "vehicle", "conditions"]
    name, test = experiment.drive(frozenset(("camera", "look", "vehicle")))
    run = driven(name, test.road, test.seed, test.conditions)
    assert test.test_id == "plain-bullet-0-0000" and run.outcome is Outcome.COMPLETED
    for wrong, why in (
        (("bullet-0-0007",), "has no test"),
        (("bullet-0-0000", "softbody"), "never fails on softbody: expected bullet"),
        (("bullet-0-0000", None, "bullet"), "never completes on bullet: expected softbody"),
    ):
        with pytest.raises(ConfigError, match=why):
            experiment_on(data, *wrong)


def test_the_command_refuses_in_one_line(tmp_path: Path) -> None:
    for wrong, why in ((("--sim", "bullet"), "give --test, too"), (("--engine", "graph"), "expected local or dask")):
        assert why in refusal("explain", tmp_path, *wrong)
