"""Drives roads for a sensitivity analysis with an engine, several at a time, and keeps each run in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ds_driver.closed_loop.simulation import AUTOPILOT, Drive
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.sensitivity.measurement import GATE
from ds_orchestrator.siblings.kept_drives import keep, read_kept
from ds_road import Road
from ds_sim.conditions.model import Conditions
from ds_sim.gates.gate import gate_of
from ds_sim.session import RunRecord


class Engine(Protocol):
    """Drives; called from several threads. `ds_orchestrator.engines.local.LocalExecutor` is one."""

    @property
    def capacity(self) -> int | None:
        """Drives at a time."""
        ...

    def execute(self, simulator: str, road: Road, seed: int, conditions: Conditions) -> RunRecord:
        """Drive the tested driver to an outcome."""
        ...

    def gate(self, simulator: str, road: Road, seed: int, conditions: Conditions) -> RunRecord:
        """Drive the autopilot, and measure the contrast of the lines."""
        ...

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        ...


@dataclass(frozen=True, kw_only=True)
class Drives:
    """Drives of one driver and of the gates.

    Attributes:
        engine: drives.
        driver: name of the driver.
        folder: of the driver's kept runs; None keeps none.
        gates: folder of the kept runs of the gates, which do not depend on the driver; None keeps none.
    """

    engine: Engine
    driver: str
    folder: Path | None
    gates: Path | None

    def fails(self, simulator: str, road: Road, seed: int, who: str, conditions: Conditions) -> bool:
        """Whether the driver fails, or for `GATE` whether no driver can be judged.

        Raises:
            DriverError: the drive ended in an error, which is no result.
        """
        gated = who == GATE
        folder = self.gates if gated else self.folder
        drive = Drive(simulator, AUTOPILOT if gated else self.driver, road, seed, conditions, probed=gated)
        run = None if folder is None else read_kept(folder, drive)
        if run is None:
            run = (self.engine.gate if gated else self.engine.execute)(simulator, road, seed, conditions)
            if not run.outcome.is_verdict:
                message = f": {run.message}" if run.message else ""
                where = f"{simulator}, road {road.road_id}, seed {seed}"
                raise DriverError(f"{where}: {run.outcome.name.lower()}{message}")
            if folder is not None:
                keep(folder, drive, run)
        return not gate_of(run).is_valid if gated else run.outcome.is_failure
