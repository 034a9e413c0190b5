# SPDX-License-Identifier: Apache-2.0
"""What a campaign has done so far: its stages, roads with their outcomes, and bags."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ds_base.folder_files import StoreError
from ds_driver.control.command_habits import Habit, command_habits
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError
from ds_orchestrator.campaign.folder import STAGES, CampaignData, read_campaign, read_folder
from ds_orchestrator.maps.campaign_maps import elites_of
from ds_orchestrator.search.features import Cell, Feature, feature_of
from ds_orchestrator.store.store import Store
from ds_road.files import road_object
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Progress of one stage.

    Attributes:
        name: `search bullet, run 0`, `migration: bullet to softbody`, `twin: bullet to donkey`, `maps`, ...
        done: executions with a verdict and excluded tests, or 1 for a result that is up to date.
        expected: total when the stage is done; None while it is not known.
        failures: number of executions in which the driver failed; None for a result.
        excluded: number of tests by which no network can be judged there; they are done.
    """

    name: str
    done: int
    expected: int | None
    failures: int | None = None
    excluded: int = 0

    @property
    def state(self) -> str:
        """`done`, `begun` or `to do`."""
        if self.expected is not None and self.done >= self.expected:
            return "done"
        return "begun" if self.done else "to do"


Group = tuple[SimulatorName, int, SimulatorName]
"""Sibling and run of the search that generated tests, and a simulator."""


def stages_of(data: CampaignData) -> list[Stage]:
    """List every stage of a campaign that was read, in the order in which they run."""
    config, of_test = data.config, {test.test_id: test for test in data.tests}

    def group(test_id: str, simulator: SimulatorName) -> Group:
        return of_test[test_id].sibling, of_test[test_id].run, simulator

    searched, migrated = len(of_test) == config.tests, set(of_test)
    if config.elites_only:
        migrated = elites_of(data.tests, data.verdicts, data.cells, ignored=data.given_up)
        own = {
            test_id for test_id, simulator in (*data.failed, *data.excluded) if of_test[test_id].sibling == simulator
        }
        searched = searched and set(of_test) <= own | data.given_up
    return _stages(
        config,
        drives=Counter((group(*key), failed) for key, failed in data.failed.items()),
        excluded=Counter(group(*key) for key in data.excluded),
        migrating=Counter(of_test[test_id].sibling for test_id in migrated) if searched else None,
        results=data.results,
        result_count=data.result_count,
    )


def stages_of_store(store: Store, config: CampaignConfig) -> list[Stage]:
    """List the same, counted by SQLite where no cell of a test is needed: in memory that no campaign's size decides."""
    if config.elites_only:
        return stages_of(read_campaign(store))
    tests, drives = store.count_tests_by_sibling(), Counter[tuple[Group, bool]]()
    for row in store.drive_counts():
        drives[(row.sibling, row.run, row.simulator), Outcome[row.outcome].is_failure] += row.executions
    return _stages(
        config,
        drives=drives,
        excluded=store.count_excluded(),
        migrating=tests if tests.total() == config.tests else None,
        results=store.results(),
        result_count=store.count_results(),
    )


def _stages(
    config: CampaignConfig,
    *,
    drives: Counter[tuple[Group, bool]],
    excluded: Counter[Group],
    migrating: Counter[SimulatorName] | None,
    results: Mapping[str, int],
    result_count: int,
) -> list[Stage]:
    """Stages, given drives that failed or not, exclusions, and how many tests migrate, None while searches run."""
    runs = range(config.search.runs)

    def stage(name: str, groups: Sequence[Group], expected: int | None) -> Stage:
        failures, passes = (sum(drives[group, failed] for group in groups) for failed in (True, False))
        without = sum(excluded[group] for group in groups)
        done = failures + passes + without
        return Stage(name=name, done=done, expected=expected, failures=failures, excluded=without)

    stages = [
        stage(f"search {sibling}, run {run}", [(sibling, run, sibling)], config.settings.budget)
        for sibling in config.siblings
        for run in runs
    ]
    for target in config.simulators:
        role = "twin" if target == config.twin else "migration"
        for origin in config.siblings:
            if origin != target:
                groups = [(origin, run, target) for run in runs]
                expected = None if migrating is None else migrating[origin]
                stages.append(stage(f"{role}: {origin} to {target}", groups, expected))
    up_to_date = ((name, results.get(name) == result_count) for name in STAGES)
    return [*stages, *(Stage(name=name, done=int(done), expected=1) for name, done in up_to_date)]


DRIVES_SAMPLED = 24
"""Drives that are decoded to look at a driver's commands; chosen: they take 20 ms, and every drive shows a habit."""


def driver_habits(store: Store) -> tuple[Habit, ...]:
    """Find what is unusual in a campaign's commands, in a bounded sample of its drives; nothing if one is damaged."""
    try:
        drives = [one.drive for one in store.sampled_executions(DRIVES_SAMPLED)]
        steering = [np.empty(0), *(one.steering for one in drives)]
        speeds = [np.empty(0), *(one.trajectory[:, 3] for one in drives)]
    except StoreError:
        return ()  # what reads all drives says so
    return command_habits(np.concatenate(steering), np.concatenate(speeds))


def is_driven(store: Store, config: CampaignConfig) -> bool:
    """Check whether every driving stage is done, so that resuming the campaign needs no graph."""
    return all(one.state == "done" for one in stages_of_store(store, config) if one.failures is not None)


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
    axes of `ds maps` or the bins of `ds maps --json`, such as `3,0.17` or `3,17`. ConfigError if the campaign has no
    such simulator, cell or test.

    They are as `ds_road.road_from_json` takes them, in the order of the store, with `test_id`, `seed`, `cell` (bin by
    feature) and `outcomes` (by simulator); with `conditions` as text where they are not the default, and `excluded`
    (state by simulator) where no network can be judged by the test.
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
