"""What every simulator promises: determinism, sign of steering, straight roads, units, frames, reset, bad input."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ds_driver.control.autopilot import Autopilot
from ds_road import Road, RoadError, generate
from ds_sim.registry import SIMULATORS, UnknownSimulatorError, make_simulator
from ds_sim.simulator import (
    FRAME_TIME,
    MAX_SPEED,
    Command,
    CommandError,
    Observation,
    Outcome,
    Simulator,
    SimulatorError,
)

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(9)])
ROAD = generate(np.random.default_rng(11), max_angle=150)

Driver = Callable[[Observation], Command]


@pytest.fixture
def simulator(simulator_name: str) -> Iterator[Simulator]:
    made = make_simulator(simulator_name)
    yield made
    made.close()


def drive(simulator: Simulator, road: Road, driver: Driver, *, seed: int = 3, steps: int = 10_000) -> list[Observation]:
    observations = [simulator.load(road, seed=seed)]
    while observations[-1].outcome is Outcome.RUNNING and len(observations) <= steps:
        observations.append(simulator.step(driver(observations[-1])))
    return observations


def autopilot(simulator: Simulator) -> Driver:
    pilot = Autopilot(simulator.spec.autopilot)
    return lambda o: pilot.command(o.lane.preview_lateral_position, o.vehicle.speed)


def digest(observations: list[Observation]) -> str:
    total = hashlib.sha256()
    for o in observations:
        total.update(np.array([o.vehicle.x, o.vehicle.y, o.vehicle.yaw, o.vehicle.speed, o.vehicle.roll]).tobytes())
        total.update(o.image.tobytes())
    return total.hexdigest()


def test_the_same_road_seed_and_commands_give_the_same_bits(simulator: Simulator, simulator_name: str) -> None:
    """Twice in this process with another run in between, and once more in a process of its own."""
    first = digest(drive(simulator, ROAD, autopilot(simulator), steps=100))
    drive(simulator, STRAIGHT, lambda o: Command(0.3, 1.0), seed=99, steps=30)
    assert digest(drive(simulator, ROAD, autopilot(simulator), steps=100)) == first
    script = (
        "import sys; sys.path.insert(0, 'tests/conformance'); import test_simulators as t;"
        f"s = t.make_simulator({simulator_name!r}); print(t.digest(t.drive(s, t.ROAD, t.autopilot(s), steps=100)))"
    )
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=True)
    assert other.stdout.split()[-1] == first


def test_a_seed_matters_where_there_is_noise_and_nowhere_else(simulator: Simulator) -> None:
    one, other = simulator.load(ROAD, seed=1).image, simulator.load(ROAD, seed=2).image
    assert np.array_equal(one, other) == (simulator.spec.camera.noise == 0.0)


def test_a_reset_forgets_a_crash(simulator: Simulator) -> None:
    """Full lock at full throttle until the car has left the road, then the same as if nothing had been."""
    before = digest(drive(simulator, ROAD, autopilot(simulator), steps=40))
    crashed = drive(simulator, ROAD, lambda o: Command(1.0, 1.0))
    assert crashed[-1].outcome is Outcome.OUT_OF_BOUNDS
    assert digest(drive(simulator, ROAD, autopilot(simulator), steps=40)) == before


@pytest.mark.parametrize(("steering", "sign"), [(-0.5, 1), (0.5, -1)])
def test_left_is_left(simulator: Simulator, steering: float, sign: int) -> None:
    """Steering -1 is full left: yaw and wheel angle grow (REP-103), and the lateral position falls."""
    end = drive(simulator, STRAIGHT, lambda o: Command(steering if o.time > 1.0 else 0.0, 0.5), steps=45)[-1]
    start_yaw = math.pi / 2
    assert sign * (end.vehicle.yaw - start_yaw) > 0.02
    assert sign * end.vehicle.steering_angle > 0.05
    assert sign * end.vehicle.yaw_rate > 0.0
    assert sign * end.lane.lateral_position < 0.0


def test_a_straight_road_is_driven_straight(simulator: Simulator) -> None:
    observations = drive(simulator, STRAIGHT, lambda o: Command(0.0, 0.4))
    assert observations[-1].outcome is Outcome.COMPLETED
    assert max(abs(o.lane.lateral_position) for o in observations) < 0.3


def test_units_agree_with_each_other(simulator: Simulator) -> None:
    """Speed is distance over time, arc length is distance driven, time is steps of 1/20 s, all in road metres."""
    observations = drive(simulator, STRAIGHT, lambda o: Command(0.0, 0.6), steps=160)
    first, last = observations[60], observations[-1]
    seconds = last.time - first.time
    assert last.step == len(observations) - 1 and last.time == pytest.approx(last.step * FRAME_TIME)
    distance = math.hypot(last.vehicle.x - first.vehicle.x, last.vehicle.y - first.vehicle.y)
    mean_speed = np.mean([o.vehicle.speed for o in observations[61:]])
    assert distance / seconds == pytest.approx(mean_speed, rel=0.05)
    assert last.lane.arc_length - first.lane.arc_length == pytest.approx(distance, rel=0.02)
    assert 2.0 < last.vehicle.speed < 20.0


def test_the_run_begins_at_rest_in_the_middle_of_the_right_lane(simulator: Simulator) -> None:
    first = simulator.load(STRAIGHT, seed=1)
    assert (first.step, first.time, first.outcome) == (0, 0.0, Outcome.RUNNING)
    assert first.vehicle.x == pytest.approx(127.0, abs=0.02) and first.vehicle.y == pytest.approx(25.0, abs=0.05)
    assert first.vehicle.yaw == pytest.approx(math.pi / 2, abs=1e-3)
    assert abs(first.vehicle.speed) < 0.05
    assert first.lane.lateral_distance == pytest.approx(2.0, abs=0.02)


def test_without_throttle_it_stays_where_it_is_and_ends_stuck(simulator: Simulator) -> None:
    observations = drive(simulator, STRAIGHT, lambda o: Command(0.0, 0.0))
    assert observations[-1].outcome is Outcome.STUCK
    assert observations[-1].time == pytest.approx(10.0)
    assert observations[-1].lane.arc_length < 0.2


def test_leaving_the_lane_ends_the_run(simulator: Simulator) -> None:
    observations = drive(simulator, STRAIGHT, lambda o: Command(0.4, 0.6))
    assert observations[-1].outcome is Outcome.OUT_OF_BOUNDS
    assert observations[-1].lane.lateral_distance < 0.0
    assert all(o.lane.lateral_distance >= 0.0 for o in observations[:-1])
    with pytest.raises(SimulatorError, match="has ended"):
        simulator.step(Command(0.0, 0.0))


def test_the_image_is_what_a_network_expects(simulator: Simulator) -> None:
    """Size and type, and the scene of the paper: sky (or a room) above, white right of the car, yellow left."""
    image = simulator.load(STRAIGHT, seed=1).image
    assert image.shape == (160, 320, 3) and image.dtype == np.uint8 and not image.flags.writeable
    rows = slice(simulator.spec.crop_top, 160 - simulator.spec.crop_bottom)
    seen = image[rows].astype(int)
    red, green, blue = seen[..., 0], seen[..., 1], seen[..., 2]
    yellow = (red - blue > 60) & (green - blue > 40)
    white = (seen.min(axis=2) > 150) & (seen.max(axis=2) - seen.min(axis=2) < 45)
    assert yellow.sum() > 50 and white.sum() > 50
    assert np.argwhere(yellow)[:, 1].mean() < 160 < np.argwhere(white)[:, 1].mean() + 60
    top = image[:10].astype(int)
    assert top.mean() > 60, "a bright world above the horizon"
    assert (top[..., 1] - top[..., [0, 2]].max(axis=2)).mean() < 10, "no grass up there"


def test_the_reference_driver_completes_a_road(simulator: Simulator) -> None:
    for road in (ROAD, ROAD.reversed()):
        assert drive(simulator, road, autopilot(simulator))[-1].outcome is Outcome.COMPLETED


def test_the_speed_has_a_limit_that_the_throttle_law_keeps(simulator: Simulator) -> None:
    """The paper's equation 2 holds every vehicle at 30 km/h (4.2.4), give or take what a frame's delay adds."""
    fastest = max(o.vehicle.speed for o in drive(simulator, STRAIGHT, autopilot(simulator)))
    assert 4.0 < fastest < 1.1 * MAX_SPEED


def test_memory_does_not_grow_with_the_roads(simulator: Simulator) -> None:
    """A road of 200 m is some 40 MB of painted ground: one that was kept would show at once."""
    roads = [generate(np.random.default_rng(seed), max_angle=120) for seed in range(4)]

    def load_and_drive(times: int) -> int:
        for index in range(times):
            drive(simulator, roads[index % len(roads)], lambda o: Command(0.0, 0.5), steps=3)
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    settled = load_and_drive(12)
    assert load_and_drive(16) - settled < 24e6


def test_bad_input_is_refused_and_the_simulator_lives_on(simulator: Simulator) -> None:
    with pytest.raises(SimulatorError, match="load"):
        simulator.step(Command(0.0, 0.0))
    crossing = Road([(50, 50), (50, 100), (50, 150), (100, 150), (100, 110), (20, 110), (10, 60)])
    with pytest.raises(RoadError, match="not valid"):
        simulator.load(crossing, seed=1)
    assert simulator.load(STRAIGHT, seed=1).outcome is Outcome.RUNNING
    simulator.close()
    assert simulator.load(STRAIGHT, seed=1).outcome is Outcome.RUNNING


@pytest.mark.parametrize(
    "values", [(math.nan, 0.0), (0.0, math.inf), (1.01, 0.0), (-2.0, 0.5), (0.0, -0.1), (0.0, 1.1)]
)
def test_a_command_out_of_range_cannot_be_made(values: tuple[float, float]) -> None:
    with pytest.raises(CommandError, match="expected a number"):
        Command(*values)


@pytest.mark.parametrize("name", ["", "bulet", "ds_sim:Nothing", "no.such.module:Thing"])
def test_an_unknown_simulator_is_named(name: str) -> None:
    with pytest.raises(UnknownSimulatorError):
        make_simulator(name)


def test_the_simulators_differ() -> None:
    """Same road, same commands, three trajectories: complementary, not copies."""
    ends = []
    for name in sorted(SIMULATORS):
        simulator = make_simulator(name)
        end = drive(simulator, STRAIGHT, lambda o: Command(0.05 if o.time > 2.0 else 0.0, 0.7), steps=80)[-1]
        ends.append((end.vehicle.x, end.vehicle.y))
        simulator.close()
    for i, one in enumerate(ends):
        for other in ends[:i]:
            assert math.dist(one, other) > 0.1
