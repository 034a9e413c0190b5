# SPDX-License-Identifier: Apache-2.0
"""Contrast of the lines in rendered images, against laws that know nothing of how it is measured; and the gates."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.conformance.test_conditions import light as linear
from tests.conformance.test_conditions import perfect
from tests.drives import driven
from tests.observations import made_observation

from ds_driver.closed_loop.simulation import make_driver
from ds_driver.networks.driver_name import AUTOPILOT
from ds_road import Road
from ds_sim.camera.rendered_scene import PaintedScene
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.gates.gate import GateState, gate_of
from ds_sim.gates.visible_contrast import ContrastProbe, VisibleContrast
from ds_sim.registry import make_simulator, spec_of
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Outcome, VehicleState
from ds_sim.testing import STRAIGHT

IN_LANE = VehicleState(x=127.0, y=60.0, yaw=math.pi / 2, speed=0.0, yaw_rate=0.0, steering_angle=0.0)
NEAR, FAR = 10.0, 15.0
"""Distances between which the farthest 5 m within 1.8 s at 30 km/h lie, m."""


def light(levels: Any) -> float:
    """Luminance of an sRGB colour in linear light (IEC 61966-2-1, ITU-R BT.709)."""
    return float(linear(levels) @ [0.2126, 0.7152, 0.0722])


@cache
def contrast(name: str, conditions: Conditions = DEFAULT, line_width: float = 0.6) -> float:
    """Contrast along the straight road, seen from the middle of its right lane by a camera without flaws."""
    spec = spec_of(name)
    camera = perfect(name)
    look = replace(spec.look, asphalt_grain=0.0, grass_grain=0.0, relief=0.0, line_width=line_width)
    scene = PaintedScene(camera, look)
    scene.load(STRAIGHT, np.random.default_rng(1), conditions)
    image = scene.still(IN_LANE, np.random.default_rng(1))
    spec = replace(spec, camera=camera, look=look)
    return VisibleContrast(STRAIGHT, spec, conditions).of(image, IN_LANE, arc_length=35.0)


@pytest.mark.parametrize("name", ["bullet", "softbody", "donkey"])
def test_clear_lines_have_the_contrast_of_their_paint(name: str) -> None:
    look = spec_of(name).look
    paint, pavement = light(look.edge_line), light(look.asphalt)
    assert contrast(name) == pytest.approx((paint - pavement) / pavement, rel=0.15)


@pytest.mark.parametrize("visibility", [30.0, 60.0, 200.0])
def test_haze_takes_the_contrast_that_koschmieder_says(visibility: float) -> None:
    look, clear = spec_of("bullet").look, contrast("bullet")
    pavement, air = light(look.asphalt), light(look.horizon)
    through = np.exp(-3.912 * np.linspace(NEAR, FAR, 50) / visibility)
    expected = clear * pavement * through.mean() / (pavement * through + air * (1.0 - through)).mean()
    assert contrast("bullet", Conditions(visibility=visibility)) == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("name", ["bullet", "donkey"])
@pytest.mark.parametrize("mount", ["pitch=0.07", "pitch=-0.05", "yaw=0.1", "yaw=-0.1", "height=1.6"])
def test_lines_are_found_wherever_the_camera_is_mounted(name: str, mount: str) -> None:
    """Half a line's width beside the line the contrast would be a fraction."""
    assert contrast(name, parse_conditions(f"camera_{mount}")) == pytest.approx(contrast(name), rel=0.2)


@pytest.mark.parametrize("name", ["bullet", "softbody", "donkey"])
def test_where_no_paint_is_none_is_seen(name: str) -> None:
    """With grain, grass and noise as they are, on most of the road."""
    spec, conditions = spec_of(name), Conditions(line_contrast=0.0)
    scene, measured = PaintedScene(spec.camera, spec.look), VisibleContrast(STRAIGHT, spec, conditions)
    rng = np.random.default_rng(1)
    scene.load(STRAIGHT, rng, conditions)
    found = []
    for y in range(30, 150, 8):
        state = replace(IN_LANE, y=float(y))
        found.append(measured.of(scene.still(state, rng), state, y - 25.0))
    assert np.mean(np.array(found) < 0.05) > 0.5, found


def test_a_picture_without_lines_has_no_contrast() -> None:
    spec = spec_of("bullet")
    measured, backwards = VisibleContrast(STRAIGHT, spec), replace(IN_LANE, yaw=-math.pi / 2)
    for level, state in ((0, IN_LANE), (97, IN_LANE), (255, IN_LANE), (0, backwards)):
        assert measured.of(np.full((160, 320, 3), level, np.uint8), state, 35.0) == 0.0


