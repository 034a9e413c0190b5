"""What a few drives on a car are worth: twins that were never driven, predicted after 0, 2, 4, 8 and 16 chosen drives.

`python -m benchmarks.real_budget --out budget` drives the same random roads on the siblings, on `donkey`, and on 20
made twins (`benchmarks.made_twins`), and keeps every drive: stopped, the same command goes on with the drive at which
it was, and a larger `--twins` or another network adds to what is there. `--score` only scores. A drive takes 4 s of
processor time: 20 twins, 30 roads and one network are 720 drives, 45 minutes on one core.

Twins: each of the four simulators in turn, predicted from the other three; the made twins, predicted from `--siblings`;
and control twins, each equal to one of these siblings. Drives are chosen by expected information (`ds real propose`),
by disagreement (siblings' mean closest to one half) and at random, the last two as a mean of ten choices; each budget
goes on from the smaller one, whose outcomes are known. Every predictor is scored by its Brier score over all tests,
once as it is, and once with the outcomes of the driven tests filled in, as any predictor could have them.

Intervals are 95 % of 2,000 resamples of twins and of roads at the same time (the pigeonhole bootstrap: Owen, Ann. Appl.
Stat. 2007), as all twins drive the same roads; twins that share a maker are still more alike than cars are.
Fixed before the first drive: twins, roads, networks, siblings, budgets, rules, scores.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from benchmarks.budget_scores import BUDGETS, SEED, Case, Scored, score, tables_of
from benchmarks.made_twins import MadeTwin, made_twin
from rich.console import Console

from ds_driver.closed_loop.simulation import Drive
from ds_driver.closed_loop.success_rate import unseen_roads
from ds_orchestrator.cli.output import countdown, say
from ds_orchestrator.evaluation.table import write_tables
from ds_orchestrator.prediction.outcome_table import OutcomeTable, table_of_outcomes
from ds_orchestrator.siblings.kept_drives import drive_kept
from ds_orchestrator.siblings.outcomes import Outcomes
from ds_road import Road
from ds_sim.conditions import DEFAULT
from ds_sim.session import RunRecord

SIMULATORS = ("bullet", "softbody", "panda", "donkey")
NETWORKS = ("dave2_short", "epoch", "dave2_b")


def drive(
    out: Path, network: str, roads: Sequence[Road], twins: Sequence[MadeTwin], workers: int, *, known_only: bool
) -> dict[str, list[RunRecord | None]]:
    """Drive every road on every simulator and twin, or read what was driven; simulator -> runs in the roads' order."""
    folder = out / network
    cars = {twin.name: twin for twin in twins}
    simulators = {name: name for name in SIMULATORS} | {
        name: twin.simulator(out / "twins") for name, twin in cars.items()
    }
    drives = {
        name: [
            Drive(simulator, network, road, SEED + k, cars[name].conditions if name in cars else DEFAULT)
            for k, road in enumerate(roads)
        ]
        for name, simulator in simulators.items()
    }  # whole twins, one after the other: a stopped run scores those that are done
    if known_only:
        from ds_orchestrator.siblings.kept_drives import read_kept

        return {name: [read_kept(folder, one) for one in of] for name, of in drives.items()}
    runs: dict[str, list[RunRecord | None]] = {name: [] for name in drives}
    flat = [(name, one) for name, of in drives.items() for one in of]
    progress, kept = countdown(), 0
    found = drive_kept([one for _, one in flat], folder, workers=workers, say=say)
    for done, ((name, _), (run, fresh)) in enumerate(zip(flat, found, strict=True), start=1):
        runs[name].append(run)
        kept += not fresh
        if fresh:
            progress(done - kept, len(flat) - kept, f"{network} on {name}: {run.outcome.name.lower()}")
    return runs


