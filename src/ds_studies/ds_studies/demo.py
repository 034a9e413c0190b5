"""The demo: one road in fog, what else breaks the network, and a campaign under the conditions that do.

Every constant was chosen before a result was seen. A stopped demo goes on where it was.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.whole_files import write_json
from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.store.folder_files import make_folder
from ds_road import Road
from ds_road.generation import generate
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions
from ds_sim.registry import make_simulator
from ds_sim.resimulation import resimulate
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome
from ds_sim.video import write_together
from ds_studies.sensitivity.analysis import Progress, Sensitivity, analyse_sensitivity
from ds_studies.sensitivity.factors import LEVELS, factors_named
from ds_studies.sensitivity.page import SensitivityPage

DRIVER = "dave2"
SIMULATORS, SIBLINGS, TWIN = ("bullet", "softbody", "panda"), ("bullet", "panda"), "donkey"
"""Siblings whose sensitivity is measured; those that search; the twin."""
ROAD_SEED, MAX_ANGLE = 3, 200
"""Of the one road; chosen: that of the README's picture."""
FOG = (160.0, 80.0, 40.0, 20.0)
"""Visibilities that are tried one after the other, m; chosen: from haze to the densest fog that conditions know."""
FACTORS = (
    "line_contrast", "line_cover", "illuminance", "veiling_luminance", "visibility", "lens_dirt", "steering_lag",
    "command_delay",
)  # fmt: skip
"""What might break it; chosen: worn and covered lines, night, glare, fog, dirt, and a slow car."""
ROADS, STEPS, SEED = 1, 4, 1
"""Of the sensitivity: short roads, levels of strength, seed."""
MOST_SEARCHED = 2
"""Conditions that the campaign varies; chosen: the axes of one map."""
SEARCH = {"population": 4, "iterations": 6, "runs": 1, "min_angle": 150}
"""Of the campaign, with mostly winding roads; chosen: 20 tests, 60 drives, in two minutes on two cores."""
MILDEST = {"visibility": 1000.0}
"""Mild end of a range, where the simulator's own world has none; chosen: the upper limit of fog (WMO-No. 8)."""


def drive_into_fog(folder: Path) -> dict[str, Any]:
    """Drive one road on the twin in clear air, then in denser and denser fog until the network leaves its lane.

    Args:
        folder: receives `fog.json` and the video `fog.mp4`; if they are there already, nothing is driven.

    Returns:
        Content of the file: `completes_clear`, and `leaves_at`, the visibility in m, or None.
    """
    result = folder / "fog.json"
    if result.is_file() and (folder / "fog.mp4").is_file():
        known: dict[str, Any] = json.loads(result.read_text("utf-8"))
        return known
    simulator = make_simulator(TWIN)
    driver, road = make_driver(DRIVER, simulator.spec), _road()

    def drive(conditions: Conditions) -> RunRecord:
        return drive_road(simulator, driver, road, ROAD_SEED, conditions)

    try:
        clear = run = drive(DEFAULT)
        for visibility in FOG if clear.outcome is Outcome.COMPLETED else ():
            run = drive(Conditions(visibility=visibility))
            if run.outcome.is_failure:
                break
    finally:
        simulator.close()
    left = run is not clear and run.outcome.is_failure
    document = {
        "driver": DRIVER,
        "simulator": TWIN,
        "road_id": road.road_id,
        "completes_clear": clear.outcome is Outcome.COMPLETED,
        "leaves_at": run.conditions.visibility if left else None,
        "tried": list(FOG),
    }
    films = [("clear", clear), (f"fog: {run.conditions.visibility:g} m", run)]
    write_together(folder / "fog.mp4", [(title, one, resimulate(TWIN, one)) for title, one in films])
    write_json(result, document)
    return document


def fog_in_words(found: dict[str, Any]) -> str:
    """What `drive_into_fog` found, in one sentence."""
    who = f"{found['driver']} on {found['simulator']}"
    if not found["completes_clear"]:
        return f"{who} leaves the lane in clear weather already."
    if found["leaves_at"] is None:
        return f"{who} completes in clear weather, and in fog down to a visibility of {min(found['tried']):g} m."
    return f"{who} completes in clear weather; leaves the lane at a visibility of {found['leaves_at']:g} m."


def measure_sensitivity(folder: Path, workers: int, *, progress: Progress, say: Callable[[str], None]) -> Sensitivity:
    """Find what breaks the network on the siblings and the twin; `sensitivity.html` in the folder shows it live."""
    make_folder(folder)
    settings = DriveSettings(siblings=SIMULATORS, twin=TWIN, driver=DRIVER, engine="local", workers=workers)
    page = SensitivityPage(folder / "sensitivity.html")
    return analyse_sensitivity(
        settings,
        factors_named(FACTORS),
        roads=ROADS,
        levels=STEPS,
        seed=SEED,
        folder=folder / "drives",
        progress=progress,
        watch=page.write,
        say=say,
    )


def ranges_of(found: Sensitivity) -> dict[str, dict[str, float]]:
    """Ranges for a search: for the most sensitive conditions, from mild to where half of the simulators fail."""
    ranges: dict[str, dict[str, float]] = {}
    for position in found.order:
        factor = found.factors[position]
        levels = [one.fails if one.verdict == "fails" else None for one in _row(found, position)]
        level = sorted(LEVELS + 1 if one is None else one for one in levels)[(len(levels) - 1) // 2]
        if level > LEVELS or len(ranges) == MOST_SEARCHED:
            continue
        mild, hard = MILDEST.get(factor.name, factor.start), factor.value(level)
        ranges[factor.name] = {"low": min(mild, hard), "high": max(mild, hard)}
    return ranges


def _row(found: Sensitivity, position: int) -> list[Any]:
    return [found.thresholds[position, name] for name in found.simulators]


def campaign_config(ranges: dict[str, dict[str, float]]) -> CampaignConfig:
    """Campaign of the demo, whose conditions come from the sensitivity."""
    document = {
        "siblings": list(SIBLINGS), "twin": TWIN, "driver": DRIVER,
        "search": {**SEARCH, "conditions": ranges},
    }  # fmt: skip
    return parse_config(document, "the demo")


def searched_in_words(ranges: dict[str, dict[str, float]]) -> str:
    """Ranges of a search for a terminal: `visibility 80 to 1000 m`."""
    return ", ".join(
        f"{name} {one['low']:.3g} to {one['high']:g}{' ' + FIELDS[name].unit if FIELDS[name].unit else ''}"
        for name, one in ranges.items()
    )


def _road() -> Road:
    return generate(np.random.default_rng(ROAD_SEED), max_angle=MAX_ANGLE)
