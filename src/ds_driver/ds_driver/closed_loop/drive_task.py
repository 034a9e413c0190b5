"""One drive as it is handed to a process that drives, in this process, on this machine or on another one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ds_road import Road
from ds_road.files import road_from_json, road_to_json
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import from_json, to_json
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason


@dataclass(frozen=True)
class DriveTask:
    """One drive of the process's driver, or of the autopilot.

    Attributes:
        simulator: name known to `ds_sim.registry`.
        road: road to drive.
        seed: seed of the run.
        conditions: operating conditions of the run.
        gate: the autopilot drives instead of the process's driver, and the contrast of the lines is measured; see
            `ds_sim.gates`.
    """

    simulator: str
    road: Road
    seed: int
    conditions: Conditions = DEFAULT
    gate: bool = False

    def ended(self, outcome: Outcome, message: str, reason: Reason = Reason.NONE) -> RunRecord:
        """Make the record of a drive that ended without a frame."""
        return RunRecord(
            road=self.road, seed=self.seed, conditions=self.conditions, outcome=outcome, message=message, reason=reason
        )


def task_to_json(task: DriveTask) -> dict[str, Any]:
    """Convert a task to a JSON value."""
    return {
        "simulator": task.simulator,
        "road": road_to_json(task.road),
        "seed": task.seed,
        "conditions": to_json(task.conditions),
        "gate": task.gate,
    }


def task_from_json(value: Mapping[str, Any]) -> DriveTask:
    """Convert what `task_to_json` made to an equal task.

    Raises:
        ValueError: the road or the conditions cannot be.
    """
    return DriveTask(
        simulator=value["simulator"],
        road=road_from_json(value["road"]),
        seed=value["seed"],
        conditions=from_json(value["conditions"]),
        gate=value["gate"],
    )
