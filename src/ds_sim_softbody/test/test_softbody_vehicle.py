"""The soft-body car against textbook vehicle dynamics, worked independently."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ds_sim.simulator import FRAME_TIME, Command, VehicleState
from ds_sim_softbody.lattice import Lattice
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.tyre import Tyre
from ds_sim_softbody.vehicle import SoftbodyVehicle

P = SoftbodyParameters()


def drive(commands: list[Command], yaw: float = 0.0) -> list[VehicleState]:
    vehicle = SoftbodyVehicle()
    vehicle.reset(0.0, 0.0, yaw, np.random.default_rng(0))
    states = [vehicle.state()]
    for command in commands:
        vehicle.advance(command)
        states.append(vehicle.state())
    return states


def hold_speed(steering: float, speed: float, seconds: float) -> list[VehicleState]:
    """Drive at a constant speed with a simple throttle controller."""
    vehicle = SoftbodyVehicle()
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    states = [vehicle.state()]
    for _ in range(round(seconds / FRAME_TIME)):
        throttle = min(max(0.37 + 0.6 * (speed - states[-1].speed), 0.0), 1.0)
        vehicle.advance(Command(steering, throttle))
        states.append(vehicle.state())
    return states


def kinetic_energy(vehicle: SoftbodyVehicle) -> float:
    """Of nodes and spinning wheels, J."""
    assert vehicle._lattice is not None
    nodes = sum(0.5 * n.mass * n.velocity.length**2 for n in vehicle._lattice.nodes)
    return nodes + sum(0.5 * P.wheel_inertia * t.spin**2 for t in vehicle._tyres)


def test_the_body_is_a_lattice_and_weighs_what_it_should() -> None:
    lattice = Lattice(P, 3.0, 4.0, 1.0)
    assert len(lattice.nodes) == 19 and lattice.beams > 60
    assert sum(n.mass for n in lattice.nodes) == pytest.approx(P.mass)
    assert np.mean([tuple(n.position) for n in lattice.nodes], axis=0) == pytest.approx((3.0, 4.0))


def test_at_rest_it_stays_at_rest_wherever_the_wheels_point() -> None:
    for steering in (0.0, 1.0):
        end = drive([Command(steering, 0.0)] * 400)[-1]
        assert math.hypot(end.x, end.y) < 0.02 and abs(end.yaw) < 0.01 and abs(end.speed) < 0.01


@pytest.mark.parametrize("yaw", [0.0, 2.5, -1.2])
def test_straight_holds_straight(yaw: float) -> None:
    end = drive([Command(0.0, 0.6)] * 400, yaw)[-1]
    ahead = end.x * math.cos(yaw) + end.y * math.sin(yaw)
    aside = -end.x * math.sin(yaw) + end.y * math.cos(yaw)
    assert ahead > 100.0 and abs(aside) < 0.05 and end.yaw == pytest.approx(yaw, abs=1e-3)


def test_heading_is_counted_over_full_turns() -> None:
    states = drive([Command(-1.0, 0.45)] * 900)
    assert states[-1].yaw > 2 * math.pi
    assert max(abs(b.yaw - a.yaw) for a, b in zip(states, states[1:], strict=False)) < 0.3


@pytest.mark.parametrize("steering", [-0.6, -0.3, 0.3, 0.6])
def test_a_slow_circle_has_the_kinematic_radius(steering: float) -> None:
    """R = wheelbase / tan(steer) at the rear axle (Gillespie, chapter 6), so sqrt(R^2 + (l/2)^2) at the middle."""
    states = hold_speed(steering, 1.5, 14.0)[-100:]
    radius = np.mean([s.speed for s in states]) / abs(np.mean([s.yaw_rate for s in states]))
    rear = P.wheelbase / math.tan(abs(steering) * P.max_steering_angle)
    assert radius == pytest.approx(math.hypot(rear, P.wheelbase / 2), rel=0.10)
    assert math.copysign(1.0, states[-1].yaw_rate) == -math.copysign(1.0, steering)


def test_it_understeers_and_slides_at_the_grip_limit() -> None:
    """Yaw rate per speed and steer falls with speed, and no lateral acceleration exceeds friction."""
    gain = {}
    for speed in (3.0, 6.0, 9.0):
        states = hold_speed(0.12, speed, 12.0)[-60:]
        mean_speed = np.mean([s.speed for s in states])
        gain[speed] = abs(np.mean([s.yaw_rate for s in states])) / mean_speed
    assert gain[3.0] > gain[6.0] > gain[9.0]
    hard = hold_speed(1.0, 9.0, 8.0)
    lateral = [abs(s.speed * s.yaw_rate) for s in hard[60:]]
    assert 0.5 * 9.81 < max(lateral) < 1.1 * P.friction * 9.81


def test_roll_and_pitch_follow_acceleration() -> None:
    """Steady roll = m h a / stiffness, to the right in a left bend; nose up when it pulls away, down when it lifts."""
    states = hold_speed(-0.25, 6.0, 10.0)[-60:]
    acceleration = np.mean([s.speed * s.yaw_rate for s in states])
    expected = P.mass * P.gravity_height * acceleration / P.roll_stiffness
    assert np.mean([s.roll for s in states]) == pytest.approx(expected, rel=0.15) and expected > 0.01
    pulling = drive([Command(0.0, 1.0)] * 20)
    assert pulling[-1].pitch < -0.005
    lifting = drive([Command(0.0, 1.0)] * 60 + [Command(0.0, 0.0)] * 15)
    assert lifting[-1].pitch > 0.005


def test_lifting_off_slows_it_as_engine_and_tyres_say() -> None:
    states = drive([Command(0.0, 1.0)] * 70 + [Command(0.0, 0.0)] * 30)
    braking, seconds = states[75].speed - states[95].speed, 20 * FRAME_TIME
    # Spinning wheels add to the mass that must be slowed.
    mass = P.mass + 4 * P.wheel_inertia / P.tyre_radius**2
    speed = states[85].speed
    force = P.engine_braking + P.rolling_resistance * P.mass * 9.81 + 0.6 * P.drag_area * speed**2
    assert braking / seconds == pytest.approx(force / mass, rel=0.08)


def test_energy_never_grows_without_throttle() -> None:
    vehicle = SoftbodyVehicle()
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    for _ in range(80):
        vehicle.advance(Command(0.0, 1.0))
    energy = [kinetic_energy(vehicle)]
    for index in range(120):
        vehicle.advance(Command(math.sin(index / 8), 0.0))
        energy.append(kinetic_energy(vehicle))
    assert all(b <= a * 1.002 + 1.0 for a, b in zip(energy, energy[1:], strict=False))
    assert energy[-1] < 0.02 * energy[0]


def test_full_throttle_at_full_lock_stays_finite_and_whole() -> None:
    vehicle = SoftbodyVehicle()
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    for index in range(2400):
        vehicle.advance(Command(1.0 if (index // 100) % 2 else -1.0, 1.0))
    state = vehicle.state()
    assert all(math.isfinite(v) for v in (state.x, state.y, state.yaw, state.speed, state.roll))
    assert vehicle._lattice is not None
    front, rear = vehicle._lattice.rows[-1][1].position, vehicle._lattice.rows[0][1].position
    assert (front - rear).length == pytest.approx(3.7, rel=0.02)


def test_the_body_flexes_under_cornering_and_springs_back() -> None:
    vehicle = SoftbodyVehicle()
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))

    def bend() -> float:
        """Angle between the two axles' rows."""
        (fc, fs), (rc, rs) = vehicle._axle(3), vehicle._axle(1)
        return math.atan2(fs * rc - fc * rs, fc * rc + fs * rs)

    assert bend() == pytest.approx(0.0, abs=1e-9)
    for index in range(160):
        vehicle.advance(Command(-0.3 if index > 80 else 0.0, 0.7))
    assert 1e-4 < abs(bend()) < 0.05
    for _ in range(300):
        vehicle.advance(Command(0.0, 0.0))
    assert abs(bend()) < 1e-4


