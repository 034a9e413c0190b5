# SPDX-License-Identifier: Apache-2.0
"""Draws how the four vehicles differ, for docs/simulators.md: `python -m benchmarks.vehicles [--out docs/images]`.

The charts show the same commands on one road, a steering step beside the linear single-track model, and steady circles
over speed. The last two use the cars of tests/evidence, whose steering has no Ackermann toe, play or delay.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from unittest import mock

import numpy as np
from benchmarks.physics import cars, random_roads
from benchmarks.physics import drive as drive_road
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tests.evidence.subjects import SUBJECTS, drive, settled, started, times

from ds_road import Road
from ds_road.figures import draw_figure
from ds_sim.camera.encodings import png
from ds_sim.simulator import FRAME_TIME

Array = NDArray[np.float64]
COLOURS = {"bullet": "#005ab5", "softbody": "#d55e00", "panda": "#943ca0", "donkey": "#008c64"}


def main() -> None:
    """Draw the three charts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    same_commands(random_roads(1)[0], out / "vehicles_commands.png")
    step(out / "vehicles_step.png")
    circles(out / "vehicles_circles.png")


def same_commands(road: Road, path: Path) -> None:
    """Draw the paths when the autopilot drives the rigid car and the others replay its commands."""
    car = cars()["bullet"]
    rigid = car.make(1)
    with mock.patch.object(rigid, "advance", side_effect=rigid.advance) as advance:
        paths = {"bullet": drive_road(car, rigid, road).path}
        commands = [call.args[0] for call in advance.call_args_list]
    rigid.close()
    lane = road.lane_centre
    ahead = lane[1] - lane[0]
    for name in ("softbody", "panda", "donkey"):
        vehicle = cars()[name].make(1)
        vehicle.reset(float(lane[0, 0]), float(lane[0, 1]), math.atan2(ahead[1], ahead[0]), np.random.default_rng(0))
        rows = []
        for command in commands:
            s = vehicle.state()
            rows.append((s.x, s.y, s.yaw, s.speed))
            vehicle.advance(command)
        vehicle.close()
        paths[name] = np.array(rows)
    normal = np.gradient(lane, axis=0)
    normal = np.column_stack([normal[:, 1], -normal[:, 0]]) / np.hypot(*normal.T)[:, None]
    half = road.lane_width / 2.0

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, side in enumerate((half, -half, -3.0 * half)):
            label = None if k else "lines of the road"
            axes.plot(*(lane + side * normal).T, "--" if k == 1 else "-", color="#aaaaaa", label=label)
        for name, way in paths.items():
            axes.plot(*way[:, :2].T, color=COLOURS[name], label=name)
        axes.set(title="The commands that drive the rigid car along the lane, given to all four")
        axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
        axes.legend()

    path.write_bytes(png(draw_figure(700, 760, draw)))


def step(path: Path) -> None:
    """Draw the yaw rate after a steering step at 25 km/h, relative to the steady one without slip."""
    found = {}
    for name in COLOURS:
        subject = SUBJECTS[name]()
        car = started(subject)
        throttle = settled(car, 7.0)
        speed = car.state().speed / subject.scale
        angle = subject.circle * subject.lock
        kinematic = speed * math.tan(angle) / subject.model.wheelbase
        rates = np.array([0.0, *(s.yaw_rate for s in drive(car, 20, -subject.circle, throttle))])
        car.close()

        fine = np.linspace(0.0, 1.0, 501)
        oracle = (subject.sudden or subject.model).yaw_rate(speed, subject.steered(angle), fine)
        found[name] = (fine, oracle / kinematic), (times(20), rates / kinematic)
    title = "A step of the steering at 25 km/h", "time, s", "yaw rate over that of the same car without slip"
    _draw(title, found, ("linear single track", "driven, every frame"), (0.0, 1.0, 0.0, 1.25), path)


def circles(path: Path) -> None:
    """Draw the radius of steady circles over speed, relative to the one without slip."""
    found = {}
    for name in COLOURS:
        subject = SUBJECTS[name]()
        model = subject.model
        kinematic = model.wheelbase / math.tan(subject.circle * subject.lock)
        driven = []
        for kmh in (7.0, 11.0, 15.0, 19.0, 23.0, 27.0, 29.0):
            car = started(subject)
            throttle = settled(car, kmh / 3.6)
            last = drive(car, round(4.0 / FRAME_TIME), -subject.circle, throttle)[-1]
            car.close()
            driven.append((3.6 * last.speed, last.speed / last.yaw_rate / subject.scale / kinematic))
        fine = np.linspace(5.0, 30.0, 200)
        by_hand = 1.0 + model.understeer_gradient * (fine / 3.6 / subject.scale) ** 2 / model.wheelbase
        found[name] = (fine, by_hand), tuple(np.array(driven).T)
    title = "Steady circles at about a tenth of full lock", "speed, km/h on the road"
    ratio = "radius over that of the same car without slip"
    _draw((*title, ratio), found, ("1 + K v^2 / L", "driven"), (5.0, 30.0, 0.98, 1.10), path)


def _draw(
    titles: tuple[str, str, str],
    found: Mapping[str, Sequence[Sequence[Array]]],
    kinds: tuple[str, str],
    limits: tuple[float, float, float, float],
    path: Path,
) -> None:
    """Draw what is computed as a line, and what was driven as dots, for every car."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for name, (line, dots) in found.items():
            axes.plot(*line, color=COLOURS[name], alpha=0.5, label=f"{name}: {kinds[0]}")
            axes.plot(*dots, ".", color=COLOURS[name], label=f"{name}: {kinds[1]}")
        title, across, upwards = titles
        axes.set(title=title, xlabel=across, ylabel=upwards, xlim=limits[:2], ylim=limits[2:])
        axes.legend()

    path.write_bytes(png(draw_figure(900, 520, draw)))


if __name__ == "__main__":
    main()
