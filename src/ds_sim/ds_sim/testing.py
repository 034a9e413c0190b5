# SPDX-License-Identifier: Apache-2.0
"""Conformance checks for simulators: what every simulator promises, as a function to call on your own.

    from ds_sim.testing import check_simulator
    check_simulator("my_module:MySimulator")

The checks know nothing of the simulator but its contract (`ds_sim.simulator.Simulator`).
"""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
from collections.abc import Callable, Collection, Mapping
from contextlib import closing
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_road import Road, RoadError, generate
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.registry import UnknownSimulatorError, make_simulator
from ds_sim.simulator import (
    FRAME_TIME,
    MAX_SPEED,
    AutopilotGains,
    Command,
    Observation,
    Outcome,
    Simulator,
    SimulatorError,
)

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(9)])
"""A straight road of 150 m, driven towards +y; its right lane lies at x = 127 m."""
WINDING = generate(np.random.default_rng(11), max_angle=150)
"""A random road with bends to both sides."""
CROSSING = Road([(50, 50), (50, 100), (50, 150), (100, 150), (100, 110), (20, 110), (10, 60)])
"""A road that meets itself, which every simulator refuses."""
MEMORY_LIMIT = 24e6
"""Bytes by which a process may grow over 16 loaded roads; one kept road of 200 m is some 40 MB of painted ground."""

Factory = Callable[[], Simulator]
Driver = Callable[[Observation], Command]


class SimulatorCheckError(AssertionError):
    """A simulator that does not do what every simulator promises; one line for each failed check."""


def check_simulator(make: Factory | str, *, skip: Collection[str] = ()) -> None:
    """Check that a simulator fulfils the contract, as every simulator of this project does.

    It takes 5 to 30 s. `CHECKS` names the checks; each makes a simulator of its own and closes it.

    Args:
        make: class or function without arguments that makes the simulator and that another process can import, or the
            simulator's name or `module:Class`.
        skip: names of checks to leave out, such as `image_shows_the_scene` for a simulator with a renderer of its own.

    Raises:
        SimulatorCheckError: at least one check failed; the text names each with what was found and what was expected.
        ValueError: `skip` names no check.
    """
    unknown = sorted(set(skip) - set(CHECKS))
    if unknown:
        raise ValueError(f"unknown check {', '.join(unknown)}: expected some of {', '.join(CHECKS)}")
    failures = []
    for name in CHECKS:
        if name not in skip:
            try:
                run_check(name, make)
            except SimulatorCheckError as error:
                failures.append(str(error))
    if failures:
        raise SimulatorCheckError("\n".join(failures))


@cache
def missing_because(name: str) -> str:
    """Why a simulator cannot be made here, one line, such as an engine that is not installed; "" if it can."""
    try:
        make_simulator(name).close()
    except (UnknownSimulatorError, SimulatorError) as error:
        return str(error)
    return ""


def run_check(name: str, make: Factory | str) -> None:
    """Run one of `CHECKS`, by its key, on a simulator as `check_simulator` takes it.

    Raises:
        SimulatorCheckError: the check failed, or the simulator raised an error.
    """
    factory = partial(make_simulator, make) if isinstance(make, str) else make
    try:
        CHECKS[name](factory)
    except SimulatorCheckError as error:
        raise SimulatorCheckError(f"{name}: {error}") from None
    except Exception as error:
        raise SimulatorCheckError(f"{name}: {type(error).__name__}: {error}") from error


def drive(simulator: Simulator, road: Road, driver: Driver, *, seed: int = 3, steps: int = 10_000) -> list[Observation]:
    """Drive a road to its end or for a number of frames, and return all observations."""
    observations = [simulator.load(road, seed=seed)]
    while observations[-1].outcome is Outcome.RUNNING and len(observations) <= steps:
        observations.append(simulator.step(driver(observations[-1])))
    return observations


def reference_driver(gains: AutopilotGains) -> Driver:
    """Return the proportional part of the paper's equation 1 with the throttle of equation 2.

    It keeps nothing from frame to frame, and shares no code with the autopilot of `ds_driver`.
    """

    def command(observation: Observation) -> Command:
        kmh = 3.6 * observation.vehicle.speed
        steering = min(max(-gains.proportional * observation.lane.preview_lateral_position, -1.0), 1.0)
        limit = gains.min_speed if kmh > gains.max_speed else gains.max_speed
        throttle = min(max(1.0 - steering**2 - (kmh / limit) ** 2, 0.0), 1.0)
        return Command(steering, 0.5 if abs(steering) == 1.0 and kmh < 0.36 else throttle)

    return command


