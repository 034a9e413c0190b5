# SPDX-License-Identifier: Apache-2.0
"""Measures how strong each operating condition must be for a driver to fail, one at a time, on several simulators."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from ds_analysis.sensitivity import LEVELS, Factor, RoadResult, Sensitivity, Threshold, Verdict, threshold_of
from ds_base.progress import SILENT, Progress, logger_of
from ds_driver.networks.driver_name import AUTOPILOT
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.campaign.engine import DriveSettings, Engine
from ds_orchestrator.campaign.executor import Executor, Listener, NoOutcomeError
from ds_orchestrator.engines.drive_tests import open_drives
from ds_orchestrator.engines.start import preflight, running_engine
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import SimulatorName, spec_of
from ds_sim.scenario import Scenario
from ds_studies.steering_roads import SEGMENTS, candidate_roads


def first_failure(fails: Callable[[int], bool], highest: int, near: RoadResult | None = None) -> RoadResult:
    """Bisect integer levels from 0, which is taken to be completed, to the highest one, which may be 0.

    The level found fails, and the one below is completed; it is the lowest such one where failing is monotone. `near`
    is the result for a similar road, around which is searched: two drives if it holds here, too.
    """
    if highest == 0:
        return RoadResult(completes=0)
    low, high = 0, highest + 1

    def drive(level: int) -> None:
        nonlocal low, high
        if low < level < high:
            low, high = (low, level) if fails(level) else (level, high)

    if near is None or near.fails is None:
        drive(highest)
    else:  # search from there in steps that double, as roads differ by little
        drive(near.fails)
        drive(near.fails - 1)
        step = 1
        while high < near.fails and low == 0 and high > 1:
            drive(max(high - step, 1))
            step *= 2
        while low >= near.fails and high > highest and low < highest:
            drive(min(low + step, highest))
            step *= 2
    while high - low > 1:
        drive((low + high) // 2)
    return RoadResult(completes=low, fails=high if high <= highest else None)


TESTED, GATE = "tested", "gate"
Fails = Callable[[str, int, Conditions], bool]
"""Whether the driver (`TESTED`) fails on the road of a number under conditions; `GATE`: whether no driver can be judged
there, as the autopilot fails or the lines are invisible (`ds_sim.gates`)."""


def choose_roads(count: int, needed: int, fails: Fails) -> tuple[int, ...]:
    """Numbers of the first roads that the driver completes under default conditions, and that the gates let pass."""
    passed = (road for road in range(count) if not fails(GATE, road, DEFAULT) and not fails(TESTED, road, DEFAULT))
    return tuple(islice(passed, needed))


def measure(factor: Factor, roads: int, fails: Fails, *, levels: int = LEVELS) -> tuple[RoadResult, ...]:
    """Bisect a factor on each road, the strongest value first; returns the results of the roads that were driven.

    The gates judge the level at which the driver begins to fail. As soon as it completes the strongest value on so many
    roads that the median cannot fail, no more are driven. `levels`, how many may be driven, is one of `RESOLUTIONS`.
    """
    step = LEVELS // levels
    results: list[RoadResult] = []
    near: RoadResult | None = None
    for road in range(roads):
        if sum(one.withstands_all for one in results) > roads // 2:
            break
        near = first_failure(
            lambda level, road=road: fails(TESTED, road, factor.conditions(level * step)),  # type: ignore[misc]
            levels,
            near,
        )
        one = RoadResult(completes=near.completes * step, fails=near.fails and near.fails * step)
        if one.fails is not None and fails(GATE, road, factor.conditions(one.fails)):
            one = replace(one, fails=None, excluded=one.fails)
        results.append(one)
    return tuple(results)


class Drives:
    """Drives of one driver, kept in one store, and of the gates, which do not depend on the driver, in another."""

    def __init__(self, settings: DriveSettings, engine: Engine, tested: Store, gates: Store) -> None:
        self._engine, self._tested, self._gates = engine, tested, gates
        self._executor = Executor(replace(settings, gates="none"), Path(), tested, engine, Listener())
        self._gatekeeper = Executor(replace(settings, gates="all"), Path(), gates, engine, Listener())

    def stop(self) -> None:
        """End every drive now, and start no further one."""
        self._executor.stop()
        self._gatekeeper.stop()
        self._engine.stop()

    def of(self, simulator: SimulatorName, roads: Sequence[Scenario]) -> Fails:
        """Say of drives of these roads on a simulator whether they fail."""
        return lambda who, number, conditions: self.fails(simulator, replace(roads[number], conditions=conditions), who)

    def fails(self, simulator: SimulatorName, scenario: Scenario, who: str) -> bool:
        """Whether the driver fails, or for `GATE` whether no driver can be judged; `DriverError` without a result."""
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
        outcome = self._executor.execute(test, simulator)
        if outcome is None:
            last = [row for row in self._tested.errors() if row[:2] == (name, simulator)][-1]
            raise DriverError(error + ": ".join(filter(None, (last[3].lower(), last[4]))))
        return outcome.outcome.is_failure if isinstance(outcome, Execution) else True


LOG = logger_of(__name__)
Watch = Callable[[Sensitivity], None]
"""Called with what is known after each measurement; the others are `pending`."""


def analyse_sensitivity(
    settings: DriveSettings,
    factors: Sequence[Factor],
    *,
    roads: int,
    seed: int,
    levels: int = LEVELS,
    segments: int = SEGMENTS,
    folder: Path | None = None,
    progress: Progress = SILENT,
    watch: Watch = lambda update: None,
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
        tested, driven = stack.enter_context(open_drives(settings, place / TESTED))
        autopilot = replace(settings, driver=AUTOPILOT)
        gate_store, _ = stack.enter_context(open_drives(autopilot, place / GATE))
        engine = stack.enter_context(running_engine(driven, logs=place / "logs"))
        capacity = engine.capacity or settings.workers * len(settings.simulators)
        pool = stack.enter_context(ThreadPoolExecutor(capacity))
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)
        drives = Drives(driven, engine, tested, gate_store)
        stack.callback(drives.stop)  # first of all, so that no thread waits for a drive
        result = Sensitivity(
            driver=settings.driver,
            simulators=settings.simulators,
            factors=factors,
            needed=roads,
            roads=_choose(drives, settings, candidate_roads(roads, seed, segments=segments), roads, pool),
            thresholds={},
        )
        return _measure(drives, result, pool, levels, progress, watch)


def _choose(
    drives: Drives, settings: DriveSettings, candidates: Sequence[Scenario], needed: int, pool: ThreadPoolExecutor
) -> dict[SimulatorName, list[Scenario]]:
    """Roads of each simulator that the driver completes under default conditions, and that the gates let pass."""
    chosen = {
        name: pool.submit(choose_roads, len(candidates), needed, drives.of(name, candidates))
        for name in settings.simulators
    }
    for name, numbers in chosen.items():
        try:
            completed = len(numbers.result())
        except DriverError as error:
            raise DriverError(f"{error}: fix it and run the same command again") from None
        LOG.info("%s: %s completes %d of %d roads without any condition", name, settings.driver, completed, needed)
    return {name: [candidates[number] for number in numbers.result()] for name, numbers in chosen.items()}


def _measure(
    drives: Drives, result: Sensitivity, pool: ThreadPoolExecutor, levels: int, progress: Progress, watch: Watch
) -> Sensitivity:
    """The result with the thresholds of all factors on all simulators, in the order of the factors."""
    thresholds: dict[tuple[int, str], Threshold] = {}
    running: dict[Future[Threshold], tuple[int, str]] = {}

    def threshold(position: int, name: SimulatorName) -> Threshold:
        factor = result.factors[position]
        try:
            results = measure(factor, result.needed, drives.of(name, result.roads[name]), levels=levels)
        except DriverError as error:
            return threshold_of(name, factor, (), str(error))
        return threshold_of(name, factor, results)

    for position, factor in enumerate(result.factors):
        for name, of in result.roads.items():
            applicable = set(factor.conditions(LEVELS).changed) <= set(spec_of(name).conditions)
            measured = applicable and len(of) == result.needed
            verdict: Verdict = "pending" if measured else "fails by default" if applicable else "not applicable"
            thresholds[position, name] = Threshold(simulator=name, factor=factor, verdict=verdict)
            if measured:
                running[pool.submit(threshold, position, name)] = position, name
    watch(replace(result, thresholds=dict(thresholds)))
    progress.start(len(running))
    for future in as_completed(running):
        one = thresholds[running[future]] = future.result()
        watch(replace(result, thresholds=dict(thresholds)))
        progress.advance(line=f"{one.factor.title} on {one.simulator}: {one.text}")
    return replace(result, thresholds=thresholds)
