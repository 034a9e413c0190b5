# SPDX-License-Identifier: Apache-2.0
"""Command sequences that excite all parameters of the car, and simulated recordings of them with tracker noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.dynamics import CarState, rollout
from ds_twin_donkey.logs import LogSegment
from ds_twin_donkey.parameters import DonkeyParameters

TRACKER_NOISE = (0.01, 0.01, 0.01, 0.02, 0.02)
"""Standard deviation per channel (m, m, rad, m/s, rad/s), in model metres; chosen: a ceiling camera, a wheel sensor, a
cheap gyroscope."""
_COLUMNS = [CarState._fields.index(name) for name in ("x", "y", "yaw", "speed", "yaw_rate")]


def random_commands(rng: np.random.Generator, seconds: float) -> NDArray[np.float64]:
    """Random jumps of steering every 0.2 to 0.75 s and of throttle every 0.75 to 2.5 s, (n, 2).

    The throttle is off three times out of ten and mostly high otherwise. Jumps identify servo, play, delay and lag.
    """
    count = round(seconds / FRAME_TIME)
    commands = np.zeros((count, 2))
    for column, (low, high) in enumerate(((4, 16), (15, 50))):
        at = 0
        while at < count:
            length = int(rng.integers(low, high))
            value = rng.uniform(-1.0, 1.0) if column == 0 else (1.0 - 0.95 * rng.random() ** 2) * (rng.random() > 0.3)
            commands[at : at + length, column] = value
            at += length
    return commands


def coast(full: float, rolling: float) -> NDArray[np.float64]:
    """Straight at full throttle, then coasting, (n, 2), each for s; separates drag brake from rolling resistance."""
    commands = np.zeros((round((full + rolling) / FRAME_TIME), 2))
    commands[: round(full / FRAME_TIME), 1] = 1.0
    return commands


def hard_bends(rng: np.random.Generator, seconds: float) -> NDArray[np.float64]:
    """Full throttle, alternately left and right for 1 to 2.5 s, (n, 2); identifies friction and stiffness of tyres."""
    commands = np.zeros((round(seconds / FRAME_TIME), 2))
    commands[:, 1] = 1.0
    at, side = 0, rng.choice([-1.0, 1.0])
    while at < len(commands):
        length = int(rng.integers(20, 50))
        commands[at : at + length, 0] = side * rng.uniform(0.3, 1.0)
        at, side = at + length, -side
    return commands


def manoeuvres(rng: np.random.Generator) -> NDArray[np.float64]:
    """All that a fit needs in 30.5 s, (610, 2): coasting twice, hard bends, jumps of steering and throttle."""
    return np.concatenate((coast(2.5, 7.5), hard_bends(rng, 5.0), random_commands(rng, 5.0), coast(2.5, 8.0)))


def simulated_recording(
    car: DonkeyParameters,
    rng: np.random.Generator,
    commands: NDArray[np.float64],
    noise: Sequence[float] = TRACKER_NOISE,
) -> LogSegment:
    """Simulate a drive of the twin from rest as a tracker records it, with noise by `logs.CHANNELS`.

    The front axle must carry half the load; the commands are steering and throttle, (n, 2).
    """
    states = rollout(car, commands)[:-1, _COLUMNS]
    measured = states + rng.normal(size=states.shape) * np.asarray(noise)
    return LogSegment(commands=commands, measured=measured, from_rest=True)


def hidden_and_start(names: list[str], rng: np.random.Generator) -> tuple[dict[str, float], dict[str, float]]:
    """Draw true parameters up to 30% off the nominal ones, and a start that is 30% off the true ones, either way.

    The trim, whose nominal value is 0, is up to 0.02 rad, and its start is 0.
    """
    nominal = DonkeyParameters()
    hidden = {name: float(getattr(nominal, name) * rng.uniform(0.7, 1.3)) for name in names}
    start = {name: float(value * rng.choice([0.7, 1.3])) for name, value in hidden.items()}
    if "steering_trim" in names:
        hidden["steering_trim"], start["steering_trim"] = float(rng.uniform(-0.02, 0.02)), 0.0
    return hidden, start
