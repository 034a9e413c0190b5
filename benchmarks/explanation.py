# SPDX-License-Identifier: Apache-2.0
"""How often `ds explain` names the cause, on made cars whose one planted difference is known.

    python -m benchmarks.explanation --out explanation        # about 20 minutes of processor time

A made car is a simulator with one part changed: its camera is raised, its look is dim or its lines have
faded, its vehicle is slippery or its steering lags, its commands or images are late. A pair is a road and a change with
which the made car fails, while the simulator as it was, and another one, complete. The other one gives the parts for
the exchange, so it differs from the made car in everything, and not in the planted part alone. A pair is recovered if
the largest share is that of the planted part. Changes, strengths and this rule were fixed before any share was seen;
the weaker strength that fails is taken.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks, drive_tests
from ds_orchestrator.store.model import Test
from ds_sim import BULLET, SOFTBODY, SimulatorName
from ds_sim.camera.spec import Colour
from ds_sim.hybrid import PARTS, differing_parts, exchangeable, hybrid_name
from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, Command, VehicleState
from ds_studies.explanation import Experiment, Explanation, Subset, drive_experiments
from ds_studies.steering_roads import candidate_roads

PLANTS = {
    "raised": ("camera", (2.5, 4.0)),
    "dim": ("look", (0.25, 0.15)),
    "faded": ("look", (0.15, 0.0)),
    "slippery": ("vehicle", (0.12, 0.06)),
    "lagging": ("vehicle", (1.5, 2.5)),
    "late_commands": ("delays", (0.7, 1.0)),
    "late_images": ("delays", (12.0, 18.0)),
}
"""Change -> its part, and strengths: factors on height, brightness, line contrast and grip; seconds of
steering lag and dead time; frames of latency. Chosen so that most of the cars fail, before any share was seen."""
AGAINST = {BULLET: SOFTBODY, SOFTBODY: BULLET}
"""Simulator that is changed -> simulator that gives the parts for the exchange."""
SEGMENTS = 3
"""Segments of 25 m of a road; chosen: a straight one and two bends, to save time."""


class ChangedVehicle(Vehicle):
    """Vehicle on worse tyres, whose steering follows with a first-order lag, or whose commands are late (both in s)."""

    conditions = VEHICLE_CONDITIONS

    def __init__(self, vehicle: Vehicle, *, grip: float = 1.0, lag: float = 0.0, delay: float = 0.0) -> None:
        self._vehicle, self._grip, self._lag = vehicle, grip, lag
        self.command_delay = delay

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come."""
        self._vehicle.adjust(friction=self._grip * friction, payload=payload)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the physics from scratch."""
        self._steering = 0.0
        self._sent = deque([Command(0.0, 0.0)] * round(self.command_delay / FRAME_TIME))
        self._vehicle.reset(x, y, yaw, rng)

    def advance(self, command: Command) -> None:
        """Advance by one step."""
        self._sent.append(command)
        command = self._sent.popleft()
        share = 1.0 if not self._lag else min(FRAME_TIME / self._lag, 1.0)
        self._steering += share * (command.steering - self._steering)
        self._vehicle.advance(Command(min(max(self._steering, -1.0), 1.0), command.throttle))

    def state(self) -> VehicleState:
        """Current state."""
        return self._vehicle.state()

    def close(self) -> None:
        """Release the model's resources."""
        self._vehicle.close()


class LateVehicle(ChangedVehicle):
    """One whose delay may be exchanged."""

    delays_commands = True


class MadeCar(RoadSimulator):
    """Copy of a simulator with one part changed."""

    def __init__(self, base: str, plant: str, strength: float) -> None:
        own = exchangeable(base)
        spec, vehicle = own.spec, own.vehicle
        camera, look = spec.camera, spec.look
        if plant == "raised":
            camera = replace(camera, height=camera.height * strength)
        elif plant == "dim":
            camera = replace(camera, gain=camera.gain * strength)
        elif plant == "faded":
            look = replace(
                look,
                edge_line=_faded(look.edge_line, look.asphalt, strength),
                centre_line=_faded(look.centre_line, look.asphalt, strength),
            )
        elif plant == "slippery":
            vehicle = ChangedVehicle(vehicle, grip=strength)
        elif plant == "lagging":
            vehicle = ChangedVehicle(vehicle, lag=strength)
        elif plant == "late_commands":
            vehicle = LateVehicle(vehicle, delay=strength)
        else:
            camera = replace(camera, latency=round(strength))
        super().__init__(replace(spec, camera=camera, look=look), vehicle)

    @classmethod
    def from_file(cls, made: Path) -> MadeCar:
        """Make the car that `made_name` names."""
        base, plant, strength = str(made).split("+")
        return cls(base, plant, float(strength))


