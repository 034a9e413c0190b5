# SPDX-License-Identifier: Apache-2.0
"""Do simulators agree less about drivers with memory? One network of each kind, the same tests, every simulator.

`python -m benchmarks.memory_study --out study` drives what is missing, keeps it, and computes the tables. A drive takes
some 2 s: 1,600 drives, an hour on one core.
`--sims bullet,softbody,panda,donkey,torcs` adds a simulator to the same tests, as was done after the study.

Fixed before the first drive: `TESTS` random roads, once as they are and once under mild conditions (the ranges of
`conditions_mild.yaml`, from EN 1436 and the Highway Code); the networks of `examples/networks_of_today.py`, one
training each, on the same data; and these statistics.

- Primary: *agreement* of a network is the mean, over the six pairs of simulators, of Spearman's correlation of the
  largest lateral positions over the tests. The contrast is the mean agreement of kinds with memory minus that of kinds
  without; its 95% interval resamples roads, the same for all networks (2,000 resamples). It is about these networks:
  one training of a kind does not separate the kind from the training.
- Secondary: failures; share of tests on which the simulators do not all say the same; nesting of failures; residual
  correlations beyond features; how each leaves the lane.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from ds_analysis.common.driven_road import DrivenRoad
from ds_analysis.common.outcome_table import RoadTable, table_of_runs
from ds_analysis.common.statistics import Array, Indices
from ds_analysis.siblings.analysis import analyse, analysis_tables
from ds_base.table import Table, Value, styled, write_tables
from ds_cli.output import say
from ds_cli.progress import ScreenListener
from ds_driver.data.collection import unseen_roads
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks, Key, drive_tests
from ds_orchestrator.search.algorithms import ConditionSpace, SearchedCondition
from ds_orchestrator.store.model import Test
from ds_sim.conditions.model import DEFAULT
from ds_sim.gates.gate import Gate
from ds_sim.registry import STANDARD, SimulatorName
from ds_sim.scenario import Scenario
from ds_studies.same_roads import driven_road

Runs = dict[SimulatorName, list[DrivenRoad | None]]
"""Simulator -> its drives in the tests' order; None for one that is not there."""
KINDS = {"convolutional": False, "residual": False, "transformer": False, "stacked": True, "recurrent": True}
"""Network -> whether it has memory."""
CONDITIONS = {"line_contrast": {"low": 0.4, "high": 1.0}, "visibility": {"low": 100.0, "high": 1000.0}}
TESTS, SEED, RESAMPLES = 40, 3600, 2000


def draw_tests(conditions: bool) -> list[Test]:
    """Draw the tests; the roads are the same with and without conditions."""
    space = ConditionSpace([SearchedCondition(name=name, **ends) for name, ends in CONDITIONS.items()])
    drawn = [space.draw(np.random.default_rng([SEED, 1, k])) for k in range(TESTS)]
    return [
        Test(f"{k:04d}", Scenario(road, drawn[k] if conditions else DEFAULT, seed=SEED + k))
        for k, road in enumerate(unseen_roads(TESTS, SEED))
    ]


def drive(
    folder: Path, settings: DriveSettings, tests: list[Test], gates: dict[Key, Gate], simulators: list[SimulatorName]
) -> Runs:
    """Drive the tests on every simulator; `gates`, which has what earlier networks' drives left, grows."""
    runs: Runs = {}
    for name in simulators:
        say(f"{settings.driver} on {name}")
        one = replace(settings, siblings=(name,))
        results = drive_tests(one, {name: tests}, folder / name, Callbacks(listen=ScreenListener), gates=gates)
        gates |= results.gates
        runs[name] = [driven_road(results, test, name) for test in tests]
    return runs


def table_of(runs: Runs, tests: list[Test], rows: list[int]) -> RoadTable:
    """Outcomes of the tests that are valid everywhere, for every network."""
    driven = {name: [run for k in rows if (run := of[k]) is not None] for name, of in runs.items()}
    return table_of_runs(driven, conditions=[tests[k].conditions for k in rows])


def agreement(lateral: Array, rows: Indices) -> float:
    """Mean over pairs of simulators of Spearman's correlation of (tests, simulators) positions in some rows."""
    ranks = np.apply_along_axis(rankdata, 0, lateral[rows])
    if (ranks.std(axis=0) == 0.0).any():
        return float("nan")
    return float(np.corrcoef(ranks.T)[np.triu_indices(lateral.shape[1], 1)].mean())


def contrast(lateral: Mapping[str, Array]) -> tuple[float, float, float]:
    """Agreement about networks with memory minus that about those without, and its interval over roads."""
    count = len(next(iter(lateral.values())))
    rng = np.random.default_rng(SEED)
    values = []
    for chosen in [np.arange(count), *rng.integers(0, count, (RESAMPLES, count))]:
        of = {name: agreement(one, chosen) for name, one in lateral.items()}
        means = [np.mean([of[name] for name, memory in KINDS.items() if memory is has]) for has in (True, False)]
        values.append(means[0] - means[1])
    low, high = np.nanquantile(values[1:], (0.025, 0.975))
    return float(values[0]), float(low), float(high)


def main() -> None:
    """Drive, and score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sims", default=",".join(STANDARD))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    simulators = [SimulatorName(name) for name in arguments.sims.split(",")]
    rows: list[tuple[Value, ...]] = []
    tables: list[Table] = []
    for name in ("plain", "mild"):
        tests = draw_tests(name == "mild")
        gates: dict[Key, Gate] = {}
        driven: dict[str, Runs] = {}
        for network in KINDS:
            settings = DriveSettings(
                siblings=(),
                driver=DriverName.parse(network),
                gates="all" if name == "mild" else "none",
                workers=arguments.workers,
            )
            driven[network] = drive(arguments.out / name / network, settings, tests, gates, simulators)
        invalid = {test_id for (test_id, _), gate in gates.items() if not gate.is_valid}
        kept = [k for k, test in enumerate(tests) if test.test_id not in invalid]
        lateral = {}
        for network, runs in driven.items():
            table = table_of(runs, tests, kept)
            lateral[network] = table.lateral
            say(f"{name}, {network}: {len(table)} tests")
            failed = np.stack([table.failed(one) for one in simulators])
            apart = float((failed.any(axis=0) & ~failed.all(axis=0)).mean())
            agrees = agreement(table.lateral, np.arange(len(table)))
            rows.append((name, network, KINDS[network], *map(int, failed.sum(axis=1)), agrees, apart, None, None))
            analysis = analyse(table, ())
            tables += [replace(one, name=f"{name}_{network}_{one.name}") for one in analysis_tables(analysis)[:4]]
        difference, low, high = contrast(lateral)
        say(f"{name}: with memory minus without: {difference:.3f} [{low:.3f}, {high:.3f}]")
        of_all = [None] * (len(simulators) + 1)
        rows.append((name, "with memory minus without", *of_all, difference, None, low, high))
    columns = ["tests", "network", "memory", *simulators, "agreement", "not unanimous", "low", "high"]
    summary = Table(name="memory", title="Agreement", columns=styled("text", *columns), rows=rows)
    write_tables([summary, *tables], arguments.out)


if __name__ == "__main__":
    main()
