# SPDX-License-Identifier: Apache-2.0
"""Answer to the owner of a car: on how many roads of a recorded track a driver leaves its lane, and what else does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ds_base.words import count
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.store.model import Execution
from ds_road import Road
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome


@dataclass(frozen=True, kw_only=True)
class TrackAnswer:
    """What became of one driver on the roads of a recorded track."""

    driver: DriverName
    recording: SimulatorName  # simulator with the recording's photographs; `twin` has its own picture of the world
    twin: SimulatorName
    roads: Sequence[Road]
    # Driver and simulator -> a drive for each road; None where it has no verdict.
    drives: Mapping[tuple[DriverName, SimulatorName], Sequence[Execution | None]]
    # Driver and simulator -> why, one line for each road without a verdict.
    undecided: Mapping[tuple[DriverName, SimulatorName], Sequence[str]] = field(default_factory=dict)
    recorded: Sequence[bool]  # whether the recorded car left the lane of each road
    limits: Sequence[str] = ()  # what could not be done, one sentence each

    def failures(self, driver: DriverName, simulator: SimulatorName) -> tuple[int, int]:
        """Roads on which a driver fails, and roads with a verdict."""
        judged = [one for one in self.drives[driver, simulator] if one is not None]
        return sum(one.outcome.is_failure for one in judged), len(judged)

    @property
    def verdict(self) -> str:
        """`fails`, `passes`, or `undecided` where nothing fails and some roads, or all, have no verdict."""
        failures, judged = self.failures(self.driver, self.recording)
        return "fails" if failures else "passes" if judged == len(self.roads) else "undecided"

    @property
    def sentence(self) -> str:
        """The answer, with what it is to be compared with."""
        drives = [one for one in self.drives[self.driver, self.recording] if one is not None]
        failures, judged = self.failures(self.driver, self.recording)
        left = sum(one.outcome is Outcome.OUT_OF_BOUNDS for one in drives)
        text = f"{self.driver} leaves its lane on {left} of the {count(judged, 'road')} of the recorded track"
        if failures > left:
            text += f", and on {failures - left} it stands still or is too slow"
        if judged < len(self.roads):
            text += f", while {len(self.roads) - judged} more have no verdict"
        on_twin = " and ".join(
            f"{who} fails on {self._share(who, self.twin)}" for who in dict.fromkeys((self.driver, AUTOPILOT))
        )
        autopilot = f", the autopilot fails on {self._share(AUTOPILOT, self.recording)}"
        return (
            f"{text} (the recorded drive left it on {sum(self.recorded)} of {len(self.roads)}"
            f"{autopilot * (self.driver != AUTOPILOT)}; on the twin {on_twin})."
        )

    def _share(self, driver: DriverName, simulator: SimulatorName) -> str:
        failures, judged = self.failures(driver, simulator)
        return f"{failures} of {judged}"

    @property
    def cautions(self) -> list[str]:
        """What could not be done, what is known before any drive first."""
        said = list(self.limits)
        for simulator in (self.recording, self.twin):
            judged = self.failures(self.driver, simulator)[1]
            lines = self.undecided.get((self.driver, simulator), ())
            if judged == 0:
                said.append(f"One simulator only: no drive on {simulator} has a verdict ({lines[0]}).")
            elif lines:
                said.append(f"On {simulator} {count(len(lines), 'road')} without a verdict, such as: {lines[0]}.")
        fails = self.failures(AUTOPILOT, self.recording)[0]
        if fails and self.driver != AUTOPILOT:
            said.append(
                f"The autopilot, which sees no image, fails on {count(fails, 'road')} of the recording, too: failures "
                "there need not be the network's."
            )
        return said

    def document(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "driver": str(self.driver),
            "verdict": self.verdict,
            "sentence": self.sentence,
            "cautions": self.cautions,
            "roads": [
                {
                    "road": road.road_id,
                    "recorded_left_lane": self.recorded[index],
                    "outcomes": {
                        f"{driver} on {simulator}": None if (one := of[index]) is None else one.outcome.name
                        for (driver, simulator), of in self.drives.items()
                    },
                }
                for index, road in enumerate(self.roads)
            ],
        }
