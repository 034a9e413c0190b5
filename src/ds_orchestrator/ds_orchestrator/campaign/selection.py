# SPDX-License-Identifier: Apache-2.0
"""Selects roads of a campaign, and finds its missing bags."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.folder import read_folder
from ds_orchestrator.search.features import Cell, Feature, feature_of
from ds_road.files import road_object
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import SimulatorName


def roads_of(
    folder: Path,
    *,
    failed: bool = False,
    simulator: SimulatorName | None = None,
    cell: str | None = None,
    test: str | None = None,
) -> list[dict[str, Any]]:
    """Select roads of a campaign: of one test, of those driven on a simulator, or of one cell.

    `failed` keeps those on which the driver failed, on any simulator or on the one given. A cell is named as by the
    axes of `ds maps` or the bins of `ds maps --json`, such as `3,0.17` or `3,17`.

    Returns:
        Roads as `ds_road.road_from_json` takes them, with `test_id`, `seed`, `cell` (bin by feature) and `outcomes`
        (outcome by simulator) beside the control points, in the order of the store; with `conditions` as text where
        they are not the default, and `excluded` (state by simulator) where no network can be judged by the test.

    Raises:
        ConfigError: the campaign has no such simulator, cell or test.
    """
    data = read_folder(folder)
    config, tests, cells = data.config, data.tests, data.cells
    if simulator is not None and simulator not in config.simulators:
        raise ConfigError(f"{folder} has no simulator {simulator!r}: expected one of {', '.join(config.simulators)}")
    if test is not None and test not in {t.test_id for t in tests}:
        examples = ", ".join(t.test_id for t in tests[:2]) or "(it has no tests yet)"
        raise ConfigError(f"{folder} has no test {test!r}: expected an id such as {examples}")
    wanted = None if cell is None else _cell_named(cell, [feature_of(name) for name in config.features], cells)
    outcomes: dict[str, dict[SimulatorName, str]] = defaultdict(dict)
    for execution in data.executions:
        outcomes[execution.test_id][execution.simulator] = execution.outcome.name
    excluded: dict[str, dict[SimulatorName, str]] = defaultdict(dict)
    for (test_id, name), gate in data.excluded.items():
        excluded[test_id][name] = gate.state.value
    roads = []
    for one in tests:
        driven = outcomes[one.test_id]
        counted = [simulator] if simulator is not None else list(driven)
        if (
            (test is not None and one.test_id != test)
            or (wanted is not None and cells.get(one.test_id) != wanted)
            or (simulator is not None and simulator not in driven)
            or (failed and not any(data.failed.get((one.test_id, name)) for name in counted))
        ):
            continue
        roads.append(
            {
                **road_object(one.road),
                "test_id": one.test_id,
                "seed": one.seed,
                "cell": dict(zip(config.features, cells[one.test_id], strict=True)) if one.test_id in cells else None,
                "outcomes": dict(sorted(driven.items())),
                **({} if one.conditions.is_default else {"conditions": format_conditions(one.conditions)}),
                **({"excluded": excluded[one.test_id]} if one.test_id in excluded else {}),
            }
        )
    return roads


def _cell_named(text: str, features: Sequence[Feature], cells: Mapping[str, Cell]) -> Cell:
    """The filled cell that a text names, by the labels of the axes or by bins."""
    parts = [part.strip() for part in text.split(",")]
    filled = sorted(set(cells.values()))

    def labels(cell: Cell) -> list[str]:
        return [feature.label(bin_) for feature, bin_ in zip(features, cell, strict=True)]

    for named in (labels, lambda cell: [str(bin_) for bin_ in cell]):
        for cell in filled:
            if parts == named(cell):
                return cell
    axes = ",".join(feature.name for feature in features)
    some = "; ".join(",".join(labels(cell)) for cell in filled[:6])
    raise ConfigError(
        f"no road in cell {text!r}: expected {axes} of a filled cell, such as {some or '(no cell is filled yet)'}"
        + ("; ..." if len(filled) > 6 else "")
    )


def missing_bags(campaign: Path, bags: Iterable[str]) -> list[str]:
    """List recorded bags that no longer exist, relative to the campaign folder."""
    return sorted(bag for bag in bags if bag and not (campaign / bag / "metadata.yaml").is_file())
