# SPDX-License-Identifier: Apache-2.0
"""Data from which the report's script draws, as JSON values: maps, tests, and their lines packed cell by cell."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_analysis.paper.campaign_contents import IN_WORDS
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, compared_ids
from ds_orchestrator.search.features import FEET, Cell, Feature, base_of, feature_of
from ds_orchestrator.store.model import Execution, Test
from ds_report.findings import radius
from ds_report.plotly_figures import DASHES
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import SimulatorName, colours_of
from ds_sim.simulator import FRAME_RATE

UNITS = 100.0
"""Units per metre, or per full lock of the steering; chosen: a centimetre is less than a pixel of any picture."""
EVERY = 2
"""Every second frame of a drive is kept, and its last one; chosen: 10 Hz, 0.8 m at full speed."""
_FARTHEST = 2**24
"""Largest coordinate in units, 168 km; larger ones from a faulty simulator are clipped."""

Columns = Sequence[NDArray[np.float64]]


def kept(steps: int) -> NDArray[np.intp]:
    """Select the frames from 0 to `steps` that a report keeps."""
    return np.unique(np.append(np.arange(0, steps + 1, EVERY), steps))


def pack(columns: Columns) -> str:
    """Pack columns of finite numbers as base64 text.

    Format: zlib over the lowest bytes of all numbers, then the second, third and highest ones. The numbers are uint32:
    the second differences of one column after the other, in 1 / `UNITS`, n >= 0 as 2 n and n < 0 as -2 n - 1. Of smooth
    lines these are almost all 0 or 1, and take about three bits.
    """
    numbers = [np.empty(0, np.int64)]
    for column in columns:
        units = np.round(np.clip(UNITS * column, -_FARTHEST, _FARTHEST)).astype(np.int64)
        numbers.append(np.diff(np.diff(units, prepend=0), prepend=0))
    whole = np.concatenate(numbers)
    planes = np.where(whole >= 0, 2 * whole, -2 * whole - 1).astype("<u4").view(np.uint8).reshape(-1, 4).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


def page_data(data: CampaignData, maps: Mapping[MapId, FeatureMap]) -> dict[str, Any]:
    """Collect the data that the page's script draws, except pictures and layouts.

    `tests` holds one list per test: name, sibling, run, number, seed, road, its length (m), curvature (1/m) and turns,
    number of its points, and one list per simulator, or None: outcome, whether it failed, fitness (m), largest lateral
    position (m), simulated seconds, number of its points, whether its steering is known, message, bag. `lines` holds
    one packed text per entry of `places`; see `_lines`. `conditions` has a text for every test if any has conditions,
    `excluded` one per simulator for tests that are excluded somewhere.
    """
    config, tests, cells = data.config, data.tests, data.cells
    done = {(e.test_id, e.simulator): e for e in data.executions}
    groups: dict[Cell, list[int]] = {}
    for index, test in enumerate(tests):
        if test.test_id in cells:
            groups.setdefault(cells[test.test_id], []).append(index)
    places = sorted(groups)
    conditions = [format_conditions(test.conditions) for test in tests]
    return {
        **({"conditions": conditions} if any(conditions) else {}),
        **({"excluded": _excluded(data)} if data.excluded else {}),
        "simulators": simulator_rows(config),
        "axes": axes_of(config, {*places, *(cell for one in maps.values() for cell in one.cells)}),
        "groups": _groups(maps),
        "driver": str(config.driver),
        "maps": {map_id.name: _map(config, feature_map) for map_id, feature_map in maps.items()},
        "tests": [
            [
                test.test_id,
                config.siblings.index(test.sibling),
                test.run,
                test.number,
                test.seed,
                test.road.road_id,
                round(test.road.length, 1),
                round(test.road.curvature, 4),
                test.road.turns_count,
                len(test.road.points),
                [_run(done.get((test.test_id, name))) for name in config.simulators],
            ]
            for test in tests
        ],
        "places": [[list(place), groups[place]] for place in places],
        "lines": [_lines(config, [tests[index] for index in groups[place]], done) for place in places],
        "lane": round(tests[0].road.lane_width, 3) if tests else 4.0,
        **({"road": tests[0].road.lane_width} if tests and tests[0].road.lane == "single" else {}),
        "units": UNITS,
        "frame": EVERY / FRAME_RATE,
        "selected": _telling_cell(maps),
    }


def simulator_rows(config: CampaignConfig) -> list[dict[str, Any]]:
    """Name, role, colour and dash of every simulator."""
    colours = colours_of(config.simulators)
    return [
        {
            "name": name,
            "role": "twin" if name == config.twin else f"sibling {index + 1}",
            "colour": colours[name],
            "dash": DASHES[index % len(DASHES)],
        }
        for index, name in enumerate(config.simulators)
    ]


def _excluded(data: CampaignData) -> dict[str, list[str]]:
    """Test -> for every simulator why it is excluded there, or ""."""
    reasons: dict[str, list[str]] = {}
    for (test_id, simulator), gate in data.excluded.items():
        row = reasons.setdefault(test_id, [""] * len(data.config.simulators))
        row[data.config.simulators.index(simulator)] = f"{IN_WORDS[gate.state]}: {gate.message}"
    return dict(sorted(reasons.items()))


def axes_of(config: CampaignConfig, filled: Collection[Cell]) -> list[dict[str, Any]]:
    """Describe every axis: its title, and its bins from `low`, the smallest filled one, to the largest filled one.

    `begins` has the lower edges of these bins and, as one entry more, the upper edge of the last; `radii` has the same
    edges as radii of a bend, or is None. `whole`: each bin is a single whole number.
    """
    axes = []
    for k, name in enumerate(config.features):
        feature = feature_of(name)
        bins = [cell[k] for cell in filled] or [0]
        low, high = min(bins), max(bins)
        axes.append(
            {
                "title": feature.title,
                "low": low,
                "begins": [feature.label(bin_) for bin_ in range(low, high + 2)],
                "radii": _radii(feature, range(low, high + 2)),
                "whole": feature.title.endswith("count") and feature.bins.width == 1,
            }
        )
    return axes


def _radii(feature: Feature, bins: Sequence[int]) -> list[str] | None:
    """Write the radius at the lower edge of each bin, m, for features of a bend; None for other features."""
    if base_of(feature.name) == "curvature":
        return [radius(bin_ * feature.bins.width / feature.bins.per_unit) for bin_ in bins]
    if base_of(feature.name) == "minimum_radius":
        return [f"{bin_ * feature.bins.width / FEET:.1f} m" for bin_ in bins]
    return None


def _groups(maps: Iterable[MapId]) -> dict[str, list[str]]:
    """Group the maps that are shown side by side."""
    compared = compared_ids(maps)
    merges = [map_id for map_id in maps if map_id.kind == "merged" and map_id not in compared]
    origins = [map_id for map_id in maps if map_id.kind in ("search", "migration")]
    groups = {"compared": compared, "merges": merges, "origins": origins}
    return {group: [map_id.name for map_id in ids] for group, ids in groups.items()}


def _map(config: CampaignConfig, feature_map: FeatureMap) -> dict[str, Any]:
    """Describe one map; a cell is bins, tests, failures or None, probability, its interval or None, quality loss."""
    return {
        "title": feature_map.title,
        "about": about(config, feature_map.id),
        "cells": [
            [
                *cell,
                value.tests,
                value.failures,
                round(value.probability, 4),
                None if value.interval is None else [round(end, 4) for end in value.interval],
                round(value.quality_loss, 4),
            ]
            for cell, value in sorted(feature_map.cells.items())
        ],
    }


def about(config: CampaignConfig, map_id: MapId) -> str:
    """Explain in one line what a map of the campaign shows."""
    simulator, origin = map_id.simulator, map_id.origin
    of_tests = {
        "union": f"Every test, whichever sibling's search found it, driven on {simulator}.",
        "twin": f"The same tests on {simulator}, which stands for the real car: what the siblings should predict.",
        "search": f"The tests that the search on {simulator} generated, driven on {simulator} itself.",
        "migration": f"The tests that the search on {origin} generated, driven on {simulator}.",
    }
    if map_id.kind in of_tests:
        return of_tests[map_id.kind]
    if map_id.operator:
        return f"The same, merged by {map_id.operator.replace('_', ' ')} instead."
    return (
        f"The siblings merged ({config.operators.probability} of their failure probabilities, "
        f"{config.operators.quality_loss} of their quality losses): high only where they agree."
    )


def _run(execution: Execution | None) -> list[Any] | None:
    if execution is None:
        return None
    points = len(kept(len(execution.trajectory) - 1)) if len(execution.trajectory) else 0
    return [
        execution.outcome.words,
        int(execution.outcome.is_failure),
        round(execution.fitness, 3),
        round(execution.max_lateral_position, 3),
        round(execution.simulated_seconds, 2),
        points,
        int(points > 0 and len(execution.steering) > 0),
        execution.message,
        execution.bag,
    ]


def _lines(config: CampaignConfig, tests: Sequence[Test], done: Mapping[tuple[str, SimulatorName], Execution]) -> str:
    """Pack the lines of a cell's tests: the road's centre and right edge, each drive's x, y, lateral, and steering."""
    columns: list[NDArray[np.float64]] = []
    for test in tests:
        columns += [*test.road.points.T, *test.road.right_edge.T]
        for name in config.simulators:
            execution = done.get((test.test_id, name))
            if execution is None or not len(execution.trajectory):
                continue
            frames = kept(len(execution.trajectory) - 1)
            columns += [execution.trajectory[frames, k] for k in (0, 1, 4)]
            if len(execution.steering):
                columns.append(execution.steering[np.minimum(frames, len(execution.steering) - 1)])
    return pack(columns)


def _telling_cell(maps: Mapping[MapId, FeatureMap]) -> list[int] | None:
    """Choose the cell to show first: the highest failure probability of the merged map, or else of any map."""
    for candidates in ([maps[MapId.merged()]], list(maps.values())):
        cells = [(value.probability, value.quality_loss, cell) for m in candidates for cell, value in m.cells.items()]
        if cells:
            return list(max(cells)[2])
    return None
