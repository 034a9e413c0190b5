"""Measures the sensitivity of a driver to operating conditions, one at a time, on several simulators."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ds_driver.closed_loop.simulation import AUTOPILOT
from ds_driver.process_pool import map_in_processes
from ds_orchestrator.evaluation.table import Column, Table, Value
from ds_orchestrator.sensitivity.factors import Factor
from ds_orchestrator.sensitivity.measurement import (
    GATE,
    SEGMENTS,
    TESTED,
    Task,
    candidate_roads,
    do,
    is_applicable,
    tasks_of,
)
from ds_orchestrator.sensitivity.thresholds import Threshold, coverage, threshold_of
from ds_orchestrator.siblings.kept_drives import check_settings
from ds_road import Road
from ds_sim.registry import spec_of

Progress = Callable[[int, int, str], None]
"""Called with the number of measurements done, their total number, and a line about the last one."""


@dataclass(frozen=True, kw_only=True)
class Sensitivity:
    """How strong each condition must be for a driver to fail.

    Attributes:
        driver: name of the driver.
        simulators: names of the simulators.
        factors: what was varied.
        needed: number of roads on each simulator.
        roads: roads of each simulator; fewer than needed where the driver does not complete enough by default.
        thresholds: results by the factor's position and the simulator.
    """

    driver: str
    simulators: Sequence[str]
    factors: Sequence[Factor]
    needed: int
    roads: Mapping[str, Sequence[tuple[Road, int]]]
    thresholds: Mapping[tuple[int, str], Threshold]

    @property
    def order(self) -> list[int]:
        """Positions of the factors, the most sensitive one first: least strength withstood on any simulator."""

        def least(position: int) -> float:
            found = [self.thresholds[position, name] for name in self.simulators]
            return min((one.withstood or 1.0 for one in found if one.verdict == "fails"), default=2.0)

        return sorted(range(len(self.factors)), key=lambda position: (least(position), position))

    @property
    def errors(self) -> list[str]:
        """One line for each measurement that ended in an error."""
        return [
            f"{one.factor.title} on {one.simulator}: {one.message}" for one in self.thresholds.values() if one.message
        ]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "driver": self.driver,
            "simulators": list(self.simulators),
            "roads": {name: [road.road_id for road, _ in of] for name, of in self.roads.items()},
            "interval_coverage": coverage(self.needed),
            "thresholds": [
                self.thresholds[position, name].document() for position in self.order for name in self.simulators
            ],
        }

    def table(self) -> Table:
        """One row for each factor, the most sensitive first, one column for each simulator."""
        rows: list[list[Value]] = [
            [self.factors[k].title, *(self.thresholds[k, name].text for name in self.simulators)] for k in self.order
        ]
        notes = [
            f"first failure of the median of {self.needed} roads (of the first to the last road, which hold the median "
            f"of all roads with a probability of {coverage(self.needed):.0%})"
        ]
        notes += [
            f"{name}: {self.driver} completes {len(of)} of {self.needed} roads without any condition: "
            "nothing can be said about conditions"
            for name, of in self.roads.items()
            if len(of) < self.needed
        ]
        columns = [Column("condition"), *(Column(name) for name in self.simulators)]
        title = f"Strength at which {self.driver} first fails"
        return Table(name="sensitivity", title=title, columns=columns, rows=rows, notes=notes)

    def long_table(self) -> Table:
        """One row for each factor and simulator, with every number."""
        rows: list[list[Value]] = []
        for one in (self.thresholds[k, name] for k in self.order for name in self.simulators):
            values = one.document()
            first, last = values["interval"]
            rows.append([
                one.factor.name, one.factor.unit, one.factor.end, one.simulator, one.verdict, values["first_fails"],
                first, last, values["completes"], values["excluded_from"], one.withstood, len(one.roads),
            ])  # fmt: skip
        return Table(
            name="sensitivity_values",
            title=f"Strength at which {self.driver} first fails, in numbers",
            columns=[
                Column("condition"), Column("unit"), Column("hardest", "number"), Column("simulator"),
                Column("verdict"), Column("first fails", "number"), Column("first road fails", "number"),
                Column("last road fails", "number"), Column("completes", "number"),
                Column("excluded from", "number"), Column("share of range", "number"), Column("roads", "count"),
            ],
            rows=rows,
        )  # fmt: skip


def analyse_sensitivity(
    driver: str,
    simulators: Sequence[str],
    factors: Sequence[Factor],
    *,
    roads: int,
    seed: int,
    segments: int = SEGMENTS,
    workers: int | None = None,
    folder: Path | None = None,
    progress: Progress = lambda done, total, line: None,
    say: Callable[[str], None] = lambda line: None,
) -> Sensitivity:
    """Find for each factor on each simulator the strength at which a driver first fails.

    Args:
        driver: as in `ds_driver.closed_loop.simulation.Drive`.
        simulators: names of the simulators.
        factors: what to vary, one at a time.
        roads: roads on each simulator: the first ones that driver and autopilot complete under default conditions.
        seed: of the roads, and of the runs on the first one; it increases by one per road.
        segments: segments of 25 m of each road, at most `MOST_SEGMENTS`.
        workers: number of processes; the number of available processors if None.
        folder: keeps every finished drive, so that the same call goes on; None keeps nothing.
        progress: called after each measurement.
        say: called with one line where something deserves attention.

    Raises:
        ds_orchestrator.siblings.kept_drives.KeptDrivesError: the folder holds drives of another driver.
    """
    if folder is not None:
        for kind, named in ((TESTED, driver), (AUTOPILOT, AUTOPILOT), (GATE, AUTOPILOT)):
            check_settings(folder / kind, named, simulators, say)
    candidates = tuple(candidate_roads(roads, seed, segments=segments))
    chosen = _choose(driver, simulators, candidates, roads, workers, folder, say)
    enough = {name: of for name, of in chosen.items() if len(of) == roads}
    found: dict[tuple[int, str], Threshold] = {}
    for position, factor in enumerate(factors):
        for name in simulators:
            applicable = is_applicable(factor, spec_of(name).conditions)
            verdict: Any = "fails by default" if applicable else "not applicable"
            found[position, name] = Threshold(simulator=name, factor=factor, verdict=verdict)
    tasks = tasks_of(driver, enough, factors, folder)
    for done, (task, result) in enumerate(zip(tasks, map_in_processes(do, tasks, workers=workers), strict=True), 1):
        assert task.factor is not None
        one = threshold_of(task.simulator, task.factor, result.results, result.error)
        found[factors.index(task.factor), task.simulator] = one
        progress(done, len(tasks), f"{task.factor.title} on {task.simulator}: {one.text}")
    return Sensitivity(
        driver=driver, simulators=simulators, factors=factors, needed=roads, roads=chosen, thresholds=found
    )


def _choose(
    driver: str,
    simulators: Sequence[str],
    candidates: tuple[tuple[Road, int], ...],
    needed: int,
    workers: int | None,
    folder: Path | None,
    say: Callable[[str], None],
) -> dict[str, list[tuple[Road, int]]]:
    """Roads of each simulator that driver and autopilot complete under default conditions."""
    tasks = [
        Task(simulator=name, driver=driver, factor=None, roads=candidates, needed=needed, folder=folder)
        for name in simulators
    ]
    chosen = {}
    for task, result in zip(tasks, map_in_processes(do, tasks, workers=workers), strict=True):
        if result.error:
            raise RuntimeError(f"{result.error}: fix it and run the same command again")
        chosen[task.simulator] = [candidates[number] for number in result.chosen]
        say(f"{task.simulator}: {driver} completes {len(result.chosen)} of {needed} roads without any condition")
    return chosen