@pytest.mark.parametrize("name", ["bullet", "softbody", "panda", "donkey"])
def test_noise_gives_no_line_contrast(name: str) -> None:
    """Nor does it take any: under noise the image of the camera differs, the contrast of what it shows does not."""
    simulator = make_simulator(name)
    drive = make_driver(AUTOPILOT, simulator.spec)
    found, images = [], []
    for noise in (0.0, 40.0):
        session = Session(simulator)
        seen = session.start(Scenario(STRAIGHT, Conditions(line_contrast=0.02, sensor_noise=noise), seed=3))
        assert session.run is not None and seen is not None
        images.append(seen.image)
        probe = ContrastProbe(session.run, simulator)
        while seen is not None and seen.step <= 20:
            probe.see(seen)
            seen = session.advance(drive(seen))
        found.append(session.run.visible_contrasts)
    simulator.close()
    assert not np.array_equal(images[0], images[1])
    assert len(found[0]) == 3 and found[0] == found[1]


def test_a_still_is_what_a_camera_without_noise_shows() -> None:
    """Whatever rows the run draws, with the same dirt on the lens."""
    spec = spec_of("bullet")
    scene = PaintedScene(replace(spec.camera, noise=0.0), spec.look)
    state = replace(IN_LANE, speed=7.0, yaw_rate=0.1)
    conditions = Conditions(lens_dirt=0.3, visibility=60.0, camera_pitch=0.05)
    scene.load(STRAIGHT, np.random.default_rng(1), conditions)
    whole = scene.image(state)
    scene.draw_rows(61, 62)
    scene.load(STRAIGHT, np.random.default_rng(1), conditions)
    assert not scene.image(state)[:61].any()
    np.testing.assert_array_equal(scene.still(state), whole)


def a_run(contrasts: list[float], outcome: Outcome = Outcome.COMPLETED) -> RunRecord:
    """A run of 1 m a frame, with one contrast in ten frames."""
    run = RunRecord(scenario=Scenario(STRAIGHT, seed=1), outcome=outcome, visible_contrasts=contrasts)
    frames = range(10 * len(contrasts) + 1)
    run.observations = [made_observation(k, lateral=0.0) for k in frames]
    return run


@pytest.mark.parametrize(
    ("run", "state", "hidden"),
    [
        (a_run([0.05, 0.9, 0.9, 0.9]), GateState.VALID, 0.0),
        (a_run([0.049, 0.9, 0.9, 0.9]), GateState.OUT_OF_ODD, 0.25),
        (a_run([0.9, 0.0, 0.0, 0.9]), GateState.VALID, 0.5),
        (a_run([0.9, 0.0, 0.0, 0.0]), GateState.OUT_OF_ODD, 0.75),
        (a_run([0.0, 0.0], Outcome.OUT_OF_BOUNDS), GateState.INFEASIBLE, 1.0),
        (a_run([0.9, 0.9], Outcome.TIMEOUT), GateState.INFEASIBLE, 0.0),
    ],
)
def test_gates_say_by_what_a_network_can_be_judged(run: RunRecord, state: GateState, hidden: float) -> None:
    gate = gate_of(run)
    assert (gate.state, gate.outcome) == (state, run.outcome)
    assert gate.hidden_share == pytest.approx(hidden)
    assert bool(gate.message) is not gate.is_valid and "\n" not in gate.message


@pytest.mark.parametrize("outcome", [Outcome.SIM_ERROR, Outcome.DRIVER_SILENT, Outcome.CANCELLED])
def test_an_error_judges_no_test(outcome: Outcome) -> None:
    with pytest.raises(ValueError, match="repeat it"):
        gate_of(a_run([0.9], outcome))


@pytest.mark.parametrize(
    ("conditions", "state"),
    [
        (DEFAULT, GateState.VALID),
        (Conditions(line_contrast=0.0), GateState.OUT_OF_ODD),
        (Conditions(exposure=8.0, veiling_luminance=3000.0, illuminance=100.0), GateState.OUT_OF_ODD),
        (Conditions(tyre_pull=0.05, steering_lag=1.0, command_delay=1.0), GateState.INFEASIBLE),
    ],
    ids=["own world", "no lines", "blinded", "undrivable"],
)
def test_the_gates_of_real_drives(conditions: Conditions, state: GateState) -> None:
    road = Road([(125.0, 40.0), (125.0, 65.0), (128.0, 90.0), (131.0, 115.0), (131.0, 140.0)])
    assert gate_of(driven("donkey", road, 5, conditions, probed=True)).state is state
