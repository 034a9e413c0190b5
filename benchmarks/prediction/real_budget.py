"""What a few drives on a car are worth: twins that were never driven, predicted after 0, 2, 4, 8 and 16 chosen drives.

`python -m benchmarks.prediction.real_budget --out budget` drives the same random roads on the siblings, on `donkey`,
and on 20 made twins (`benchmarks.prediction.made_twins`), and keeps every drive: stopped, the same command goes on
with the drive at which it was, and a larger `--twins` or another network adds to what is there. `--score` only scores.
`--made wide` takes 20 cars that differ in everything at once, and writes its tables into `wide`.
A drive takes 4 s of processor time: 20 twins, 30 roads and one network are 720 drives, 45 minutes on one core.

Twins: each of the four simulators in turn, predicted from the other three; the made twins, predicted from `--siblings`;
and control twins, each equal to one of these siblings. Drives are chosen by expected information (`ds real propose`),
by disagreement (siblings' mean closest to one half) and at random, the last two as a mean of ten choices; each budget
goes on from the smaller one, whose outcomes are known. Every predictor is scored by its Brier score over all tests,
once as it is, and once with the outcomes of the driven tests filled in, as any predictor could have them.

Intervals are 95 % of 2,000 resamples of twins and of roads at the same time (the pigeonhole bootstrap: Owen, Ann. Appl.
Stat. 2007), as all twins drive the same roads; twins that share a maker are still more alike than cars are.

With `--conditions` each road has its own line contrast and visibility, from `CONDITIONS`: a network that completes
every road can fail there. Tests that the gates exclude on one of a case's simulators are left out of it. Gates are
kept, too, and serve every network. Fixed before the first drive: twins, roads, conditions, networks, siblings, budgets,
rules, scores.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarks.prediction.budget_scores import BUDGETS, SEED, Case, Scored, score, tables_of
from benchmarks.prediction.made_twins import CAMERA, MadeTwin, made_twin
from rich.console import Console

from ds_analysis.common.driven_road import DrivenRoad
from ds_analysis.common.outcome_table import OutcomeTable, table_of_runs
from ds_analysis.common.table import write_tables
from ds_cli.output import say
from ds_cli.progress import ScreenListener
from ds_driver.data.collection import unseen_roads
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Key, Progress, drive_tests, read_drives
from ds_orchestrator.search.algorithms import ConditionSpace, SearchedCondition
from ds_orchestrator.store.model import Test
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.gates.gate import Gate
from ds_studies.same_roads import driven_road

SIMULATORS = ("bullet", "softbody", "panda", "donkey")
NETWORKS = ("dave2_short", "epoch", "dave2_b")
CONDITIONS = {"line_contrast": {"low": 0.05, "high": 1.0}, "visibility": {"low": 20.0, "high": 200.0}}
"""Drawn beside roads; chosen: what the visibility of a lane depends on most directly."""


Runs = dict[str, list[DrivenRoad | None]]
"""Simulator or twin -> its drives in the tests' order; None for one that is not there."""
Valid = Mapping[str, Sequence[bool]]
"""Simulator or twin -> whether the gates let each test be judged there."""
Gates = dict[str, Mapping[Key, Gate]]
"""Simulator or twin -> what is known of the tests' validity there."""


@dataclass(frozen=True, kw_only=True)
class BudgetTest:
    """A road, its seed, and its conditions."""

    road: Road
    seed: int
    conditions: Conditions = DEFAULT


def draw_tests(count: int, *, conditions: bool) -> list[BudgetTest]:
    """Draw the tests; the roads are the same with and without conditions."""
    space = ConditionSpace([SearchedCondition(name=name, **ends) for name, ends in CONDITIONS.items()])
    return [
        BudgetTest(
            road=road,
            seed=SEED + k,
            conditions=space.draw(np.random.default_rng([SEED, 1, k])) if conditions else DEFAULT,
        )
        for k, road in enumerate(unseen_roads(count, SEED))
    ]


def drive(
    out: Path,
    driver: str,
    tests: Sequence[BudgetTest],
    twins: Sequence[MadeTwin],
    workers: int,
    *,
    gates: Gates | None,
    known_only: bool,
    simulators: Sequence[str] = SIMULATORS,
) -> tuple[Runs, Valid]:
    """Drive the tests on every simulator and twin, or read what was driven.

    Args:
        out: folder of the benchmark.
        driver: name of a network.
        tests: what to drive.
        twins: made twins, driven whole, one after the other: a stopped run scores those that are done.
        workers: number of processes.
        gates: what is known of the tests' validity, completed here; None to drive without gates.
        known_only: drive nothing.
        simulators: what drives beside the twins.
    """
    driven = {name: (name, dict[str, float]()) for name in simulators} | {
        twin.name: (twin.simulator(out / "twins"), {key: twin.values[key] for key in CAMERA}) for twin in twins
    }
    runs: Runs = {}
    valid: dict[str, list[bool]] = {}
    for name, (simulator, camera) in driven.items():
        settings = DriveSettings(
            siblings=(simulator,), driver=driver, gates="none" if gates is None else "all", workers=workers
        )
        made = [
            Test(
                test_id=f"{k:04d}", sibling=simulator, run=0, number=0, road=test.road, seed=test.seed,
                conditions=replace(test.conditions, **camera),
            )
            for k, test in enumerate(tests)
        ]  # fmt: skip
        work, folder = {simulator: made}, out / driver / name
        if known_only:
            found = read_drives(folder, work)
        else:
            say(f"{driver} on {name}")
            known = None if gates is None else gates.get(name)
            found = drive_tests(settings, work, folder, Progress(listen=ScreenListener, say=say), gates=known)
        if gates is not None:
            gates[name] = {**gates.get(name, {}), **found.gates}
        runs[name] = [driven_road(found, test, simulator) for test in made]
        # A test whose gates were not driven counts as valid, so that a case with it is incomplete.
        valid[name] = [(test.test_id, simulator) not in found.excluded for test in made]
    return runs, valid