def _faded(line: Colour, asphalt: Colour, strength: float) -> Colour:
    red, green, blue = (round(a + strength * (c - a)) for a, c in zip(asphalt, line, strict=True))
    return red, green, blue


def made_name(base: str, plant: str, strength: float) -> SimulatorName:
    """Name a made car, as every engine takes it."""
    return SimulatorName(f"benchmarks.explanation:MadeCar@{base}+{plant}+{strength:g}")


@dataclass(frozen=True, kw_only=True)
class MadeExperiment(Experiment):
    """Experiment in which all parts but the planted one have the name of the simulator as it was, to drive less.

    Attributes:
        base: simulator that was changed.
        plant: its change, of `PLANTS`.
        strength: of the change.
    """

    base: SimulatorName
    plant: str
    strength: float

    @property
    def planted(self) -> str:
        """The changed part."""
        return PLANTS[self.plant][0]

    @classmethod
    def on(cls, test: Test, base: SimulatorName, plant: str, strength: float) -> MadeExperiment:
        """Exchange the parts of a made car."""
        name, against = made_name(base, plant, strength), AGAINST[base]
        parts = {" and ".join(parts): parts for parts in differing_parts(exchangeable(against), exchangeable(name))}
        return cls(test=test, fails=name, against=against, base=base, plant=plant, strength=strength, parts=parts)

    def drive(self, of_failing: Subset) -> tuple[SimulatorName, Test]:
        """Simulator and test of a drive; see `Experiment`."""
        own = {part: self.fails if part == self.planted else self.base for part in PARTS}
        name = hybrid_name({part: own[part] if part in of_failing else self.against for part in PARTS})
        return name, self.test


def pairs(roads: int, settings: DriveSettings, folder: Path) -> list[MadeExperiment]:
    """Find the pairs: on the first roads that the simulators as they were complete, drive every made car."""
    tests = [
        Test(f"road-0-{k:04d}", scenario) for k, scenario in enumerate(candidate_roads(roads, 1, segments=SEGMENTS))
    ]

    def failed_on(work: Mapping[SimulatorName, Sequence[Test]], stage: str) -> set[tuple[str, str]]:
        driven = drive_tests(replace(settings, siblings=tuple(work)), work, folder / stage, Callbacks())
        return {key for key, execution in driven.executions.items() if execution.outcome.is_failure}

    failed = failed_on(dict.fromkeys(AGAINST, tests), "as_they_were")
    tests = [test for test in tests if not any((test.test_id, base) in failed for base in AGAINST)][:roads]
    keys = [(test, base, plant) for test in tests for base in AGAINST for plant in PLANTS]
    strengths: dict[tuple[Test, SimulatorName, str], float] = {}
    for stage in range(2):
        left = {key: PLANTS[key[2]][1][stage] for key in keys if key not in strengths}
        work: dict[SimulatorName, list[Test]] = {}
        for (test, base, plant), strength in left.items():
            work.setdefault(made_name(base, plant, strength), []).append(test)
        failed = failed_on(work, f"made_{stage}")
        strengths |= {
            (test, base, plant): strength
            for (test, base, plant), strength in left.items()
            if (test.test_id, made_name(base, plant, strength)) in failed
        }
    print(f"{len(strengths)} of {len(keys)} made cars fail on {len(tests)} roads", flush=True)
    return [MadeExperiment.on(*key, strengths[key]) for key in keys if key in strengths]


def row(pair: MadeExperiment, explained: Explanation) -> dict[str, object]:
    """Describe one pair."""
    largest = next(iter(explained.shares), "")
    return {
        "test": explained.test_id,
        "base": pair.base,
        "plant": pair.plant,
        "strength": pair.strength,
        "planted": pair.planted,
        "repeats": explained.repeats,
        "largest": largest,
        "shares": explained.shares,
        "recovered": largest == pair.planted,
    }


def main() -> None:
    """Measure the rate of recovery, and print one line for each change and one for all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for drives and result.json; goes on there")
    parser.add_argument("--roads", type=int, default=2)
    parser.add_argument("--driver", default="dave2_short")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (os.getcwd(), os.environ.get("PYTHONPATH"))))
    settings = DriveSettings(
        siblings=(), driver=DriverName.parse(options.driver), gates="none", workers=options.workers
    )
    chosen = pairs(options.roads, settings, options.out / "made_cars")
    results = drive_experiments(chosen, settings, options.out / "exchanges", Callbacks())
    rows = [row(pair, pair.explained(results)) for pair in chosen]
    (options.out / "result.json").write_text(json.dumps(rows, indent=1) + "\n")
    for plant in (*PLANTS, ""):
        of = [one for one in rows if plant in ("", one["plant"])]
        recovered = sum(bool(one["recovered"]) for one in of)
        print(f"{plant or 'all':14} {len(of):3} pairs, {recovered:3} recovered")


if __name__ == "__main__":
    main()
