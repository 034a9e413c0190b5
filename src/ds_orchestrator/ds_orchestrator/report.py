"""The report of a campaign: one HTML file that opens offline and shows what was found, and how."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray
from shapely import LineString

from ds_driver.control import Autopilot
from ds_orchestrator.config import CampaignConfig
from ds_orchestrator.evaluation import Correlation
from ds_orchestrator.features import Cell, feature_of
from ds_orchestrator.findings import count, summarise
from ds_orchestrator.maps import FeatureMap, cells_of
from ds_orchestrator.pictures import VALUE_TITLES, bounds_of, colour_of, ink_on, png, title_of
from ds_orchestrator.store import Execution, Store, Test
from ds_road import Road
from ds_road.picture import PALETTE
from ds_sim.registry import make_simulator
from ds_sim.simulator import Observation, Outcome, Simulator

CAMERA_PLACE = 45.0
"""m along the lane where the cameras' pictures are taken; chosen: past the start, a third of a usual road."""
TOLERANCE = 0.05
"""m by which a line that was thinned may differ; chosen: a fortieth of half a lane, below what the screen shows."""
_VERDICTS = [outcome for outcome in Outcome if outcome.is_verdict]
_CAMERA_STEPS = 600
_SHOWN_ERRORS = 200


def write_report(
    folder: Path,
    store: Store,
    config: CampaignConfig,
    maps: Mapping[str, FeatureMap],
    correlations: Sequence[Correlation],
) -> Path:
    """Write `report.html`; the same store gives the same bytes.

    Args:
        folder: of the campaign.
        store: what was done, finished or not.
        config: as run.
        maps: as `ds_orchestrator.maps.campaign_maps` makes and names them.
        correlations: with the twin, empty without one.

    Returns:
        The path of the report.
    """
    tests, executions = store.tests(), store.executions()
    notes = store.notes()
    place = _common_test(tests, executions)
    page = _environment().get_template("report.html.j2")
    text = page.render(
        config=config,
        config_yaml=yaml.safe_dump(config.model_dump(), sort_keys=False, allow_unicode=True),
        findings=summarise(config, maps, correlations, executions, tests=len(tests)),
        cameras=camera_pictures(config.simulators, place) if place else [],
        camera_test=place,
        camera_cell=_cells(config, tests, executions).get(place.test_id, ()) if place else (),
        camera_place=CAMERA_PLACE,
        data=page_data(config, maps, tests, executions),
        correlations=correlations,
        value_titles=VALUE_TITLES,
        outcomes=_outcome_table(config, executions),
        verdicts=_VERDICTS,
        versions={k.removeprefix("version "): v for k, v in notes.items() if k.startswith("version ")},
        notes={k: v for k, v in notes.items() if k != "config" and not k.startswith("version ")},
        tests=len(tests),
        simulated_seconds=sum(e.simulated_seconds for e in executions),
        errors=store.errors(),
        shown_errors=_SHOWN_ERRORS,
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("ds_orchestrator"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters["count"] = count
    environment.filters["title_of"] = title_of
    environment.filters["in_words"] = in_words
    return environment


def in_words(outcome: Outcome) -> str:
    """`out of bounds`."""
    return outcome.name.lower().replace("_", " ")


def page_data(
    config: CampaignConfig,
    maps: Mapping[str, FeatureMap],
    tests: Sequence[Test],
    executions: Sequence[Execution],
) -> dict[str, Any]:
    """Everything that the page draws by itself, as JSON values; lengths in cm, lines as `_line` has them."""
    bounds = bounds_of(maps.values())
    done = {(e.test_id, e.simulator): e for e in executions}
    cells = _cells(config, tests, executions)
    compared = [name for name in maps if name == "merged" or name.startswith(("union_", "twin_"))]
    scale = [colour_of(percent / 100) for percent in range(101)]
    return {
        "simulators": [
            {
                "name": name,
                "role": "twin" if name == config.twin else f"sibling {index + 1}",
                "colour": _hex(PALETTE[index % len(PALETTE)]),
            }
            for index, name in enumerate(config.simulators)
        ],
        "turns": bounds.turns,
        "curvature": bounds.curvature,
        "axes": [
            {"title": axis.title, "unit": axis.unit, "width": axis.width}
            for axis in map(feature_of, config.features[:2])
        ],
        "scale": [[_hex(colour), _hex(ink_on(colour))] for colour in scale],
        "values": VALUE_TITLES,
        "compared": compared,
        "origins": [name for name in maps if name not in compared],
        "maps": {
            name: {
                "title": title_of(name),
                "cells": [
                    [*cell, value.tests, value.failures, round(value.probability, 4), round(value.quality, 4)]
                    for cell, value in sorted(feature_map.cells.items())
                ],
            }
            for name, feature_map in maps.items()
        },
        "roads": {test.road.road_id: _road(test.road) for test in tests},
        "tests": [
            {
                "id": test.test_id,
                "sibling": test.sibling,
                "run": test.run,
                "number": test.number,
                "seed": test.seed,
                "road": test.road.road_id,
                "cell": list(cells.get(test.test_id, ())),
                "runs": [
                    _run(execution, test.road) if (execution := done.get((test.test_id, name))) else None
                    for name in config.simulators
                ],
            }
            for test in tests
        ],
        "selected": _telling_cell(maps),
    }


def _cells(config: CampaignConfig, tests: Sequence[Test], executions: Sequence[Execution]) -> dict[str, Cell]:
    """Cell by test over the two features that a page can show."""
    plan = config.map_plan()
    return cells_of(tests, executions, features=plan.features[:2], published=plan.published)


@dataclass(frozen=True, kw_only=True)
class CameraPicture:
    """What one simulator's camera sees.

    Attributes:
        simulator: its name.
        physics: one line on its physics model, or "".
        picture: PNG as data URI, or "" if there is none.
        note: where the vehicle is, or why there is no picture.
    """

    simulator: str
    physics: str = ""
    picture: str = ""
    note: str


def camera_pictures(names: Sequence[str], test: Test) -> list[CameraPicture]:
    """The same place of the same road as every simulator shows it, with the autopilot at the wheel."""
    return [_camera_picture(name, test) for name in names]


def _camera_picture(name: str, test: Test) -> CameraPicture:
    try:
        simulator = make_simulator(name)
        try:
            seen = _drive_to(simulator, test, CAMERA_PLACE)
            physics = simulator.spec.physics
        finally:
            simulator.close()
    except Exception as error:  # a simulator that is not installed or breaks must not cost the report
        return CameraPicture(simulator=name, note=f"no picture: {' '.join(str(error).split())}")
    note = (
        f"{seen.lane.arc_length:.1f} m along the lane, {abs(seen.lane.lateral_position):.2f} m to the "
        f"{'right' if seen.lane.lateral_position >= 0 else 'left'} of its centre, {3.6 * seen.vehicle.speed:.0f} km/h"
    )
    if seen.lane.arc_length < CAMERA_PLACE:
        note += f"; the autopilot got no further ({in_words(seen.outcome)})"
    picture = f"data:image/png;base64,{base64.b64encode(png(seen.image)).decode()}"
    return CameraPicture(simulator=name, physics=physics, picture=picture, note=note)


def _drive_to(simulator: Simulator, test: Test, place: float) -> Observation:
    """The first observation at a place of the lane, or the last one before it."""
    seen = simulator.load(test.road, seed=test.seed)
    autopilot = Autopilot(simulator.spec.autopilot)
    for _ in range(_CAMERA_STEPS):
        if seen.lane.arc_length >= place or seen.outcome is not Outcome.RUNNING:
            break
        seen = simulator.step(autopilot.command(seen.lane.preview_lateral_position, seen.vehicle.speed))
    return seen


def _common_test(tests: Sequence[Test], executions: Sequence[Execution]) -> Test | None:
    """The test that was completed on most simulators; the first one among equals."""
    completed = Counter(e.test_id for e in executions if e.outcome is Outcome.COMPLETED)
    return max(tests, key=lambda test: completed[test.test_id], default=None)


def _telling_cell(maps: Mapping[str, FeatureMap]) -> Cell | None:
    """The cell to begin with: where failure is most probable by the merged map, or else by any map."""
    for candidates in ([maps["merged"]], list(maps.values())):
        cells = [(value.probability, value.tests, cell) for m in candidates for cell, value in m.cells.items()]
        if cells:
            return max(cells)[2]
    return None


def _outcome_table(config: CampaignConfig, executions: Sequence[Execution]) -> list[dict[str, Any]]:
    """One row per simulator."""
    rows = []
    for name in config.simulators:
        mine = [e for e in executions if e.simulator == name and e.outcome.is_verdict]
        rows.append(
            {
                "simulator": name,
                "role": "twin" if name == config.twin else "sibling",
                "tests": len(mine),
                "counts": Counter(e.outcome for e in mine),
                "failed": sum(e.outcome.is_failure for e in mine),
                "max_lateral_position": float(np.mean([e.max_lateral_position for e in mine])) if mine else None,
                "seconds": sum(e.simulated_seconds for e in mine),
            }
        )
    return rows


def _road(road: Road) -> dict[str, Any]:
    lines = {"left": road.left_edge, "right": road.right_edge, "centre": road.points}
    return {
        **{name: _line(points) for name, points in lines.items()},
        "length": round(road.length, 1),
        "curvature": round(road.curvature, 4),
        "turns": road.turns_count,
        "halfLane": round(100 * road.lane_width / 2),
    }


def _run(execution: Execution, road: Road) -> dict[str, Any]:
    """A run as the page draws it: the path, the lateral position over the distance driven, and where it failed."""
    path, lateral = execution.trajectory[:, :2], execution.trajectory[:, 4]
    distance = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))[: len(path)]
    run: dict[str, Any] = {
        "outcome": in_words(execution.outcome),
        "failed": execution.outcome.is_failure,
        "fitness": round(execution.fitness, 4),
        "maxLateral": round(execution.max_lateral_position, 4),
        "seconds": round(execution.simulated_seconds, 2),
        "message": execution.message,
        "path": _line(path),
        "lateral": _line(np.stack((distance, lateral), axis=1)),
    }
    if execution.outcome.is_failure and len(path):
        outside = np.flatnonzero(np.abs(lateral) > road.lane_width / 2)
        at = int(outside[0]) if len(outside) else len(path) - 1
        run["failedAt"] = [round(100 * float(v)) for v in (*path[at], distance[at], lateral[at])]
    return run


def _line(points: NDArray[np.float64]) -> list[int]:
    """A line thinned within `TOLERANCE`: x and y of its first point in cm, then the steps from point to point."""
    if len(points) > 2:
        points = np.array(LineString(points).simplify(TOLERANCE, preserve_topology=False).coords)
    centimetres = np.round(100 * points).astype(np.int64)
    steps = np.diff(centimetres, axis=0, prepend=np.zeros((1, 2), np.int64))
    return [int(v) for v in steps.ravel()]


def _hex(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