def digest(observations: list[Observation]) -> str:
    """SHA-256 of the states and images of a run."""
    total = hashlib.sha256()
    for o in observations:
        total.update(np.array([o.vehicle.x, o.vehicle.y, o.vehicle.yaw, o.vehicle.speed, o.vehicle.roll]).tobytes())
        total.update(o.image.tobytes())
    return total.hexdigest()


def _expect(holds: bool, message: str) -> None:
    if not holds:
        raise SimulatorCheckError(message)


def _expect_error(kind: type[Exception], act: Callable[[], object], otherwise: str) -> None:
    try:
        act()
    except kind:
        return
    raise SimulatorCheckError(otherwise)


def _near(value: float, expected: float, tolerance: float) -> bool:
    return abs(value - expected) <= tolerance


def _constant(steering: float, throttle: float) -> Driver:
    return lambda observation: Command(steering, throttle)


def _after_a_second(steering: float) -> Driver:
    return lambda observation: Command(steering if observation.time > 1.0 else 0.0, 0.5)


def _winding_digest(simulator: Simulator, steps: int = 100) -> str:
    return digest(drive(simulator, WINDING, reference_driver(simulator.spec.autopilot), steps=steps))


def _digest_of(make: Factory) -> str:
    """What another process computes."""
    with closing(make()) as simulator:
        return _winding_digest(simulator)


def _on_one(check: Callable[[Simulator], None]) -> Callable[[Factory], None]:
    """Run a check on a simulator that is closed afterwards."""

    def run(make: Factory) -> None:
        with closing(make()) as simulator:
            check(simulator)

    return run


def _same_bits_again(simulator: Simulator) -> None:
    first = _winding_digest(simulator)
    drive(simulator, STRAIGHT, _constant(0.3, 1.0), seed=99, steps=30)
    _expect(
        _winding_digest(simulator) == first,
        "the same road, seed and commands gave other states or images after another road: build the world anew in load",
    )


def _same_bits_in_another_process(make: Factory) -> None:
    first = _digest_of(make)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        try:
            other = pool.apply(_digest_of, (make,))
        except (AttributeError, TypeError) as error:
            raise SimulatorCheckError(
                f"another process cannot make the simulator ({error}): give a class or function of a module"
            ) from None
    _expect(
        other == first,
        "another process computed other states or images: draw from the seed, and iterate over nothing unordered",
    )


def _noise_follows_the_seed(simulator: Simulator) -> None:
    one, other = simulator.load(WINDING, seed=1).image, simulator.load(WINDING, seed=2).image
    _expect(
        np.array_equal(one, other) == (simulator.spec.camera.noise == 0.0),
        f"camera.noise is {simulator.spec.camera.noise}, but images of two seeds are "
        f"{'equal' if np.array_equal(one, other) else 'different'}",
    )


def _reset_forgets_a_crash(simulator: Simulator) -> None:
    before = _winding_digest(simulator, 40)
    crashed = drive(simulator, WINDING, _constant(1.0, 1.0))[-1].outcome
    _expect(crashed is Outcome.OUT_OF_BOUNDS, f"full lock ended {crashed.name}, expected OUT_OF_BOUNDS")
    _expect(_winding_digest(simulator, 40) == before, "a run after a crash differs from the run before it")


def _left_is_left(simulator: Simulator) -> None:
    for steering, sign, side in ((-0.5, 1, "left"), (0.5, -1, "right")):
        after = drive(simulator, STRAIGHT, _after_a_second(steering), steps=45)[-1]
        for name, value, least in (
            ("change of yaw", after.vehicle.yaw - math.pi / 2, 0.02),
            ("steering_angle", after.vehicle.steering_angle, 0.05),
            ("yaw_rate", after.vehicle.yaw_rate, 0.0),
            ("lateral_position", -after.lane.lateral_position, 0.0),
        ):
            _expect(
                sign * value > least,
                f"steering {steering} ({side}): {name} is {value if name[0] != 'l' else -value:.3f}, of the wrong sign "
                "or too small: yaw and wheel angle are left positive (REP-103), the lateral position right positive",
            )