def cases_of(
    network: str,
    runs: Runs,
    valid: Valid,
    tests: Sequence[BudgetTest],
    twins: Sequence[MadeTwin],
    siblings: Sequence[str],
) -> list[Case]:
    """Make every case whose drives are done; a test without a verdict on one of its simulators is left out."""

    def table(known: Sequence[str], twin: str, name: str) -> OutcomeTable | None:
        return _table([runs[one] for one in (*known, twin)], [valid[one] for one in (*known, twin)], tests, name)

    cases = [
        ("in turn", name, "", table([one for one in SIMULATORS if one != name], name, name)) for name in SIMULATORS
    ]
    cases += [("made", twin.name, twin.outside, table(siblings, twin.name, twin.name)) for twin in twins]
    cases += [("control", f"{name} again", "", table(siblings, name, f"{name} again")) for name in siblings]
    return [
        Case(network=network, group=group, name=name, outside=outside, table=found, clusters=found.test_ids)
        for group, name, outside, found in cases
        if found is not None
    ]


def _table(
    runs: Sequence[Sequence[DrivenRoad | None]],
    valid: Sequence[Sequence[bool]],
    tests: Sequence[BudgetTest],
    twin: str,
) -> OutcomeTable | None:
    """Outcomes of the siblings and, last, the twin on the tests that are valid on all; None if drives are missing."""
    rows = [k for k in range(len(tests)) if all(of[k] for of in valid)]
    columns = [[of[k] for k in rows] for of in runs]
    if any(run is None for of in columns for run in of):
        return None
    names = (*(f"sibling {k}" for k in range(1, len(runs))), twin)
    known = {name: [run for run in of if run is not None] for name, of in zip(names, columns, strict=True)}
    table = table_of_runs(known, conditions=[tests[k].conditions for k in rows])
    return table.judged().with_twin(twin)


def main() -> None:
    """Drive what is missing, then score what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of drives and results; goes on if it has some")
    parser.add_argument("--twins", type=int, default=20, help="made twins")
    parser.add_argument("--made", choices=("near", "wide"), default="near", help="kind of the made twins")
    parser.add_argument("--tests", type=int, default=30, help="random roads, at least 10")
    parser.add_argument("--networks", default="dave2_short", help=f"some of {','.join(NETWORKS)}, or any other")
    parser.add_argument("--siblings", default=",".join(SIMULATORS[:3]), help="three that predict the made twins")
    parser.add_argument("--conditions", action="store_true", help="tests are roads and conditions, with gates")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--score", action="store_true", help="only score the twins whose drives are done")
    arguments = parser.parse_args()
    if arguments.tests < max(BUDGETS):
        parser.error(f"--tests {arguments.tests}: expected at least {max(BUDGETS)}, the largest budget")
    siblings = arguments.siblings.split(",")
    if len(siblings) != 3 or not set(siblings) <= set(SIMULATORS):
        parser.error(f"--siblings {arguments.siblings}: expected three of {','.join(SIMULATORS)}")
    tests = draw_tests(arguments.tests, conditions=arguments.conditions)
    twins = [made_twin(number, SEED, arguments.made) for number in range(1, arguments.twins + 1)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    gates: Gates | None = {} if arguments.conditions else None
    scored: list[Scored] = []
    for network in arguments.networks.split(","):
        runs, valid = drive(
            arguments.out, network, tests, twins, arguments.workers, gates=gates, known_only=arguments.score
        )
        say(f"gates: {sum(not one for of in valid.values() for one in of)} tests of simulators are excluded")
        cases = cases_of(network, runs, valid, tests, twins, siblings)
        say(f"{network}: scoring {len(cases)} twins")
        scored += [score(case) for case in cases]
    if not scored:
        parser.error(f"{arguments.out} holds no twin whose drives are done: leave out --score")
    tables = tables_of(scored)
    for table in tables:
        table.show(Console(width=180))
    results = arguments.out if arguments.made == "near" else arguments.out / arguments.made
    results.mkdir(exist_ok=True)
    write_tables(tables, results)
    document = {
        "networks": arguments.networks.split(","), "tests": arguments.tests, "siblings": siblings,
        "conditions": CONDITIONS if arguments.conditions else {},
        "twins": [twin.document() for twin in twins],
        "scores": [
            {
                "network": one.case.network, "group": one.case.group, "twin": one.case.name, "odds": one.odds,
                "ranks": one.ranks, "calls": one.calls, "stopped": one.stopped,
                "plain": {name: float(e.mean()) for name, e in one.plain.items()},
                "after": {
                    f"{rule} {budget}": {name: float(e.mean()) for name, e in errors.items()}
                    for (rule, budget), errors in one.after.items()
                },
            }
            for one in scored
        ],
    }  # fmt: skip
    (results / "real_budget.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