def cases_of(
    network: str, runs: Mapping[str, Sequence[RunRecord | None]], twins: Sequence[MadeTwin], siblings: Sequence[str]
) -> list[Case]:
    """Make every case whose drives are done; a test without a verdict on one of its simulators is left out."""
    cases = [
        Case(network=network, group="in turn", name=name, outside="", table=table)
        for name in SIMULATORS
        for table in [_table([runs[one] for one in SIMULATORS if one != name], runs[name], name)]
        if table is not None
    ]
    known = [runs[one] for one in siblings]
    for twin in twins:
        table = _table(known, runs[twin.name], twin.name)
        if table is not None:
            cases.append(Case(network=network, group="made", name=twin.name, outside=twin.outside, table=table))
    for name in siblings:
        table = _table(known, runs[name], f"{name} again")
        if table is not None:
            cases.append(Case(network=network, group="control", name=f"{name} again", outside="", table=table))
    return cases


def _table(
    siblings: Sequence[Sequence[RunRecord | None]], twin: Sequence[RunRecord | None], name: str
) -> OutcomeTable | None:
    """Outcomes of the siblings and a twin; None if drives of the twin are missing."""
    if any(run is None for of in (*siblings, twin) for run in of):
        return None
    columns = [[run for run in of if run is not None] for of in (*siblings, twin)]
    rows = [k for k in range(len(twin)) if all(of[k].outcome.is_verdict for of in columns)]
    names = (*(f"sibling {k}" for k in range(1, len(siblings) + 1)), name)
    outcomes = Outcomes(
        simulators=names,
        roads=tuple(columns[0][k].road for k in rows),
        failed=np.array([[of[k].outcome.is_failure for of in columns] for k in rows], np.bool_),
        lateral=np.array([[of[k].max_lateral_position for of in columns] for k in rows]),
        profiles={},
    )
    return table_of_outcomes(outcomes, twin=name)


def main() -> None:
    """Drive what is missing, then score what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of drives and results; goes on if it has some")
    parser.add_argument("--twins", type=int, default=20, help="made twins")
    parser.add_argument("--tests", type=int, default=30, help="random roads, at least 10")
    parser.add_argument("--networks", default="dave2_short", help=f"some of {','.join(NETWORKS)}, or any other")
    parser.add_argument("--siblings", default=",".join(SIMULATORS[:3]), help="three that predict the made twins")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--score", action="store_true", help="only score the twins whose drives are done")
    arguments = parser.parse_args()
    if arguments.tests < max(BUDGETS):
        parser.error(f"--tests {arguments.tests}: expected at least {max(BUDGETS)}, the largest budget")
    siblings = arguments.siblings.split(",")
    if len(siblings) != 3 or not set(siblings) <= set(SIMULATORS):
        parser.error(f"--siblings {arguments.siblings}: expected three of {','.join(SIMULATORS)}")
    roads = unseen_roads(arguments.tests, SEED)
    twins = [made_twin(number, SEED) for number in range(1, arguments.twins + 1)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    scored: list[Scored] = []
    for network in arguments.networks.split(","):
        runs = drive(arguments.out, network, roads, twins, arguments.workers, known_only=arguments.score)
        cases = cases_of(network, runs, twins, siblings)
        say(f"{network}: scoring {len(cases)} twins")
        scored += [score(case) for case in cases]
    if not scored:
        parser.error(f"{arguments.out} holds no twin whose drives are done: leave out --score")
    tables = tables_of(scored)
    for table in tables:
        table.show(Console(width=180))
    write_tables(tables, arguments.out)
    document = {
        "networks": arguments.networks.split(","), "tests": arguments.tests, "siblings": siblings,
        "twins": [twin.document() for twin in twins],
        "scores": [
            {
                "network": one.case.network, "group": one.case.group, "twin": one.case.name, "odds": one.odds,
                "ranks": one.ranks, "calls": one.calls,
                "plain": {name: float(e.mean()) for name, e in one.plain.items()},
                "after": {
                    f"{rule} {budget}": {name: float(e.mean()) for name, e in errors.items()}
                    for (rule, budget), errors in one.after.items()
                },
            }
            for one in scored
        ],
    }  # fmt: skip
    (arguments.out / "real_budget.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