@pytest.mark.parametrize(("kappa_speed", "left"), [(0.4, 0.0), (0.0, -0.6), (0.5, 0.5), (8.0, 8.0)])
def test_tyre_forces_stay_in_the_friction_circle_and_oppose_slip(kappa_speed: float, left: float) -> None:
    """Held at constant slip, forces settle at the closed form: friction x tanh(demand) along the slip."""
    forward, load = 10.0, 2500.0
    tyre = Tyre(P, driven=False)
    for _ in range(2000):
        tyre.spin = (forward + kappa_speed) / P.tyre_radius
        ahead, across = tyre.step(forward, left, load, 0.0, 1e-3)
    wanted = np.array([P.slip_stiffness * kappa_speed / forward, -P.cornering_stiffness * left / forward])
    demand = np.hypot(*wanted) / P.friction
    if demand < 3.0:
        expected = load * wanted * math.tanh(demand) / demand
        assert (ahead, across) == pytest.approx(tuple(expected), rel=0.02, abs=1.0)
    assert math.hypot(ahead, across) <= P.friction * load * 1.0001
    assert ahead * kappa_speed >= 0.0 and across * left <= 0.0


def test_history_and_other_cars_leave_no_trace() -> None:
    commands = [Command(0.2 * math.sin(i / 9), 0.8) for i in range(80)]
    first = drive(commands)
    other = SoftbodyVehicle()
    other.reset(5.0, 5.0, 1.0, np.random.default_rng(1))
    other.advance(Command(1.0, 1.0))
    vehicle = SoftbodyVehicle()
    vehicle.reset(9.0, 9.0, 2.0, np.random.default_rng(2))
    vehicle.advance(Command(-1.0, 1.0))
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    for command, expected in zip(commands, first[1:], strict=True):
        other.advance(command)
        vehicle.advance(command)
        assert vehicle.state() == expected
