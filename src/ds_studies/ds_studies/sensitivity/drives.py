"""Drives roads for a sensitivity analysis with an engine, several at a time, and keeps each run in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ds_driver.closed_loop.drive_request import AUTOPILOT, DriveRequest
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.campaign.engine import Engine
from ds_road import Road
from ds_sim.conditions.model import Conditions
from ds_sim.gates.gate import gate_of
from ds_studies.kept_drives import keep, read_kept
from ds_studies.sensitivity.measurement import GATE


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
        drive = DriveRequest(simulator, AUTOPILOT if gated else self.driver, road, seed, conditions, probed=gated)
        run = None if folder is None else read_kept(folder, drive)
        if run is None:
            run = self.engine.drive(drive)
            if not run.outcome.is_verdict:
                message = f": {run.message}" if run.message else ""
                where = f"{simulator}, road {road.road_id}, seed {seed}"
                raise DriverError(f"{where}: {run.outcome.name.lower()}{message}")
            if folder is not None:
                keep(folder, drive, run)
        return not gate_of(run).is_valid if gated else run.outcome.is_failure