def _straight_stays_straight(simulator: Simulator) -> None:
    observations = drive(simulator, STRAIGHT, _constant(0.0, 0.4))
    furthest = max(abs(o.lane.lateral_position) for o in observations)
    outcome = observations[-1].outcome
    _expect(outcome is Outcome.COMPLETED, f"a straight road without steering ended {outcome.name}, expected COMPLETED")
    _expect(furthest < 0.3, f"without steering the car strayed {furthest:.2f} m, expected less than 0.3 m")


def _units_agree(simulator: Simulator) -> None:
    observations = drive(simulator, STRAIGHT, _constant(0.0, 0.6), steps=160)
    _expect(len(observations) > 80, f"the run ended after {len(observations) - 1} frames, expected more than 80")
    first, last = observations[60], observations[-1]
    _expect(last.step == len(observations) - 1, f"step is {last.step}, expected {len(observations) - 1}")
    _expect(
        _near(last.time, last.step * FRAME_TIME, 1e-6), f"time is {last.time} s, expected {last.step * FRAME_TIME} s"
    )
    distance = math.hypot(last.vehicle.x - first.vehicle.x, last.vehicle.y - first.vehicle.y)
    measured = distance / (last.time - first.time)
    mean_speed = float(np.mean([o.vehicle.speed for o in observations[61:]]))
    _expect(
        _near(measured, mean_speed, 0.05 * mean_speed),
        f"positions move at {measured:.2f} m/s while speed is {mean_speed:.2f} m/s: both in road metres",
    )
    arc = last.lane.arc_length - first.lane.arc_length
    _expect(_near(arc, distance, 0.02 * distance), f"arc_length grew by {arc:.2f} m over {distance:.2f} m")
    _expect(2.0 < last.vehicle.speed < 20.0, f"speed at throttle 0.6 is {last.vehicle.speed:.2f} m/s, expected 2 to 20")


def _run_begins_at_rest(simulator: Simulator) -> None:
    first = simulator.load(STRAIGHT, seed=1)
    _expect(
        (first.step, first.time, first.outcome) == (0, 0.0, Outcome.RUNNING),
        f"the first frame has step {first.step}, time {first.time} and outcome {first.outcome.name}, "
        "expected 0, 0.0 and RUNNING",
    )
    for name, value, expected, tolerance in (
        ("x", first.vehicle.x, 127.0, 0.02),
        ("y", first.vehicle.y, 25.0, 0.05),
        ("yaw", first.vehicle.yaw, math.pi / 2, 1e-3),
        ("speed", first.vehicle.speed, 0.0, 0.05),
        ("lateral_distance", first.lane.lateral_distance, 2.0, 0.02),
    ):
        _expect(_near(value, expected, tolerance), f"the run begins with {name} {value:.4f}, expected {expected:.4f}")


def _the_left_lane_is_driven(simulator: Simulator) -> None:
    """Of a road that says so: the run begins in the middle of it, and right of it is positive."""
    first = simulator.load(STRAIGHT.in_lane("left"), seed=1)
    _expect(
        _near(first.vehicle.x, 123.0, 0.02) and _near(first.lane.lateral_distance, 2.0, 0.02),
        f"in the left lane the run begins at x {first.vehicle.x:.2f} with lateral_distance "
        f"{first.lane.lateral_distance:.2f}, expected 123 and 2: drive along road.lane_centre",
    )
    last = drive(simulator, STRAIGHT.in_lane("left"), _constant(0.2, 0.6), seed=1, steps=60)[-1]
    _expect(
        _near(last.lane.lateral_position, last.vehicle.x - 123.0, 0.02) and last.vehicle.x > 123.2,
        f"in the left lane lateral_position is {last.lane.lateral_position:.2f} at x {last.vehicle.x:.2f}, "
        f"expected {last.vehicle.x - 123.0:.2f}, right positive",
    )


def _standing_still_is_stuck(simulator: Simulator) -> None:
    last = drive(simulator, STRAIGHT, _constant(0.0, 0.0))[-1]
    _expect(last.outcome is Outcome.STUCK, f"without throttle the run ended {last.outcome.name}, expected STUCK")
    _expect(_near(last.time, 10.0, 1e-5), f"it was stuck after {last.time} s, expected 10 s")
    _expect(last.lane.arc_length < 0.2, f"without throttle it moved {last.lane.arc_length:.2f} m")


