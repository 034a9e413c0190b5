# SPDX-License-Identifier: Apache-2.0
"""Conditions on every simulator, against oracles that know nothing of how they are realised.

What the world of `panda` looks like under them is tested with it, in `src/ds_sim_panda/test/test_panda_conditions.py`.

The straight road's centre line goes from (125, 25) to (125, 175) m, and its edges are 4 m to either side.

Scenes are those of the simulators with a perfect sensor (no noise, gain, blur or delay) and, where a law is measured,
without grain and with wide lines; pixels are decoded by the sRGB curve.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_sim.camera.ground import paint_ground
from ds_sim.camera.rendered_scene import PaintedScene
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import make_simulator, spec_of
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, Command, VehicleState
from ds_sim.testing import STRAIGHT, WINDING, digest, drive, reference_driver
from ds_sim_panda.simulator import PandaScene

PAINTED = ("bullet", "softbody", "donkey")
STANDING = {"yaw": math.pi / 2, "speed": 0.0, "yaw_rate": 0.0, "steering_angle": 0.0}
ALL = parse_conditions(
    "line_contrast=0.5,line_cover=0.3,illuminance=500,veiling_luminance=100,low_sun=2000,sun_azimuth=1.5,"
    "sun_elevation=0.2,shadow_density=0.3,visibility=150,pavement_reflectance=0.2,repair_share=0.2,camera_height=1.1,"
    "camera_pitch=2deg,camera_yaw=-2deg,lens_dirt=0.1,sensor_noise=4,exposure=1.2,steering_lag=0.1,command_delay=0.1,"
    "friction=0.8,payload=0.2,tyre_pull=0.002,speed_limit=25km/h"
)


def light(pixels: Any) -> NDArray[np.float64]:
    """Linear light of sRGB pixels."""
    levels = np.asarray(pixels, float) / 255.0
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def plain_look(name: str, line_width: float = 1.0) -> Any:
    return replace(spec_of(name).look, asphalt_grain=0.0, grass_grain=0.0, relief=0.0, hills=0.0, lamps=0, sun_glow=0.0,
                   line_width=line_width)  # fmt: skip


def perfect(name: str) -> Any:
    return replace(spec_of(name).camera, noise=0.0, gain=1.0, gamma=1.0, blur=0.0, exposure=0.0, latency=0)


@cache
def seen(name: str, conditions: Conditions = DEFAULT, x: float = 125.0, look: Any = None) -> NDArray[np.uint8]:
    """View along the straight road from (x, 60), read-only."""
    scene = PandaScene(perfect(name)) if name == "panda" else PaintedScene(perfect(name), look or plain_look(name))
    scene.load(STRAIGHT, np.random.default_rng(1), conditions)
    return scene.still(VehicleState(x=x, y=60.0, **STANDING), np.random.default_rng(1))


def below_horizon(name: str, row: float) -> float:
    """Angle below the horizon at which the middle column looks in a row, rad."""
    camera = perfect(name)
    offset = (row - (camera.height_px - 1) / 2) / camera.intrinsics[1, 1]
    return float(camera.pitch + (math.atan(offset) if camera.lens == "pinhole" else offset))


@pytest.mark.parametrize("name", PAINTED)
def test_contrast_falls_with_distance_as_koschmieder_says(name: str) -> None:
    visibility, clear = 60.0, seen(name)
    hazy = seen(name, Conditions(visibility=visibility))
    distances = []
    for row in range(30, 155, 4):
        angle = below_horizon(name, row)
        if angle < math.radians(2.0):
            continue
        distance = spec_of(name).camera.height / math.sin(angle)
        # The centre line fills at least 4 columns here; the pavement lies 2 m beside it, in view up close.
        focal = spec_of(name).camera.intrinsics[0, 0]
        beside = 160 + round(focal * 1.5 / distance)
        if focal / distance < 4.0 or beside > 300:
            continue
        contrast = [light(image[row, 159]) - light(image[row, beside]) for image in (clear, hazy)]
        expected = math.exp(-3.912 * math.hypot(distance, 0.75) / visibility)
        assert contrast[1][:2] == pytest.approx(contrast[0][:2] * expected, rel=0.04, abs=0.008)
        distances.append(distance)
    assert len(distances) >= 4 and max(distances) > 2.0 * min(distances)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_as_much_of_a_line_is_bare_as_is_claimed(share: float) -> None:
    look = plain_look("bullet", line_width=0.3)
    ground = paint_ground(STRAIGHT, look, conditions=Conditions(line_cover=share, line_cover_length=3.0))
    raster, (left, bottom), size = ground.levels[0], ground.origin, ground.resolution
    rows = slice(round((25.0 - bottom) / size), round((175.0 - bottom) / size))
    for x, least in ((125.0 + 3.85, 200), (125.0 - 3.85, 200), (125.0, 180)):
        line = raster[rows, round((x - left) / size - 0.5), 0]
        assert np.mean(line < least) == pytest.approx(share, abs=0.01)
        edges = np.flatnonzero(np.diff(line < least))
        assert len(edges) > 10 and np.diff(edges).min() * size > 1.0  # pieces, not specks


@pytest.mark.parametrize("contrast", [0.7, 0.3, 0.0])
def test_as_much_contrast_of_the_paint_is_left_as_is_claimed(contrast: float) -> None:
    look, found = plain_look("donkey", line_width=0.4), []
    for conditions in (DEFAULT, Conditions(line_contrast=contrast)):
        ground = paint_ground(STRAIGHT, look, conditions=conditions)
        line, pavement = (round((x - ground.origin[0]) / ground.resolution - 0.5) for x in (125.0, 126.5))
        rows = ground.levels[0][1000:3000]
        paint = light(rows[:, line - 2 : line + 3, :3]).mean(axis=(0, 1))
        found.append(paint - light(rows[:, pavement, :3]).mean(axis=0))
    assert found[1] == pytest.approx(contrast * found[0], abs=0.025)  # worn paint is blotchy


@pytest.mark.parametrize("density", [0.2, 0.6])
def test_shadows_cover_their_share_and_take_their_part_of_the_light(density: float) -> None:
    look = plain_look("softbody")
    ground = paint_ground(STRAIGHT, look, conditions=Conditions(shadow_density=density, shadow_depth=0.6))
    bottom, left, size = ground.origin[1], ground.origin[0], ground.resolution
    rows = slice(round((25.0 - bottom) / size), round((175.0 - bottom) / size))
    for x in (122.5, 127.5, 131.0):  # either lane, and the verge
        strip = light(ground.levels[0][rows, round((x - left) / size), 1])
        open_light = strip.max()
        assert np.mean(strip < 0.7 * open_light) == pytest.approx(density, abs=0.04)
        assert strip.min() == pytest.approx(0.4 * open_light, rel=0.05)


@pytest.mark.parametrize(("name", "reflectance"), [("bullet", 0.05), ("softbody", 0.35), ("donkey", 0.2)])
def test_pavement_has_the_reflectance_that_is_claimed(name: str, reflectance: float) -> None:
    image = seen(name, Conditions(pavement_reflectance=reflectance), x=127.0)
    assert light(image[150, 155:165]).mean() == pytest.approx(reflectance, rel=0.05)


def horizon(image: NDArray[np.uint8]) -> int:
    """Row in which sky turns into grass, at the left border of the image."""
    greenness = image[:, 4, 1].astype(int) - image[:, 4, 2]
    return int(np.argmax(greenness > 15))


@pytest.mark.parametrize("name", ["bullet", "softbody"])
@pytest.mark.parametrize("pitch", [-0.05, 0.03, 0.1])
def test_the_horizon_of_a_pitched_camera_moves_by_the_right_rows(name: str, pitch: float) -> None:
    camera = perfect(name)
    focal, rows = camera.intrinsics[0, 0], []
    for added in (0.0, pitch):
        rows.append((camera.height_px - 1) / 2 - focal * math.tan(camera.pitch + added))
    assert horizon(seen(name, Conditions(camera_pitch=pitch))) - horizon(seen(name)) == pytest.approx(
        max(rows[1], 0.0) - rows[0], abs=1.5
    )


@pytest.mark.parametrize("name", PAINTED)
def test_a_yawed_and_a_raised_camera_see_what_they_should(name: str) -> None:
    """The centre line far ahead moves right by the yaw; the edge line below moves in by the height."""
    camera = perfect(name)
    far = next(row for row in range(160) if below_horizon(name, row) > math.radians(3.0))

    def yellow(image: NDArray[np.uint8]) -> float:
        levels = image[far].astype(int)
        return float(np.flatnonzero(levels[:, 0] - levels[:, 2] > 0.5 * np.max(levels[:, 0] - levels[:, 2])).mean())

    yaw = 0.1
    shift = camera.intrinsics[0, 0] * (math.tan(yaw) if camera.lens == "pinhole" else yaw)
    assert yellow(seen(name, Conditions(camera_yaw=yaw))) - yellow(seen(name)) == pytest.approx(shift, rel=0.12)

    def white(image: NDArray[np.uint8]) -> float:
        return float(np.flatnonzero(image[far + 12, 160:, 2] > 170).mean())

    if camera.lens == "pinhole":
        assert white(seen(name)) / white(seen(name, Conditions(camera_height=1.5))) == pytest.approx(1.5, rel=0.06)


@pytest.mark.parametrize("name", ["bullet", "panda"])
def test_stray_light_lies_evenly_over_the_picture(name: str) -> None:
    clear, veiled = light(seen(name)), light(seen(name, Conditions(veiling_luminance=300.0)))
    # A veil adds the same light everywhere, and the exposure takes the same share of all of it.
    slope, offset = np.polyfit(clear[60:].ravel(), veiled[60:].ravel(), 1)
    assert 0.4 < slope < 1.0 and offset / slope == pytest.approx(300.0 / (10_000.0 / math.pi), rel=0.08)


def test_the_low_sun_has_its_place() -> None:
    clear = light(seen("bullet"))
    added = light(seen("bullet", Conditions(low_sun=3000.0, sun_azimuth=math.pi / 2 - 0.3, sun_elevation=0.1))) - clear
    row, column = np.unravel_index(np.argmax(added.sum(axis=2)), added.shape[:2])
    focal, pitch = perfect("bullet").intrinsics[0, 0], perfect("bullet").pitch
    assert column - 159.5 == pytest.approx(focal * math.tan(0.3) / math.cos(pitch + 0.1), abs=12)
    assert row - 79.5 == pytest.approx(-focal * math.tan(pitch + 0.1), abs=16)


def test_dirt_covers_its_share() -> None:
    for share in (0.1, 0.3):
        change = np.abs(light(seen("bullet")) - light(seen("bullet", Conditions(lens_dirt=share)))).max(axis=2)
        assert np.mean(change[:55] > 0.5 * change[:55].max()) == pytest.approx(share, abs=0.12)


STRONGER = {
    "line_contrast": (0.8, 0.4, 0.1), "line_cover": (0.2, 0.5, 0.9), "illuminance": (400.0, 100.0, 20.0),
    "veiling_luminance": (100.0, 500.0, 2500.0), "low_sun": (500.0, 3000.0, 20000.0),
    "shadow_density": (0.1, 0.4, 0.8), "visibility": (500.0, 100.0, 25.0), "repair_share": (0.1, 0.3, 0.6),
    "pavement_reflectance": (0.15, 0.3, 0.5), "lens_dirt": (0.05, 0.2, 0.5), "sensor_noise": (3.0, 10.0, 40.0),
}  # fmt: skip


@pytest.mark.parametrize("name", STRONGER)
def test_stronger_is_never_weaker(name: str) -> None:
    look = spec_of("softbody").look
    clear, changes = seen("softbody", look=look, x=127.0).astype(int), []
    for value in STRONGER[name]:
        image = seen("softbody", Conditions(**{name: value}), look=look, x=127.0)
        changes.append(float(np.abs(image - clear).mean()))
    assert 0.0 < changes[0] < changes[1] < changes[2]


MU = {"bullet": 0.9, "softbody": 1.0, "donkey": 0.85}
"""Friction coefficients of the published data of each car."""


@pytest.mark.parametrize("name", MU)
def test_less_friction_lowers_the_grip_limit(name: str) -> None:
    vehicle: Any = make_simulator(name).vehicle  # type: ignore[attr-defined]
    scale = 16.0 if name == "donkey" else 1.0  # road metres per metre of the car
    limits = []
    for friction in (1.0, 0.12, 0.1, 1.0):
        vehicle.adjust(friction=friction, payload=0.0)
        vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(1))
        fastest = 0.0
        for step in range(120):
            vehicle.advance(Command(0.0 if step < 60 else 1.0, 1.0))
            state = vehicle.state()
            fastest = max(fastest, abs(state.speed * state.yaw_rate)) if step > 90 else 0.0
        limits.append(fastest)
    vehicle.close()
    assert limits[3] == limits[0]
    for friction, limit in ((0.12, limits[1]), (0.1, limits[2])):
        assert limit <= 1.25 * friction * MU[name] * 9.81 * scale
    assert limits[2] < limits[1] < limits[0]


@pytest.mark.parametrize("name", MU)
def test_a_loaded_car_takes_longer_to_speed_up(name: str) -> None:
    vehicle: Any = make_simulator(name).vehicle  # type: ignore[attr-defined]
    speeds = []
    for payload in (0.0, 0.2, 0.5):
        vehicle.adjust(friction=1.0, payload=payload)
        vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(1))
        for _ in range(20):
            vehicle.advance(Command(0.0, 1.0))
        speeds.append(vehicle.state().speed)
    vehicle.close()
    assert speeds[0] > speeds[1] > speeds[2] > 0.5 * speeds[0]


@pytest.mark.parametrize("name", [*PAINTED, "panda"])
def test_conditions_are_repeatable_and_leave_no_trace(name: str) -> None:
    simulator = make_simulator(name)
    assert isinstance(simulator, RoadSimulator) and set(ALL.changed) <= set(simulator.spec.conditions)
    pilot = reference_driver(simulator.spec.autopilot)

    def run(conditions: Conditions) -> str:
        frames = [simulator.load(WINDING, seed=5, conditions=conditions)]
        for _ in range(4):
            frames.append(simulator.step(pilot(frames[-1])))
        return digest(frames)

    before = digest(drive(simulator, WINDING, pilot, seed=5, steps=4))
    under = run(ALL)
    assert run(ALL) == under != before == run(Conditions())
    whole = simulator.load(WINDING, seed=5, conditions=ALL).image
    top, bottom = simulator.spec.crop_top, 160 - simulator.spec.crop_bottom
    simulator.draw_rows(top, bottom)
    part = simulator.load(WINDING, seed=5, conditions=ALL).image
    assert np.array_equal(part[top:bottom], whole[top:bottom]) and not part[:top].any()
    simulator.close()


def test_a_delay_and_a_lag_take_their_time_in_the_car() -> None:
    """Angle of the wheels after a step of the steering, against the same car without."""
    angles = {}
    for conditions in (Conditions(), Conditions(command_delay=0.3), Conditions(steering_lag=0.3)):
        simulator = make_simulator("softbody")
        assert isinstance(simulator, RoadSimulator)
        simulator.load(STRAIGHT, seed=1, conditions=conditions)
        angles[conditions] = np.array([simulator.step(Command(-0.05, 0.3)).vehicle.steering_angle for _ in range(60)])
        simulator.close()
    plain, delayed, lagging = angles.values()
    assert delayed[6:] == pytest.approx(plain[:-6], abs=2e-3) and np.abs(delayed[:6]).max() < 1e-3
    # The area that a first-order lag takes is its time constant times the step.
    missing = (plain - lagging).sum() * FRAME_TIME / lagging[-1]
    assert missing == pytest.approx(0.3, abs=0.02)
