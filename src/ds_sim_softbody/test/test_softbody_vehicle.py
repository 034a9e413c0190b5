# SPDX-License-Identifier: Apache-2.0
"""Compares the soft car with textbook formulas, values worked out by hand, and itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh
from tests.observations import drive

from ds_sim.simulator import FRAME_TIME, Command, SimulatorError
from ds_sim_softbody.lattice import NODES, Lattice, blueprint
from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters
from ds_sim_softbody.parts import Attitude, hypot, lean, loads
from ds_sim_softbody.simulator import SoftbodyVehicle

P = SoftbodyParameters()
PLAN = blueprint(P)


def standing(parameters: SoftbodyParameters = P) -> SoftbodyVehicle:
    vehicle = SoftbodyVehicle(parameters)
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    return vehicle


def test_driving_before_reset_is_refused() -> None:
    vehicle = SoftbodyVehicle()
    with pytest.raises(SimulatorError, match="call reset"):
        vehicle.advance(Command(0.0, 0.0))
    closed = standing()
    closed.close()
    with pytest.raises(SimulatorError, match="call reset"):
        closed.state()


def test_it_comes_to_rest_without_rocking() -> None:
    vehicle = standing()
    drive(vehicle, 60, -0.6, 0.5)
    states = drive(vehicle, 260, -0.6, 0.0)[240:]
    assert max(abs(s.speed) + abs(s.lateral_speed) + abs(s.yaw_rate) for s in states) < 1e-3
    assert math.hypot(states[-1].x - states[0].x, states[-1].y - states[0].y) < 1e-3


def test_the_loads_are_those_of_the_whole_car_at_its_centre_of_mass() -> None:
    """Steady state by hand: m a h over track and wheelbase; the sum is the weight at any time."""
    attitude = Attitude.at_rest(P)
    forward, left = -1.5, 4.0
    for _ in range(2000):
        lean(attitude, P, forward, left, 0.005)
    front_left, front_right, rear_left, rear_right = loads(attitude, P, forward, left)
    assert front_left + front_right + rear_left + rear_right == pytest.approx(P.mass * GRAVITY)
    height = P.mass * P.centre_of_mass_height
    gravity_roll = P.sprung_mass * (P.centre_of_mass_height - P.roll_axis_height) * GRAVITY * math.sin(attitude.roll)
    gravity_pitch = P.sprung_mass * P.centre_of_mass_height * GRAVITY * math.sin(attitude.pitch)
    sideways = (front_right + rear_right - front_left - rear_left) / 2.0 * P.track
    assert sideways == pytest.approx(height * left + gravity_roll)
    ahead = (front_left + front_right - rear_left - rear_right) / 2.0 * P.wheelbase
    assert ahead == pytest.approx(-height * forward + gravity_pitch)
    assert attitude.roll == pytest.approx(P.roll_gradient * left, rel=1e-3)
    assert 0.0 < attitude.pitch < math.radians(1.0)


def test_the_car_rolls_at_its_gradient() -> None:
    last = drive(standing(), 240, -0.4, 0.5)[-1]
    lateral = math.hypot(last.speed, last.lateral_speed) * last.yaw_rate
    assert last.roll == pytest.approx(P.roll_gradient * lateral, rel=0.03)


def test_the_frame_has_the_cars_mass_centre_and_inertia() -> None:
    plan = blueprint(replace(P, front_share=0.47))
    centre = plan.masses @ plan.positions / plan.masses.sum()
    assert plan.masses.sum() == pytest.approx(P.mass)
    assert plan.masses.min() > 0.0
    assert centre == pytest.approx((-0.03 * P.wheelbase, 0.0), abs=1e-9)
    assert plan.masses @ np.sum((plan.positions - centre) ** 2, axis=1) == pytest.approx(P.yaw_inertia)


def test_the_frame_is_rigid_and_the_substep_resolves_its_fastest_mode() -> None:
    """Three rigid motions and no other mechanism; the explicit step is stable up to 2 / frequency."""
    stiffness = np.zeros((2 * len(PLAN.masses),) * 2)
    for beam in PLAN.beams:
        direction = PLAN.positions[beam.second] - PLAN.positions[beam.first]
        direction /= np.hypot(*direction)
        both = np.concatenate((-direction, direction))
        at = [2 * beam.first, 2 * beam.first + 1, 2 * beam.second, 2 * beam.second + 1]
        stiffness[np.ix_(at, at)] += beam.stiffness * np.outer(both, both)
    squares = eigh(stiffness, np.diag(np.repeat(PLAN.masses, 2)), eigvals_only=True)
    found = np.sqrt(np.clip(squares, 0.0, None))  # rad/s
    assert found[2] < 0.1 < 50.0 < found[3]
    assert found[3] / math.tau == pytest.approx(14.3, abs=0.5)
    assert found[-1] * FRAME_TIME / P.frame_substeps < 1.0


def test_the_engine_returns_the_nodes_in_the_order_of_the_blueprint() -> None:
    lattice = Lattice(PLAN, np.zeros((NODES, 4)), iterations=2)
    np.testing.assert_array_equal(lattice.nodes[:, :2], PLAN.positions)
    lattice.bodies[1].force = (0.0, 100.0)
    lattice.space.step(0.001)
    lattice.read()
    assert lattice.nodes[1, 3] == pytest.approx(100.0 * 0.001 / P.unsprung_mass, rel=0.1)
    assert np.abs(lattice.nodes[[0, 2, 3], 2:]).max() < 1e-6


def test_a_push_moves_the_frame_as_newton_says() -> None:
    """Momentum and angular momentum equal those of the push, whatever the internal forces."""
    lattice = Lattice(PLAN, np.zeros((NODES, 4)), iterations=2)
    for _ in range(100):
        lattice.bodies[0].force = (0.0, 500.0)
        lattice.space.step(0.001)
    lattice.read()
    motion = lattice.rigid_motion()
    assert motion.velocity_y * P.mass == pytest.approx(500.0 * 0.1, rel=1e-3)
    assert motion.yaw_rate * P.yaw_inertia == pytest.approx(P.wheelbase / 2.0 * 500.0 * 0.1, rel=5e-3)


def test_the_length_of_a_vector_has_the_bits_of_python() -> None:
    vectors = np.random.default_rng(0).normal(size=(10_000, 2)) * (5.0, 0.3)
    assert [hypot(x, y) for x, y in vectors.tolist()] == [math.hypot(x, y) for x, y in vectors.tolist()]


def test_full_throttle_straight_ahead_ends_at_the_top_speed() -> None:
    assert drive(standing(), 1200, 0.0, 1.0)[-1].speed == pytest.approx(P.top_speed, abs=1.0)


def test_a_lifted_wheel_carries_the_minimum_load() -> None:
    vehicle = standing(replace(P, centre_of_mass_height=1.2, roll_axis_height=0.1))
    last = drive(vehicle, 200, -0.6, 0.8)[-1]
    assert vehicle.record["wheels"]["load"].min() == pytest.approx(0.01 * P.mass * GRAVITY / 4.0)
    assert all(math.isfinite(value) for value in (last.x, last.y, last.yaw, last.speed, last.yaw_rate))