def _leaving_the_lane_ends_the_run(simulator: Simulator) -> None:
    observations = drive(simulator, STRAIGHT, _constant(0.4, 0.6))
    last = observations[-1]
    _expect(last.outcome is Outcome.OUT_OF_BOUNDS, f"the run ended {last.outcome.name}, expected OUT_OF_BOUNDS")
    _expect(last.lane.lateral_distance < 0.0, "the run ended OUT_OF_BOUNDS inside the lane")
    _expect(all(o.lane.lateral_distance >= 0.0 for o in observations[:-1]), "the run went on outside the lane")
    after = "step after the end of a run was accepted, expected a SimulatorError"
    _expect_error(SimulatorError, lambda: simulator.step(Command(0.0, 0.0)), after)


def _image_has_the_right_type(simulator: Simulator) -> None:
    image = simulator.load(STRAIGHT, seed=1).image
    _expect(
        image.shape == (IMAGE_HEIGHT, IMAGE_WIDTH, 3) and image.dtype == np.uint8,
        f"the image is {image.shape} {image.dtype}, expected {(IMAGE_HEIGHT, IMAGE_WIDTH, 3)} uint8",
    )
    _expect(not image.flags.writeable, "the image is writable: image.setflags(write=False)")


def _image_shows_the_scene(simulator: Simulator) -> None:
    """The paper's scene: bright above the horizon, white edge to the right of the car, yellow line to the left."""
    image = simulator.load(STRAIGHT, seed=1).image
    rows = slice(simulator.spec.crop_top, IMAGE_HEIGHT - simulator.spec.crop_bottom)
    pixels = image[rows].astype(int)
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    yellow = (red - blue > 60) & (green - blue > 40)
    white = (pixels.min(axis=2) > 150) & (pixels.max(axis=2) - pixels.min(axis=2) < 45)
    _expect(yellow.sum() > 50 and white.sum() > 50, "the image shows no yellow or no white line")
    yellow_column, white_column = np.argwhere(yellow)[:, 1].mean(), np.argwhere(white)[:, 1].mean()
    _expect(
        yellow_column < 160 < white_column + 60,
        f"yellow line at column {yellow_column:.0f}, white one at {white_column:.0f}, expected them left and right",
    )
    top = image[:10].astype(int)
    _expect(top.mean() > 60, "the image is dark above the horizon")
    _expect((top[..., 1] - top[..., [0, 2]].max(axis=2)).mean() < 10, "there is grass above the horizon")


def _drawn_rows_are_the_same(simulator: Simulator) -> None:
    pilot = reference_driver(simulator.spec.autopilot)

    def images(driver: Driver = pilot) -> NDArray[np.uint8]:
        return np.stack([o.image for o in drive(simulator, WINDING, driver, steps=15)])

    def few(observation: Observation) -> Command:
        simulator.draw_images((observation.step + 1) % 4 == 0)
        return pilot(observation)

    whole = images()
    for top, bottom in ((simulator.spec.crop_top, IMAGE_HEIGHT - simulator.spec.crop_bottom), (61, 62)):
        simulator.draw_rows(top, bottom)
        part = images()
        _expect(
            np.array_equal(part[:, top:bottom], whole[:, top:bottom]),
            f"draw_rows({top}, {bottom}) changes these rows: expected the same bits as without",
        )
        outside = np.r_[0:top, bottom:IMAGE_HEIGHT]
        _expect(
            not part[:, outside].any() or np.array_equal(part, whole),
            f"draw_rows({top}, {bottom}) left other rows that are neither zero nor drawn",
        )
    simulator.draw_rows(0, IMAGE_HEIGHT)
    _expect(np.array_equal(images(), whole), f"draw_rows(0, {IMAGE_HEIGHT}) does not bring all rows back")
    some, drawn = images(few), slice(4 + simulator.spec.camera.latency, None, 4)
    simulator.draw_images(True)
    _expect(np.array_equal(some[drawn], whole[drawn]), "images differ where others are left out by draw_images(False)")
    _expect(np.array_equal(images(), whole), "draw_images(True) does not bring all images back")


