"""What a report's page draws by itself, as JSON values: maps, tests, and the lines of both packed cell by cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.maps.campaign_maps import cells_of
from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.maps.heatmap import title_of
from ds_orchestrator.report.plotly_figures import DASHES, colour_of_simulator
from ds_orchestrator.report.polyline_codec import EVERY, UNITS, kept, pack
from ds_orchestrator.search.features import Cell, feature_of
from ds_orchestrator.store.store import Execution, Test
from ds_sim.simulator import FRAME_RATE, Outcome


def in_words(outcome: Outcome) -> str:
    """`out of bounds`."""
    return outcome.name.lower().replace("_", " ")


def cells_by_test(config: CampaignConfig, tests: Sequence[Test], executions: Sequence[Execution]) -> dict[str, Cell]:
    """Cell by test over all features of the campaign."""
    return cells_of(tests, executions, features=config.features, maxitwo_compatible=config.maxitwo_compatible)


def page_data(
    config: CampaignConfig,
    maps: Mapping[str, FeatureMap],
    tests: Sequence[Test],
    executions: Sequence[Execution],
) -> dict[str, Any]:
    """Everything that the page draws by itself, without pictures and layouts.

    `tests` holds one list per test: name, sibling, run, number, seed, road, its length (m), curvature (1/m) and turns,
    number of its points, and one list per simulator, or None: outcome, whether it failed, fitness (m), largest lateral
    position (m), simulated seconds, number of its points, whether its steering is known, message. `lines` holds one
    packed text per entry of `places`; see `_lines`.
    """
    done = {(e.test_id, e.simulator): e for e in executions}
    cells = cells_by_test(config, tests, executions)
    groups: dict[Cell, list[int]] = {}
    for index, test in enumerate(tests):
        if test.test_id in cells:
            groups.setdefault(cells[test.test_id], []).append(index)
    places = sorted(groups)
    return {
        "simulators": [
            {
                "name": name,
                "role": "twin" if name == config.twin else f"sibling {index + 1}",
                "colour": colour_of_simulator(index),
                "dash": DASHES[index % len(DASHES)],
            }
            for index, name in enumerate(config.simulators)
        ],
        "axes": _axes(config, maps, places),
        "groups": _groups(config, maps),
        "maps": {name: _map(config, feature_map) for name, feature_map in maps.items()},
        "tests": [
            [
                test.test_id, config.siblings.index(test.sibling), test.run, test.number, test.seed, test.road.road_id,
                round(test.road.length, 1), round(test.road.curvature, 4), test.road.turns_count, len(test.road.points),
                [_run(done.get((test.test_id, name))) for name in config.simulators],
            ]
            for test in tests
        ],
        "places": [[list(place), groups[place]] for place in places],
        "lines": [_lines(config, [tests[index] for index in groups[place]], done) for place in places],
        "lane": round(tests[0].road.lane_width, 3) if tests else 4.0,
        "units": UNITS,
        "frame": EVERY / FRAME_RATE,
        "selected": _telling_cell(maps),
    }  # fmt: skip


def _axes(config: CampaignConfig, maps: Mapping[str, FeatureMap], places: Sequence[Cell]) -> list[dict[str, Any]]:
    """Title of every feature, the bins from the smallest to the largest one that is filled, and where each begins.

    `begins` has one more entry than there are bins: where the last one ends. `whole`: a bin is one whole number.
    """
    filled = {cell for feature_map in maps.values() for cell in feature_map.cells} | set(places)
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
                "whole": feature.title.endswith("count") and feature.width == 1,
            }
        )
    return axes


def _groups(config: CampaignConfig, maps: Mapping[str, FeatureMap]) -> dict[str, list[str]]:
    """Maps that stand side by side."""
    compared = [name for name in maps if name == "merged" or name.startswith(("union_", "twin_"))]
    merges = [name for name in maps if name.startswith("merged_")]
    return {
        "compared": compared,
        "merges": merges,
        "origins": [name for name in maps if name not in compared and name not in merges],
    }


def _map(config: CampaignConfig, feature_map: FeatureMap) -> dict[str, Any]:
    """One map; of a cell: bins, tests, failures or None, probability, its interval or None, lack of quality."""
    return {
        "title": title_of(feature_map.name),
        "about": about(config, feature_map.name),
        "cells": [
            [
                *cell, value.tests, value.failures, round(value.probability, 4),
                None if value.interval is None else [round(end, 4) for end in value.interval],
                round(value.quality_loss, 4),
            ]
            for cell, value in sorted(feature_map.cells.items())
        ],
    }  # fmt: skip


def about(config: CampaignConfig, name: str) -> str:
    """What a map of the campaign shows, one line for someone who sees it for the first time."""
    kind, _, rest = name.partition("_")
    if kind == "union":
        return f"Every test, whichever sibling's search found it, driven on {rest}."
    if kind == "twin":
        return f"The same tests on {rest}, which stands for the real car: what the siblings should foretell."
    if name == "merged":
        return (
            f"The siblings merged ({config.operators.probability} of their failure probabilities, "
            f"{config.operators.quality_loss} of their lack of quality): high only where they agree."
        )
    if kind == "merged":
        return f"The same, merged by {rest.replace('_', ' ')} instead."
    if kind == "search":
        return f"The tests that the search on {rest} made, driven on {rest} itself."
    origin, _, target = rest.partition("_to_")
    return f"The tests that the search on {origin} made, driven on {target}."


def _run(execution: Execution | None) -> list[Any] | None:
    if execution is None:
        return None
    points = len(kept(len(execution.trajectory) - 1)) if len(execution.trajectory) else 0
    return [
        in_words(execution.outcome), int(execution.outcome.is_failure), round(execution.fitness, 3),
        round(execution.max_lateral_position, 3), round(execution.simulated_seconds, 2), points,
        int(points > 0 and len(execution.steering) > 0), execution.message,
    ]  # fmt: skip


def _lines(config: CampaignConfig, tests: Sequence[Test], done: Mapping[tuple[str, str], Execution]) -> str:
    """The lines of all tests of a cell, one test after the other.

    Of each: x and y of the road's centre line and of its right edge (m), then of every drive x, y, lateral position
    (m), and steering where it is known.
    """
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


def _telling_cell(maps: Mapping[str, FeatureMap]) -> list[int] | None:
    """The cell to begin with: where failure is most probable by the merged map, or else by any map."""
    for candidates in ([maps["merged"]], list(maps.values())):
        cells = [(value.probability, value.quality_loss, cell) for m in candidates for cell, value in m.cells.items()]
        if cells:
            return list(max(cells)[2])
    return None
