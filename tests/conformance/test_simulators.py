# SPDX-License-Identifier: Apache-2.0
"""Contract of every simulator: `ds_sim.testing` on each of them, and on simulators that violate it."""

from __future__ import annotations

import json
import math
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.command_line import ds_process

from ds_driver.control.autopilot import Autopilot
from ds_orchestrator.campaign.config import parse_config
from ds_road import Road, generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import STANDARD, UnknownSimulatorError, make_simulator, simulators
from ds_sim.simulator import Command, CommandError, Observation, Outcome
from ds_sim.testing import CHECKS, STRAIGHT, SimulatorCheckError, check_simulator, drive, missing_because, run_check
from ds_sim_softbody.simulator import SoftbodySimulator


@pytest.mark.parametrize("check", CHECKS)
def test_a_simulator_keeps_its_promise(simulator_name: str, check: str) -> None:
    run_check(check, simulator_name)


class MirroredSimulator(SoftbodySimulator):
    """Steers right when it should steer left."""

    def step(self, command: Command) -> Observation:
        return super().step(Command(-command.steering, command.throttle))


class RestlessSimulator(SoftbodySimulator):
    """Shifts its world by a centimetre with every run."""

    def __init__(self) -> None:
        super().__init__()
        self._loads = 0

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        self._loads += 1
        shifted = Road([(x + 0.01 * self._loads, y) for x, y in road.control_points])
        return super().load(shifted, seed=seed, conditions=conditions)


def test_broken_promises_are_named_with_what_was_found() -> None:
    quick = {"left_is_left", "same_bits_again", "run_begins_at_rest"}
    with pytest.raises(SimulatorCheckError, match=r"^left_is_left: steering -0\.5 \(left\): change of yaw is -0"):
        check_simulator(MirroredSimulator, skip=set(CHECKS) - quick)
    with pytest.raises(SimulatorCheckError, match="^same_bits_again: the same road, seed and commands gave other"):
        check_simulator(RestlessSimulator, skip=set(CHECKS) - quick)


def test_a_road_of_one_lane_has_two_lines_and_is_driven_between_them(simulator_name: str) -> None:
    """Yellow in the lower half of the picture, on the same simulator one road after the other."""
    with closing(make_simulator(simulator_name)) as simulator:
        yellow = {}
        for lane in ("right", "single", "middle"):
            seen = simulator.load(STRAIGHT.in_lane(lane), seed=1)  # type: ignore[arg-type]
            red, green, blue = np.moveaxis(seen.image[seen.image.shape[0] // 2 :].astype(int), 2, 0)
            yellow[lane] = int(((red - blue > 60) & (red > green)).sum())
            assert abs(seen.vehicle.x - (127.0 if lane == "right" else 125.0)) < 0.02
            assert seen.lane.lateral_distance == pytest.approx(2.0, abs=0.02)
        assert 20 * yellow["single"] < min(yellow["right"], yellow["middle"]), yellow


def test_a_check_that_does_not_exist_cannot_be_skipped() -> None:
    with pytest.raises(ValueError, match="unknown check lef_is_left: expected some of same_bits_again"):
        check_simulator("bullet", skip={"lef_is_left"})


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
    """Same road, same commands, as many trajectories: complementary, not copies."""
    ends = []
    for name in (name for name in sorted(simulators()) if name in STANDARD or not missing_because(name)):
        simulator = make_simulator(name)
        end = drive(simulator, STRAIGHT, lambda o: Command(0.05 if o.time > 2.0 else 0.0, 0.7), steps=80)[-1]
        ends.append((end.vehicle.x, end.vehicle.y))
        simulator.close()
    assert min(math.dist(a, b) for i, a in enumerate(ends) for b in ends[:i]) > 0.1
    assert np.isfinite(ends).all()


def test_a_sampled_road_drives_like_the_spline_that_it_was_taken_from(simulator_name: str) -> None:
    """The road points of other tools: the same centre line gives the same states, bit for bit."""
    spline = Road([(125.0 + 8.0 * (i % 2), 25.0 * i) for i in range(9)])
    sampled = Road.from_road_points(spline.points)
    simulator = make_simulator(simulator_name)
    runs = []
    for road in (spline, sampled):
        seen = [simulator.load(road, seed=3)]
        seen += [simulator.step(Command(0.2 * math.sin(0.3 * k), 0.5)) for k in range(25)]
        runs.append([(o.vehicle, o.lane, o.outcome, o.image.tobytes()) for o in seen])
    simulator.close()
    assert runs[0] == runs[1] and runs[0][-1][0].speed > 1.0


def test_a_mirrored_road_is_driven_in_mirror_image(simulator_name: str) -> None:
    """By the autopilot, which reads the lane and no image: nothing in physics or lane knows right from left.

    Within 1 cm: the contact solver of bullet goes through its wheels in an order.
    """
    road = generate(np.random.default_rng(8), max_angle=150)
    simulator = make_simulator(simulator_name)
    simulator.draw_rows(0, 1)  # nobody looks
    runs = []
    for one in (road, road.mirrored()):
        pilot, seen = Autopilot(simulator.spec.autopilot), [simulator.load(one, seed=1)]
        while seen[-1].outcome is Outcome.RUNNING and len(seen) < 200:  # through two bends
            seen.append(simulator.step(pilot.command(seen[-1].lane.preview_lateral_position, seen[-1].vehicle.speed)))
        runs.append(seen)
    simulator.close()
    path, image = (np.array([(o.vehicle.x, o.vehicle.y, o.lane.lateral_position) for o in seen]) for seen in runs)
    assert len(path) == len(image) == 200
    np.testing.assert_allclose(image, path * (-1, 1, -1) + (250, 0, 0), atol=0.01)


@pytest.mark.parametrize("width", [3.0, 6.0])
def test_the_lane_of_a_road_is_as_wide_as_the_road_says(width: float) -> None:
    simulator = make_simulator("donkey")
    lane = simulator.load(Road([(125.0, 25.0 * i) for i in range(1, 7)], lane_width=width), seed=1).lane
    simulator.close()
    assert lane.lateral_distance + abs(lane.lateral_position) == pytest.approx(width / 2)


DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "add_a_simulator.md"


def documented_line() -> str:
    line = re.search(r"^siblings: .*$", DOCUMENT.read_text(), re.MULTILINE)
    assert line is not None
    return line.group()


def test_the_documented_line_is_a_configuration() -> None:
    config = parse_config(yaml.safe_load(documented_line()), "add_a_simulator.md")
    assert config.siblings == ["bullet", "softbody", "bicycle:BicycleSimulator"]


@pytest.mark.graph
@pytest.mark.long
def test_the_whole_method_takes_a_third_sibling(tmp_path: Path) -> None:
    search = "search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}"
    (tmp_path / "c.yaml").write_text("\n".join((documented_line(), "twin: donkey", "driver: autopilot", search)))
    done = ds_process("campaign", "run", "c.yaml", "--out", "out", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    document = json.loads(done.stdout)
    # Two tests from each of three searches, each on three siblings and on the twin.
    assert document["executions"] == 3 * 2 * 4 and document["executions_in_error"] == 0
    maps = json.loads((tmp_path / "out" / "maps" / "maps.json").read_text())
    unions = [maps[f"union_{name}"] for name in ("bullet", "softbody", "bicycle:BicycleSimulator")]
    assert all(sum(cell["tests"] for cell in union["cells"]) == 6 for union in unions)
    assert len(list((tmp_path / "out" / "maps").glob("union_bicycle.BicycleSimulator-????????.json"))) == 1
    assert "bicycle" in (tmp_path / "out" / "report.html").read_text()