def _stills_change_nothing(simulator: Simulator) -> None:
    if not simulator.takes_stills:
        return
    pilot = reference_driver(simulator.spec.autopilot)

    def driven(*, stills: bool) -> tuple[str, NDArray[np.uint8]]:
        taken = []

        def command(observation: Observation) -> Command:
            if stills:
                taken.append(np.stack((simulator.still(), simulator.still())))
            return pilot(observation)

        run = digest(drive(simulator, WINDING, command, steps=15))
        return run, np.array(taken)

    without, _ = driven(stills=False)
    with_stills, whole = driven(stills=True)
    _expect(with_stills == without, "still() changes the images or the states of the run: expected the same bits")
    _expect(np.array_equal(whole[:, 0], whole[:, 1]), "two stills of one moment differ: expected no noise in them")
    simulator.draw_rows(61, 62)
    _, part = driven(stills=True)
    simulator.draw_rows(0, IMAGE_HEIGHT)
    _expect(np.array_equal(part, whole), "draw_rows(61, 62) changes stills: expected all of their rows")


def _reference_driver_completes(simulator: Simulator) -> None:
    for road, way in ((WINDING, "forwards"), (WINDING.reversed(), "backwards")):
        outcome = drive(simulator, road, reference_driver(simulator.spec.autopilot))[-1].outcome
        _expect(
            outcome is Outcome.COMPLETED,
            f"the reference driver ended {outcome.name} on a winding road driven {way}: check spec.autopilot",
        )


def _speed_has_a_limit(simulator: Simulator) -> None:
    """The throttle law holds every vehicle at 30 km/h (paper 4.2.4), give or take what a frame's delay adds."""
    observations = drive(simulator, STRAIGHT, reference_driver(simulator.spec.autopilot))
    fastest = max(o.vehicle.speed for o in observations)
    _expect(4.0 < fastest < 1.1 * MAX_SPEED, f"top speed is {fastest:.2f} m/s, expected 4 to {1.1 * MAX_SPEED:.2f}")


def _memory_does_not_grow(simulator: Simulator) -> None:
    roads = [generate(np.random.default_rng(seed), max_angle=120) for seed in range(4)]

    def memory_after(times: int) -> int:
        for index in range(times):
            drive(simulator, roads[index % len(roads)], _constant(0.0, 0.5), steps=3)
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    settled = memory_after(12)
    grown = memory_after(16) - settled
    _expect(grown < MEMORY_LIMIT, f"16 roads took {grown / 1e6:.0f} MB more: free the last road in load")


def _bad_input_is_refused(simulator: Simulator) -> None:
    before = "step before load was accepted, expected a SimulatorError"
    _expect_error(SimulatorError, lambda: simulator.step(Command(0.0, 0.0)), before)
    crossing = "a road that crosses itself was loaded, expected a ds_road.RoadError"
    _expect_error(RoadError, lambda: simulator.load(CROSSING, seed=1), crossing)
    for after in ("a refused road", "close"):
        outcome = simulator.load(STRAIGHT, seed=1).outcome
        _expect(outcome is Outcome.RUNNING, f"load after {after} gave {outcome.name}, expected RUNNING")
        simulator.close()


CHECKS: Mapping[str, Callable[[Factory], None]] = {
    "same_bits_again": _on_one(_same_bits_again),
    "same_bits_in_another_process": _same_bits_in_another_process,
    "noise_follows_the_seed": _on_one(_noise_follows_the_seed),
    "reset_forgets_a_crash": _on_one(_reset_forgets_a_crash),
    "left_is_left": _on_one(_left_is_left),
    "straight_stays_straight": _on_one(_straight_stays_straight),
    "units_agree": _on_one(_units_agree),
    "run_begins_at_rest": _on_one(_run_begins_at_rest),
    "the_left_lane_is_driven": _on_one(_the_left_lane_is_driven),
    "standing_still_is_stuck": _on_one(_standing_still_is_stuck),
    "leaving_the_lane_ends_the_run": _on_one(_leaving_the_lane_ends_the_run),
    "image_has_the_right_type": _on_one(_image_has_the_right_type),
    "image_shows_the_scene": _on_one(_image_shows_the_scene),
    "drawn_rows_are_the_same": _on_one(_drawn_rows_are_the_same),
    "stills_change_nothing": _on_one(_stills_change_nothing),
    "reference_driver_completes": _on_one(_reference_driver_completes),
    "speed_has_a_limit": _on_one(_speed_has_a_limit),
    "memory_does_not_grow": _on_one(_memory_does_not_grow),
    "bad_input_is_refused": _on_one(_bad_input_is_refused),
}
"""Every check by name, in the order in which `check_simulator` runs them."""
