# SPDX-License-Identifier: Apache-2.0
"""The demo: one road in fog, what else breaks the network, and a campaign under the conditions that do.

Every constant but `MOST_SEARCHED` was chosen before a result was seen. A stopped demo goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ds_analysis.sensitivity import Sensitivity, factors_named, ranges_of
from ds_base.bounded_file import read_json
from ds_base.folder_files import make_folder, write_json
from ds_base.progress import Progress
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.engine import DriveSettings
from ds_road.generation import generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import conditions_in_words
from ds_sim.registry import SimulatorName, make_simulator, with_libraries
from ds_sim.session import resimulate
from ds_sim.simulator import Outcome
from ds_sim.video import write_together
from ds_studies.sensitivity import Watch, analyse_sensitivity

DRIVER = DriverName("dave2")
TWIN = SimulatorName("donkey")
SIBLINGS = tuple(map(SimulatorName, ("bullet", "softbody", "panda")))
"""The fastest first: the demo takes two of those whose libraries are there, or one."""
ROAD_SEED, MAX_ANGLE = 3, 200
"""Of the one road; chosen: that of the README's picture."""
FOG = (80.0, 40.0, 20.0)
"""Visibilities that are tried one after the other, m; chosen: from fog to the densest that conditions know."""
FACTORS = ("line_cover", "illuminance", "veiling_luminance", "visibility", "command_delay")
"""What might break it; chosen: one each of worn lines, night, glare, fog, and a slow car."""
ROADS, SEED = 1, 1
"""Of the sensitivity: short roads, and seed."""
LEVELS, FEWER_LEVELS, SLOW = 4, 2, 100.0
"""Levels of strength, and how many on a processor that drives fewer frames a second than this in fog on the twin."""
SEARCH = {"population": 3, "iterations": 2, "runs": 1, "min_angle": 150}
"""Of the campaign, with mostly winding roads; chosen: 10 tests, 30 drives."""
MOST_SEARCHED = 1
"""Conditions that it varies; chosen: with the two most sensitive ones at once 18 of 20 tests failed."""


def drive_into_fog(folder: Path) -> dict[str, Any]:
    """Drive one road on the twin in clear air, then in denser and denser fog until the network leaves its lane.

    The folder receives the video `fog.mp4`, and `fog.json` with what is returned: `completes_clear`; `leaves_at`, a
    visibility in m, or None; `levels` of strength that suit this processor; `siblings` that can drive here. If they are
    there already, nothing is driven.
    """
    result = folder / "fog.json"
    if result.is_file() and (folder / "fog.mp4").is_file():
        earlier = dict(read_json(result))
        return earlier | {"siblings": [*map(SimulatorName, earlier["siblings"])]}
    road = generate(np.random.default_rng(ROAD_SEED), max_angle=MAX_ANGLE)
    seconds, frames = 0.0, 0
    with closing(make_simulator(TWIN)) as simulator:
        drive = partial(drive_road, simulator, make_driver(DRIVER, simulator.spec), road, ROAD_SEED)
        clear = run = drive(DEFAULT)  # not timed: the first drive compiles the car
        for visibility in FOG if clear.outcome is Outcome.COMPLETED else ():
            begin = time.process_time()
            run = drive(Conditions(visibility=visibility))
            seconds, frames = seconds + time.process_time() - begin, frames + run.steps
            if run.outcome.is_failure:
                break
    left = run is not clear and run.outcome.is_failure
    document = {
        "driver": str(DRIVER),
        "simulator": TWIN,
        "road_id": road.road_id,
        "completes_clear": clear.outcome is Outcome.COMPLETED,
        "leaves_at": run.conditions.visibility if left else None,
        "tried": list(FOG),
        "levels": FEWER_LEVELS if frames < SLOW * seconds else LEVELS,
        "siblings": with_libraries(SIBLINGS)[0][:2],
    }
    films = [("clear", clear), (f"fog: {run.conditions.visibility:g} m", run)]
    write_together(folder / "fog.mp4", [(title, one, resimulate(TWIN, one)) for title, one in films])
    write_json(result, document)
    return document


def fog_in_words(fog: dict[str, Any]) -> str:
    """What `drive_into_fog` found, in one sentence."""
    who = f"{fog['driver']} on {fog['simulator']}"
    if not fog["completes_clear"]:
        return f"{who} leaves the lane in clear weather already."
    if fog["leaves_at"] is None:
        return f"{who} completes in clear weather, and in fog down to a visibility of {min(fog['tried']):g} m."
    return f"{who} completes in clear weather; leaves the lane at a visibility of {fog['leaves_at']:g} m."


def measure_sensitivity(
    fog: dict[str, Any], folder: Path, workers: int, *, progress: Progress, watch: Watch
) -> Sensitivity:
    """Find what breaks the network, on as many siblings and levels as `drive_into_fog` says this machine can do."""
    make_folder(folder)
    siblings = tuple(fog["siblings"])
    settings = DriveSettings(siblings=siblings, twin=TWIN, driver=DRIVER, engine="local", workers=workers)
    return analyse_sensitivity(
        settings,
        factors_named(FACTORS),
        roads=ROADS,
        levels=fog["levels"],
        seed=SEED,
        folder=folder / "drives",
        progress=progress,
        watch=watch,
    )


Ranges = Mapping[str, tuple[float, float]]
"""Condition -> smallest and largest value to search."""


def searched(sensitivity: Sensitivity) -> Ranges:
    """Range of the most sensitive condition, as a new campaign takes it."""
    return dict(islice(ranges_of(sensitivity.document()).items(), MOST_SEARCHED))


def searched_in_words(ranges: Ranges) -> str:
    """Ranges for a terminal: `in fog or haze with a visibility of 40 to 1000 m (visibility)`."""
    return ", ".join(conditions_in_words(name, low, high) for name, (low, high) in ranges.items())


def campaign_config(ranges: Ranges, siblings: Sequence[SimulatorName]) -> CampaignConfig:
    """Campaign of the demo, which searches on the siblings."""
    conditions = {name: {"low": low, "high": high} for name, (low, high) in ranges.items()}
    search = {**SEARCH, "conditions": conditions}
    return parse_config({"siblings": list(siblings), "twin": TWIN, "driver": DRIVER, "search": search}, "the demo")
