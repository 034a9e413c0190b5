# SPDX-License-Identifier: Apache-2.0
"""The 1:16 car by textbook formulas, and fits by known parameters, windows by rollouts, logs by their contents."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from benchmarks.twin_drives import coast, hard_bends, hidden_and_start, manoeuvres, random_commands, simulated_recording
from progress_lines import ProgressLines
from tests.observations import drive
from tubs import write_tub

from ds_bags.rosbag2_writer import Rosbag2Writer, topic_of
from ds_report.error_pictures import draw_fit
from ds_sim.simulator import FRAME_TIME, CommandError
from ds_twin_donkey.car_files import ParameterFileError, document_of, read_parameters, write_parameters
from ds_twin_donkey.dynamics import SUBSTEPS, CarState, rollout
from ds_twin_donkey.fit import FitSettings, Mounting, _Phases, find_mounting, fit, fit_located, rough_start
from ds_twin_donkey.logs import Log, LogError, LogSegment, drives_of, read_log
from ds_twin_donkey.parameters import GRAVITY, SCALE, DonkeyParameters
from ds_twin_donkey.residuals import Problem
from ds_twin_donkey.simulator import DonkeySimulator, DonkeyVehicle
from ds_twin_donkey.windows import RUN_IN, UNKNOWNS, FitError, Windows

P = DonkeyParameters()
MOTION_CAPTURE = (0.001, 0.001, 0.003, 0.005, 0.01)
"""Standard deviation per channel: m, m, rad, m/s, rad/s."""


def rows_of(commands: np.ndarray, extra: dict[str, np.ndarray], *, mode: str = "user") -> list[dict[str, Any]]:
    driver = "user" if mode == "user" else "pilot"
    columns = {f"{driver}/angle": commands[:, 0], f"{driver}/throttle": commands[:, 1], **extra}
    rows: list[dict[str, Any]] = pd.DataFrame(columns).assign(**{"user/mode": mode}).to_dict("records")
    return rows


def tub_of(folder: Path, commands: np.ndarray, extra: dict[str, np.ndarray], *, mode: str = "user") -> Path:
    return write_tub(folder, rows_of(commands, extra, mode=mode), deleted=[3])


def test_a_window_from_rest_is_the_rollout() -> None:
    cars = [
        P,
        P.changed(command_delay=0.1115, friction=0.5, servo_backlash=0.05, steering_trim=0.02),
        P.changed(command_delay=0.0, full_duty=0.5, drag_brake=0.3),
    ]
    commands = random_commands(np.random.default_rng(3), 4.0)
    drive = LogSegment(commands=commands, measured=rollout(P, commands)[:-1, [0, 1, 2, 3, 5]], from_rest=True)
    windows = Windows([drive], P, 3.0, 3.0, 0.2)
    paths = windows.predict(cars, np.zeros((3, 1, UNKNOWNS)), SUBSTEPS)[:, 0]
    for car, path in zip(cars, paths, strict=True):
        trimmed = CarState(servo=car.steering_trim, steering_angle=car.steering_trim)
        expected = rollout(car, commands, trimmed)[RUN_IN : RUN_IN + 60, [0, 1, 2, 3, 5]]
        np.testing.assert_allclose(path, expected, rtol=0, atol=1e-11)


def test_a_path_is_a_smooth_function_of_the_delay() -> None:
    """Also within a step: a step function would have a local minimum at every step."""
    steering = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 10), 6)
    commands = np.column_stack((steering, np.full(60, 0.5)))
    headings = [rollout(P.changed(command_delay=d), commands)[-1, 2] for d in np.linspace(0.040, 0.045, 11)]
    steps = np.diff(headings)
    assert steps.std() < 0.2 * abs(steps.mean())


@pytest.mark.long
def test_true_parameters_are_recovered_from_a_start_30_percent_off() -> None:
    """Ten parameters at once within 5%; `benchmarks/twin_fit.py` fits all, with tracker noise and several seeds."""
    names = (
        "max_steering_angle", "steering_trim", "servo_rate", "command_delay", "full_duty", "stall_force", "motor_lag",
        "rolling_resistance", "friction", "rear_stiffness",
    )  # fmt: skip
    rng = np.random.default_rng(1)
    hidden, start = hidden_and_start(list(names), rng)
    drive = simulated_recording(P.changed(**hidden), rng, manoeuvres(rng)[:400], MOTION_CAPTURE)
    found = fit([drive], P.changed(**start), FitSettings(window_seconds=2.0, max_evaluations=6, names=names))
    inside = 0
    for e in found.estimates:
        size = 0.05 if e.name == "steering_trim" else hidden[e.name]
        assert e.status == "fitted", e
        assert abs(e.value - hidden[e.name]) <= 0.05 * size, e
        inside += e.low <= hidden[e.name] <= e.high
    # Of ten 95% intervals, fewer than 8 contain the true value with a probability of 1 in 90.
    assert inside >= 8
    assert found.rms["x"] == pytest.approx(0.001, rel=0.15) and found.rms["yaw_rate"] == pytest.approx(0.01, rel=0.15)
    assert all(ratio < 1.3 for ratio in found.misfit.values())


@pytest.mark.long
def test_parameters_not_determined_by_a_straight_drive_stay_at_their_start(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    commands = np.column_stack((np.zeros(120), np.repeat(rng.uniform(0.2, 0.8, 6), 20)))
    states = rollout(P, commands)[:-1, [0, 1, 2, 3, 5]] + rng.normal(size=(120, 5)) * MOTION_CAPTURE
    drives = drives_of(np.linspace(0.0, 119 * FRAME_TIME, 120), commands, states)
    begin = P.changed(friction=0.7, servo_rate=4.0)
    names = ("friction", "servo_rate", "front_stiffness", "max_steering_angle", "full_duty", "stall_force")
    found = fit(drives, begin, FitSettings(window_seconds=2.0, names=names))
    by_name = {e.name: e for e in found.estimates}
    assert not {n for n in ("friction", "servo_rate", "front_stiffness", "max_steering_angle") if by_name[n].determined}
    assert found.parameters.friction == 0.7 and found.parameters.servo_rate == 4.0
    assert by_name["full_duty"].determined and by_name["full_duty"].value == pytest.approx(P.full_duty, rel=0.05)

    log = Log(name="straight", kind="bag", sha256="0" * 64, drives=drives)
    document = document_of(found, [log])
    assert document["parameters"]["friction"]["status"] == "not determined"
    assert document["parameters"]["wheelbase"] == {"value": P.wheelbase, "status": "held"}
    file = tmp_path / "car.yaml"
    write_parameters(file, document)
    car, digest = read_parameters(file)
    assert car.full_duty == pytest.approx(found.parameters.full_duty, rel=1e-5) and car.friction == 0.7
    spec = DonkeySimulator.from_file(file).spec
    assert spec.extra["car"] == f"car.yaml sha256 {digest}"
    draw_fit(found, tmp_path / "fit.png")
    draw_fit(found, tmp_path / "again.png")
    assert (tmp_path / "fit.png").read_bytes() == (tmp_path / "again.png").read_bytes()


def test_a_tub_with_positions_is_read_and_one_without_is_refused(tmp_path: Path) -> None:
    commands = random_commands(np.random.default_rng(5), 2.0)
    x = np.arange(40.0)
    motion = {"pos/pos_x": x, "pos/pos_z": 2.0 * x, "pos/speed": np.full(40, 20.0 * 5.0**0.5)}
    (drive,) = read_log(tub_of(tmp_path / "a", commands, motion)).drives
    # The deleted row 3 is bridged: the command before it is held, measurements are interpolated.
    assert drive.commands.shape == (40, 2) and drive.measured[3, :2] == pytest.approx([3.0, 6.0])
    np.testing.assert_array_equal(drive.commands[3], commands[2])
    np.testing.assert_array_equal(np.delete(drive.commands, 3, axis=0), np.delete(commands, 3, axis=0))
    assert np.isnan(drive.measured[:, [2, 4]]).all()
    piloted = read_log(tub_of(tmp_path / "p", commands, {"enc/speed": x}, mode="local"))
    np.testing.assert_array_equal(piloted.drives[0].commands, drive.commands)
    with pytest.raises(LogError, match="no motion can be fitted"):
        read_log(tub_of(tmp_path / "b", commands, {}))


def test_rows_without_numbers_are_left_out(tmp_path: Path) -> None:
    rolling = {"pos/pos_x": np.zeros(60), "pos/pos_z": 0.05 * np.arange(60.0), "pos/speed": np.ones(60)}
    rows = rows_of(np.tile((0.1, 0.4), (60, 1)), rolling)
    for row, name, wrong in ((20, "user/angle", "left"), (40, "user/throttle", math.inf), (50, "pos/speed", math.nan)):
        rows[row][name] = wrong
    drives = read_log(write_tub(tmp_path / "t", rows, deleted=[3])).drives
    assert [len(drive.commands) for drive in drives] == [20, 19, 19]
    assert [int(np.isnan(drive.measured[:, 3]).sum()) for drive in drives] == [0, 0, 1]


def test_a_missing_heading_does_not_affect_later_ones() -> None:
    times, measured, expected = np.arange(40.0) * FRAME_TIME, np.ones((40, 5)), np.arange(40.0) * 0.3
    expected[7] = np.nan
    measured[:, 2] = (expected + np.pi) % (2.0 * np.pi) - np.pi
    (drive,) = drives_of(times, np.tile((0.0, 0.3), (40, 1)), measured)
    np.testing.assert_allclose(drive.measured[:, 2], expected, rtol=0, atol=1e-9)


def test_a_left_turn_of_a_tub_is_a_left_turn_of_the_car(tmp_path: Path) -> None:
    """By hand: ahead is z, so a quarter of a circle to the left goes from (0, 0) to x = -1, z = 1; steering is -0.5."""
    turn = np.linspace(0.0, 0.5 * np.pi, 60)
    x, z = np.cos(turn) - 1.0, np.sin(turn)
    commands = np.tile((-0.5, 0.4), (60, 1))
    (drive,) = read_log(tub_of(tmp_path / "left", commands, {"pos/pos_x": x, "pos/pos_z": z})).drives

    def bend(path: np.ndarray) -> float:
        first, last = path[1] - path[0], path[-1] - path[-2]
        return float(first[0] * last[1] - first[1] * last[0])

    driven = rollout(P, drive.commands)
    assert driven[-1, 2] > 0.3 and bend(driven[20:, :2]) > 0.0
    assert bend(drive.measured[:, :2]) > 0.0


def test_tubs_without_throttle_or_of_inconsistent_units_are_refused(tmp_path: Path) -> None:
    rows = [{"user/mode": "user", "user/angle": 0.1, "pos/speed": 1.0}] * 60
    with pytest.raises(LogError, match="t: no record has throttle, without which nothing is known"):
        read_log(write_tub(tmp_path / "t", rows))
    motion = {"pos/pos_x": np.arange(40.0) * 0.05, "pos/pos_z": np.zeros(40), "pos/speed": np.full(40, 8.0)}
    with pytest.raises(LogError, match=r"0\.125 times as fast as its speed says: record both in metres"):
        read_log(tub_of(tmp_path / "t", np.tile((0.0, 0.5), (40, 1)), motion))


def test_bags_of_another_vehicle_and_of_several_runs_are_refused(tmp_path: Path) -> None:
    Rosbag2Writer(tmp_path / "bag", {}).close({"simulator": "bullet"})
    with pytest.raises(LogError, match="a drive of bullet, which is not a 1:16 car"):
        read_log(tmp_path / "bag")
    writer = Rosbag2Writer(tmp_path / "runs", {})
    for run in ("a", "b"):
        writer.channel(topic_of(f"/{run}/ds1/state", "ds_interfaces/msg/VehicleState", depth=1))
    writer.close({})
    with pytest.raises(LogError, match="states of 2 runs.*give bags of one run"):
        read_log(tmp_path / "runs")


def test_wheels_at_an_end_of_the_play_do_not_stop_the_fit() -> None:
    """A standing car with more trim than play has its wheels there, where derivatives vanish."""
    rng = np.random.default_rng(5)
    car = P.changed(steering_trim=-0.012, servo_backlash=0.014)
    drive = simulated_recording(car, rng, np.concatenate((coast(1.0, 0.2), hard_bends(rng, 1.8))), MOTION_CAPTURE)
    problem = Problem(Windows([drive], car, 2.5, 10.0, 0.1), car, 10)
    problem.sigma = np.array(MOTION_CAPTURE)
    names, eta = ["full_duty", "steering_trim"], problem.windows.initial_states.copy()
    eta[:, -1] = 1.0
    theta, states = problem.solve(names, np.array([0.01, 0.02]), eta, 8, 1e-5, lambda _: None)
    assert np.abs(states[:, -1]).max() <= 1.0
    off = [abs(v - getattr(car, n)) for n, v in zip(names, problem.values(names, theta), strict=True)]
    widths = problem.widths(names, problem.information(*problem.jacobian(names, theta, states)[:2]))
    assert all(np.array(off) <= 2.0 * np.array(widths))
    count = problem.windows.known.sum()
    assert np.square(problem.residuals(names, theta, states)).sum() == pytest.approx(count, rel=0.25)


def test_gaps_and_reverse_throttle_end_a_drive() -> None:
    times = np.linspace(0.0, 59 * FRAME_TIME, 60)
    times[20:] += 1.0
    commands = np.tile((0.0, 0.3), (60, 1))
    commands[40:45, 1] = -0.5
    drives = drives_of(times, commands, np.ones((60, 5)))
    assert [len(d.commands) for d in drives] == [20, 20, 15]


def located_drive(car: DonkeyParameters, mounting: Mounting, rng: np.random.Generator, frames: int) -> LogSegment:
    """A drive whose poses are those of another point, noisy, and smoothed over five images."""
    commands = np.column_stack((np.repeat(rng.uniform(-0.7, 0.7, frames // 5), 5), np.full(frames, 0.5)))
    poses = mounting.to_pose(rollout(car, commands)[:-1, [0, 1, 2, 3, 5]])
    poses = poses + rng.normal(size=poses.shape) * (0.01, 0.01, 0.03, 0.1, 0.2)
    smooth = np.column_stack([np.convolve(column, np.ones(5) / 5, "valid") for column in poses.T])
    return LogSegment(commands=commands[2:-2], measured=smooth, from_rest=False)


@pytest.mark.parametrize(("lock", "delay", "full_duty"), [(0.42, 0.19, 0.19), (0.57, 0.06, 0.6)])
def test_camera_and_start_are_found_from_smoothed_poses(lock: float, delay: float, full_duty: float) -> None:
    """At 0.7 and 2 m/s; the second motor is three times as strong as the nominal one, beyond what a fit reaches."""
    car = P.changed(max_steering_angle=lock, command_delay=delay, full_duty=full_duty)
    true = Mounting(forward=0.08, yaw=-0.02)
    drive = located_drive(car, true, np.random.default_rng(4), 600)
    found = find_mounting([drive], P)
    assert found.forward == pytest.approx(0.08, abs=0.02) and found.yaw == pytest.approx(-0.02, abs=0.005)
    start = rough_start(found.centred([drive]), P)
    assert start.full_duty == pytest.approx(full_duty, rel=0.3)
    assert 0.7 < start.max_steering_angle / lock < 1.4 and 0.4 < start.command_delay / delay < 2.5


def test_a_located_recording_is_known_by_its_table_and_refused_if_short(tmp_path: Path) -> None:
    drive = located_drive(P, Mounting(), np.random.default_rng(6), 20)
    assert find_mounting([], P) == Mounting()
    with pytest.raises(FitError, match="record longer ones"):
        fit_located([drive])
    path = tmp_path / "located.csv"
    rows = [f"{0.05 * k},0.1,0.5,{0.1 * k},0.01" for k in range(4)]
    for column, kind in (("std_lateral_m", "located"), ("note", "table")):
        path.write_text("\n".join([f"time_s,steering,throttle,x_m,{column}", *rows]))
        assert read_log(tmp_path).kind == kind


def test_poses_are_moved_to_the_car_and_back() -> None:
    """A point 0.1 m ahead of a car at the origin that looks along y, and looks 0.2 rad to the left of it."""
    mounting, car = Mounting(forward=0.1, yaw=0.2), np.array([[0.0, 0.0, np.pi / 2, 1.0, 0.5]])
    pose = mounting.to_pose(car)
    assert pose[0] == pytest.approx([0.0, 0.1, np.pi / 2 + 0.2, 1.0, 0.5])
    assert mounting.to_car(pose) == pytest.approx(car)


def test_a_table_of_motion_is_a_log(tmp_path: Path) -> None:
    path = tmp_path / "located.csv"
    rows = [f"{0.05 * k},{0.1 * k},0,1,0.25,0.5,{0.02 if k else ''}" for k in range(40)]
    path.write_text("\n".join(["time_s,x_m,y_m,note,steering,throttle,yaw_rad", *rows]))
    (drive,) = read_log(tmp_path).drives
    assert drive.commands[7].tolist() == [0.25, 0.5] and len(drive.measured) == 40
    assert drive.measured[7, :3] == pytest.approx([0.7, 0.0, 0.02]) and np.isnan(drive.measured[0, 2:]).all()
    for text in ("time_s,steering\n1,2\n", "time_s,steering,throttle\n1,2,x\n", "time_s,steering,throttle\n1,0,0\n"):
        path.write_text(text)
        with pytest.raises(LogError, match="located.csv: ") as caught:
            read_log(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("frames", "said"), [(20, "record longer ones"), (100, "drives in which the car moves")])
def test_short_drives_and_those_of_a_standing_car_are_refused(frames: int, said: str) -> None:
    standing = simulated_recording(P, np.random.default_rng(0), np.zeros((frames, 2)))
    with pytest.raises(FitError, match=said):
        fit([standing])


def test_bad_logs_and_files_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such log"):
        read_log(tmp_path / "none")
    with pytest.raises(LogError, match="no bag .*, Donkey Car tub"):
        read_log(tmp_path)
    (tmp_path / "metadata.yaml").write_text("nonsense")
    with pytest.raises(LogError, match=r"is not as rosbag2 writes it .*copy the bag again$"):
        read_log(tmp_path)
    for text, message in (
        ("a: [", "not YAML"),
        ("a: 1", "not a file of"),
        ("format: ds_twin_donkey parameters 1\nparameters: {mass: {value: heavy}}", "mass has the value 'heavy'"),
        ("format: ds_twin_donkey parameters 1\nparameters: {weight: {value: 1}}", "weight is not a parameter"),
        ("format: ds_twin_donkey parameters 1\nparameters: {mass: {value: .nan}}", "mass is nan"),
    ):
        (tmp_path / "car.yaml").write_text(text)
        with pytest.raises(ParameterFileError, match=message) as caught:
            read_parameters(tmp_path / "car.yaml")
        assert "\n" not in str(caught.value)


def test_a_fit_says_how_long_it_still_takes() -> None:
    """Iterations of 2 s; those of the second phase are taken to last twice, of the third 4 times as long."""
    told = ProgressLines()
    phases = _Phases(told, first=1)
    phases.begin(1, "windows")
    for number in range(6):
        phases.iterated(f"iteration {number}")
    assert told.total == 4 * 1 + 4 * 2 + 8 * 4 and told.done == 3.875  # more than usual share what is left
    phases.begin(2, "windows")
    phases.iterated("iteration 0")
    assert told.done == 6.0 and told.lines[-2:] == ["phase 2 of 3: windows", "iteration 0"]


X, Y, YAW, SPEED, SERVO, WHEELS = map(CarState._fields.index, ("x", "y", "yaw", "speed", "servo", "steering_angle"))


def standing() -> DonkeyVehicle:
    car = DonkeyVehicle(P)
    car.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    return car


def test_the_vehicle_is_the_rollout_in_road_metres() -> None:
    car, time = standing(), np.arange(100) * FRAME_TIME
    commands = np.column_stack((0.8 * np.sin(2.0 * time), 0.3 + 0.2 * np.cos(0.7 * time)))
    driven = [drive(car, 1, *command)[0] for command in commands.tolist()]
    states = [(s.x / SCALE, s.y / SCALE, s.yaw, s.speed / SCALE) for s in driven]
    np.testing.assert_allclose(states, rollout(P, commands)[1:, [X, Y, YAW, SPEED]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("share", [0.5, 0.6])
def test_reset_places_the_centre_of_the_car(share: float) -> None:
    car = DonkeyVehicle(P.changed(front_share=share))
    car.reset(7.0, 5.0, 2.0, np.random.default_rng(0))
    state = car.state()
    assert (state.x, state.y, state.yaw) == pytest.approx((7.0, 5.0, 2.0))
    assert (state.speed, state.yaw_rate, state.lateral_speed, state.roll, state.pitch) == (0.0,) * 5


@pytest.mark.parametrize("steering", [-1.0, 0.0, 1.0])
def test_the_smallest_throttle_above_the_dead_band_moves_it_even_at_full_lock(steering: float) -> None:
    first_count = math.ceil(P.throttle_dead_band * P.throttle_pulse_steps) / P.throttle_pulse_steps
    last = drive(standing(), 200, steering, first_count)[-1]
    assert math.hypot(last.speed, last.lateral_speed) > 0.3


def test_the_steady_speed_balances_motor_and_rolling_resistance() -> None:
    """stall (duty - v / free) = c m g."""
    throttle = 0.4
    last = drive(standing(), 200, 0.0, throttle)[-1]
    above = (throttle - P.throttle_dead_band) / (1.0 - P.throttle_dead_band)
    duty = P.start_duty + (P.full_duty - P.start_duty) * above
    speed = P.free_speed * (duty - P.rolling_resistance * P.mass * GRAVITY / P.stall_force)
    assert last.speed == pytest.approx(SCALE * speed, rel=1e-3)


def test_the_body_rolls_outwards_by_the_angle_its_springs_give() -> None:
    """Roll angle = m h a / (k - m g h), where the natural frequency gives k - m g h = I (2 pi f)^2."""
    last = drive(standing(), 200, -0.5, 0.4)[-1]
    lateral = last.yaw_rate * math.hypot(last.speed, last.lateral_speed) / SCALE
    stiffness = P.roll_inertia * (math.tau * P.roll_frequency) ** 2
    assert last.roll == pytest.approx(P.mass * P.centre_of_mass_height * lateral / stiffness, rel=0.03)


def test_a_command_arrives_after_its_delay_and_no_earlier() -> None:
    for delay, frames in ((0.0, 0), (0.05, 1), (0.12, 2)):
        states = rollout(P.changed(command_delay=delay), np.tile((-1.0, 0.0), (6, 1)))
        assert np.flatnonzero(states[1:, SERVO])[0] == frames


def test_the_servo_rate_is_limited() -> None:
    servo = rollout(P, np.tile((1.0, 0.0), (12, 1)))[:, SERVO]
    assert np.abs(np.diff(servo)).max() == pytest.approx(P.servo_rate * FRAME_TIME, rel=1e-9)
    assert servo[-1] == pytest.approx(-P.max_steering_angle, rel=1e-3)


def test_wheels_do_not_move_until_the_play_is_taken_up() -> None:
    commands = np.concatenate((np.tile((0.5, 0.0), (20, 1)), np.tile((0.5 - 1.5 / 85, 0.0), (20, 1))))
    wheels = rollout(P, commands)[:, WHEELS]
    back = 0.5 - round(85 * (0.5 - 1.5 / 85)) / 85
    assert abs(back) * P.max_steering_angle < P.servo_backlash
    assert wheels[-1] == pytest.approx(wheels[20], abs=1e-6)


def test_invalid_parameters_and_commands_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^mass is nan, expected a number from 1e-06 to inf: correct it$"):
        P.changed(mass=math.nan)
    with pytest.raises(ValueError, match=r"^wheel_base is not a parameter of the car"):
        P.changed(wheel_base=0.2)
    with pytest.raises(ValueError, match=r"^commands have shape \(3,\), expected \(n, 2\)"):
        rollout(P, np.zeros(3))
    with pytest.raises(CommandError):
        rollout(P, [(0.0, math.nan)])
