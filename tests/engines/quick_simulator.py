# SPDX-License-Identifier: Apache-2.0
"""Simulators of a few milliseconds, so that tests exercise the engine; some misbehave."""

from __future__ import annotations

import dataclasses
import os
import signal
import struct
import sys
import time
from pathlib import Path

import numpy as np
from tests.observations import made_observation

from ds_driver.networks.pilot import Frame
from ds_road import LANE_WIDTH, Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import spec_of
from ds_sim.simulator import Command, Observation, Outcome, Simulator, SimulatorSpec

FRAMES = 8


class QuickSimulator(Simulator):
    """Moves along the lane by 1 m a frame, off its centre by what seed and commands make of it."""

    @property
    def spec(self) -> SimulatorSpec:
        return dataclasses.replace(spec_of("donkey"), name="quick", conditions=())

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        self._road, self._rng, self._step, self._lateral = road, np.random.default_rng(seed), 0, 0.0
        return self._observe()

    def step(self, command: Command) -> Observation:
        self._step += 1
        self._lateral += float(self._rng.normal(0.0, 0.5)) + 0.1 * command.steering
        return self._observe()

    def _observe(self) -> Observation:
        outcome = Outcome.COMPLETED if self._step == FRAMES else Outcome.RUNNING
        if abs(self._lateral) > LANE_WIDTH / 2:
            outcome = Outcome.OUT_OF_BOUNDS
        image = np.zeros((160, 320, 3), np.uint8)
        x, y = self._road.lane_centre[self._step].tolist()
        return made_observation(self._step, lateral=self._lateral, outcome=outcome, image=image, x=x, y=y)


class SlowSimulator(QuickSimulator):
    """Takes 50 ms for each frame, so that a test can interfere while it drives."""

    def step(self, command: Command) -> Observation:
        time.sleep(0.05)
        return super().step(command)


class DivergingSimulator(QuickSimulator):
    """Reports a yaw rate that is not a number."""

    def step(self, command: Command) -> Observation:
        seen = super().step(command)
        return dataclasses.replace(seen, vehicle=dataclasses.replace(seen.vehicle, yaw_rate=float("nan")))


class HangingSimulator(QuickSimulator):
    """Hangs in its third frame."""

    def step(self, command: Command) -> Observation:
        if self._step == 2:
            print("hangs", flush=True)
            time.sleep(3600)
        return super().step(command)


class CrashingSimulator(QuickSimulator):
    """Takes its whole process down in its third frame, the first time only if DS_TEST_ONCE names a file."""

    def step(self, command: Command) -> Observation:
        once = os.environ.get("DS_TEST_ONCE")
        if self._step == 2 and (once is None or not Path(once).exists()):
            if once is not None:
                Path(once).touch()
            os.kill(os.getpid(), signal.SIGSEGV)
        return super().step(command)


NONSENSE = (
    struct.pack("!i", 8) + b"nonsense",
    struct.pack("!i", 4) + b"\x92\x7f\xc4\x00",  # an answer to a drive that nobody asked for
    struct.pack("!i", 4) + b"\x92\x01\xc4\x00",  # an empty run
    struct.pack("!iQ", -1, 2**40) + b"too long",
)
"""Frames of a connection."""


class BabblingSimulator(QuickSimulator):
    """Writes into its process's connection what is no answer; the seed says what."""

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        os.write(int(sys.argv[1]), NONSENSE[seed])
        return super().load(road, seed=seed, conditions=conditions)


class HalfAnsweringSimulator(QuickSimulator):
    """Stops its process in the middle of an answer, the first time only: DS_TEST_ONCE names a file."""

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        if not (once := Path(os.environ["DS_TEST_ONCE"])).exists():
            once.touch()
            os.write(int(sys.argv[1]), struct.pack("!i", 100_000) + bytes(1000))
            os.kill(os.getpid(), signal.SIGSTOP)
        return super().load(road, seed=seed, conditions=conditions)


class RaisingSimulator(QuickSimulator):
    """Cannot be made."""

    def __init__(self) -> None:
        raise RuntimeError("no licence\nfor this simulator")


class HangingDriver:
    """Hangs at the third frame of a run."""

    def drive(self, frame: Frame) -> float:
        if frame.step == 2:
            time.sleep(3600)
        return 0.0
