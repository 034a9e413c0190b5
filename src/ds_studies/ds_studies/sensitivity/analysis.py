# SPDX-License-Identifier: Apache-2.0
"""Measures the sensitivity of a driver to operating conditions, one at a time, on several simulators."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ds_analysis.common.table import Column, Table, Value
from ds_base.progress import SILENT, Progress, logger_of
from ds_driver.control.autopilot import AUTOPILOT
from ds_driver.networks.network_driver import sees_translated
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.campaign.engine import DriveSettings, Engine
from ds_orchestrator.campaign.executor import Executor, Listener, NoOutcomeError
from ds_orchestrator.engines.drive_tests import open_drives
from ds_orchestrator.engines.preflight import preflight
from ds_orchestrator.engines.start import running_engine
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import spec_of
from ds_sim.scenario import Scenario
from ds_studies.sensitivity.factors import LEVELS, Factor
from ds_studies.sensitivity.measurement import (
    GATE,
    SEGMENTS,
    TESTED,
    Fails,
    Threshold,
    Verdict,
    candidate_roads,
    choose_roads,
    coverage,
    is_applicable,
    measure,
    threshold_of,
)


class Drives:
    """Drives of one driver and of the gates.

    Args:
        settings: driver and simulators.
        engine: drives.
        tested: keeps the driver's executions.
        gates: keeps the gates, which do not depend on the driver.
    """

    def __init__(self, settings: DriveSettings, engine: Engine, tested: Store, gates: Store) -> None:
        self._engine, self._tested, self._gates = engine, tested, gates
        self._executor = Executor(replace(settings, gates="none"), Path(), tested, engine, Listener())
        self._gatekeeper = Executor(replace(settings, gates="all"), Path(), gates, engine, Listener())

    def stop(self) -> None:
        """End every drive now, and start no further one."""
        self._executor.stop()
        self._gatekeeper.stop()
        self._engine.stop()

    def fails(self, simulator: str, scenario: Scenario, who: str) -> bool:
        """Whether the driver fails, or for `GATE` whether no driver can be judged.

        Raises:
            DriverError: every attempt ended in an error, which is no result.
            ds_orchestrator.campaign.executor.CampaignError: the simulator gave no outcome for several tests in a row.
            ds_orchestrator.campaign.executor.Stopped: `stop` was called.
        """
        road_id, seed = scenario.road.road_id, scenario.seed
        name = "-".join(filter(None, (road_id, str(seed), format_conditions(scenario.conditions))))
        test, error = Test(name, scenario), f"{simulator}, road {road_id}, seed {seed}: "
        if who == GATE:
            self._gates.add_test(test)
            try:
                gate = self._gatekeeper.judge(test, simulator)
            except NoOutcomeError as failed:
                raise DriverError(f"{error}{failed}") from None
            return gate is not None and not gate.is_valid
        self._tested.add_test(test)
        found = self._executor.execute(test, simulator)
        if found is None:
            last = [row for row in self._tested.errors() if row[:2] == (name, simulator)][-1]
            raise DriverError(error + ": ".join(filter(None, (last[3].lower(), last[4]))))
        return found.outcome.is_failure if isinstance(found, Execution) else True


LOG = logger_of(__name__)
Watch = Callable[["Sensitivity"], None]
"""Called with what is known after each measurement; the others are `pending`."""


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
    roads: Mapping[str, Sequence[Scenario]]
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
            "translated_images": sees_translated(self.driver),
            "simulators": list(self.simulators),
            "roads": {name: [one.road.road_id for one in of] for name, of in self.roads.items()},
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
        if len(self.factors) > 1:
            notes.append(f"the order is that of these {self.needed} roads: on others, another condition may come first")
        if sees_translated(self.driver):
            notes.append(
                f"{self.driver} sees translated images, and a generator may undo what a condition does to them: this "
                "says nothing about its network on images of a real camera under these conditions"
            )
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
    settings: DriveSettings,
    factors: Sequence[Factor],
    *,
    roads: int,
    seed: int,
    levels: int = LEVELS,
    segments: int = SEGMENTS,
    folder: Path | None = None,
    gates: Path | None = None,
    progress: Progress = SILENT,
    watch: Watch = lambda found: None,
) -> Sensitivity:
    """Find for each factor on each simulator the strength at which a driver first fails.

    Args:
        settings: driver, simulators and engine.
        factors: what to vary, one at a time.
        roads: roads on each simulator: the first ones that the driver completes under default conditions.
        seed: of the roads, and of the runs on the first one; it increases by one per road.
        levels: levels of strength that may be driven, one of `RESOLUTIONS`.
        segments: segments of 25 m of each road, at most `MOST_SEGMENTS`.
        folder: keeps every finished drive, so that the same call goes on; None keeps nothing.
        gates: keeps the gates, which analyses of several drivers on the same simulators may share; in `folder` if None.
        progress: counts the measurements.
        watch: called with what is known after each measurement.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: the driver or a simulator's file has changed since the folder
            began, or the engine cannot be used so.
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds drives of another driver or of other simulators.
        ds_driver.networks.pilot.DriverError: a drive under default conditions ended in an error.
        ds_orchestrator.campaign.executor.CampaignError: a simulator gave no outcome for several tests in a row.
    """
    preflight(settings)
    with ExitStack() as stack:
        place = folder or Path(stack.enter_context(TemporaryDirectory(prefix="ds_sensitivity_")))
        tested = stack.enter_context(open_drives(settings, place / TESTED))
        autopilot = replace(settings, driver=AUTOPILOT)
        gate_store = stack.enter_context(open_drives(autopilot, gates or place / GATE))
        engine = stack.enter_context(running_engine(settings, logs=place / "logs"))
        capacity = engine.capacity or settings.workers * len(settings.simulators)
        pool = stack.enter_context(ThreadPoolExecutor(capacity))
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        drives = Drives(settings, engine, tested, gate_store)
        stack.callback(drives.stop)  # first of all, so that no thread waits for a drive
        candidates = candidate_roads(roads, seed, segments=segments)
        chosen = _choose(drives, settings, candidates, roads, pool)
        known = Sensitivity(
            driver=settings.driver, simulators=settings.simulators, factors=factors, needed=roads, roads=chosen,
            thresholds={},
        )  # fmt: skip

        def so_far(thresholds: Mapping[tuple[int, str], Threshold]) -> None:
            watch(replace(known, thresholds=dict(thresholds)))

        thresholds = _measure(
            drives, chosen, factors, pool, needed=roads, levels=levels, progress=progress, so_far=so_far
        )
    return replace(known, thresholds=thresholds)


def _choose(
    drives: Drives,
    settings: DriveSettings,
    candidates: Sequence[Scenario],
    needed: int,
    pool: ThreadPoolExecutor,
) -> dict[str, list[Scenario]]:
    """Roads of each simulator that the driver completes under default conditions, and that the gates let pass."""
    found = {
        name: pool.submit(choose_roads, len(candidates), needed, _fails(drives, name, candidates))
        for name in settings.simulators
    }
    for name, numbers in found.items():
        try:
            completed = len(numbers.result())
        except DriverError as error:
            raise DriverError(f"{error}: fix it and run the same command again") from None
        LOG.info("%s: %s completes %d of %d roads without any condition", name, settings.driver, completed, needed)
    return {name: [candidates[number] for number in numbers.result()] for name, numbers in found.items()}


def _measure(
    drives: Drives,
    roads: Mapping[str, Sequence[Scenario]],
    factors: Sequence[Factor],
    pool: ThreadPoolExecutor,
    *,
    needed: int,
    levels: int,
    progress: Progress,
    so_far: Callable[[Mapping[tuple[int, str], Threshold]], None],
) -> dict[tuple[int, str], Threshold]:
    """Thresholds of all factors on all simulators, in the order of the factors."""
    found: dict[tuple[int, str], Threshold] = {}
    running: dict[Future[Threshold], tuple[int, str]] = {}

    def threshold(position: int, name: str) -> Threshold:
        factor = factors[position]
        try:
            results = measure(factor, needed, _fails(drives, name, roads[name]), levels=levels)
        except DriverError as error:
            return threshold_of(name, factor, (), str(error))
        return threshold_of(name, factor, results)

    for position, factor in enumerate(factors):
        for name, of in roads.items():
            applicable = is_applicable(factor, spec_of(name).conditions)
            measured = applicable and len(of) == needed
            verdict: Verdict = "pending" if measured else "fails by default" if applicable else "not applicable"
            found[position, name] = Threshold(simulator=name, factor=factor, verdict=verdict)
            if measured:
                running[pool.submit(threshold, position, name)] = position, name
    so_far(found)
    progress.start(len(running))
    for future in as_completed(running):
        one = found[running[future]] = future.result()
        so_far(found)
        progress.advance(line=f"{one.factor.title} on {one.simulator}: {one.text}")
    return found


def _fails(drives: Drives, simulator: str, roads: Sequence[Scenario]) -> Fails:
    def fails(who: str, number: int, conditions: Conditions) -> bool:
        return drives.fails(simulator, replace(roads[number], conditions=conditions), who)

    return fails
