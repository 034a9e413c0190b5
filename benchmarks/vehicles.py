"""Draws how the four vehicles differ, for docs/simulators.md: `python -m benchmarks.vehicles [--out docs/images]`.

The charts show the same commands on one road, a steering step beside the linear single-track model, and steady circles
over speed. The last two use the cars of tests/evidence, whose steering has no Ackermann toe, play or delay.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from benchmarks.charts import Chart, Rgb
from benchmarks.convergence import random_roads
from benchmarks.headless import cars
from benchmarks.headless import drive as drive_road
from tests.evidence.subjects import SUBJECTS, drive, settled, started, times

from ds_road import Road
from ds_sim.parts import Vehicle
from ds_sim.simulator import FRAME_TIME, Command, VehicleState

COLOURS: dict[str, Rgb] = {
    "bullet": (0, 90, 181),
    "softbody": (213, 94, 0),
    "panda": (148, 60, 160),
    "donkey": (0, 140, 100),
}
GREY: Rgb = (170, 170, 170)


class Recorder:
    """Vehicle that records its commands.

    Args:
        vehicle: wrapped vehicle.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.commands: list[Command] = []

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """See `Vehicle`."""
        self._vehicle.reset(x, y, yaw, rng)

    def advance(self, command: Command) -> None:
        """See `Vehicle`."""
        self.commands.append(command)
        self._vehicle.advance(command)

    def state(self) -> VehicleState:
        """See `Vehicle`."""
        return self._vehicle.state()

    def close(self) -> None:
        """See `Vehicle`."""
        self._vehicle.close()


def main() -> None:
    """Draw the three charts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    same_commands(random_roads(1)[0]).save(out / "vehicles_commands.png")
    step().save(out / "vehicles_step.png")
    circles().save(out / "vehicles_circles.png")


def same_commands(road: Road) -> Chart:
    """Chart of the paths when the autopilot drives the rigid car and the others replay its commands."""
    car = cars()["bullet"]
    recorder = Recorder(car.make(1))
    paths = {"bullet": drive_road(car, recorder, road).path}
    recorder.close()
    lane = road.lane_centre
    ahead = lane[1] - lane[0]
    for name in ("softbody", "panda", "donkey"):
        vehicle = cars()[name].make(1)
        vehicle.reset(float(lane[0, 0]), float(lane[0, 1]), math.atan2(ahead[1], ahead[0]), np.random.default_rng(0))
        rows = []
        for command in recorder.commands:
            s = vehicle.state()
            rows.append((s.x, s.y, s.yaw, s.speed))
            vehicle.advance(command)
        vehicle.close()
        paths[name] = np.array(rows)
    everything = np.vstack([path[:, :2] for path in paths.values()] + [lane])
    low, high = everything.min(axis=0) - 8.0, everything.max(axis=0) + 8.0
    chart = Chart(
        title="The commands that drive the rigid car along the lane, given to all four",
        x_title="x, m", y_title="y, m", x_range=(low[0], high[0]), y_range=(low[1], high[1]),
        size=(700, 120 + round(605 * (high[1] - low[1]) / (high[0] - low[0]))), equal=True, legend_at=(0.7, 0.06),
    )  # fmt: skip
    normal = np.gradient(lane, axis=0)
    normal = np.column_stack([normal[:, 1], -normal[:, 0]]) / np.hypot(*normal.T)[:, None]
    half = road.lane_width / 2.0
    for k, side in enumerate((half, -half, -3.0 * half)):
        edge = lane + side * normal
        chart.line(edge[:, 0], edge[:, 1], GREY, "" if k else "lines of the road", dash=5 if k == 1 else 0)
    for name, path in paths.items():
        chart.line(path[:, 0], path[:, 1], COLOURS[name], name)
    return chart


def step() -> Chart:
    """Chart of the yaw rate after a steering step at 25 km/h, relative to the steady one without slip."""
    chart = Chart(
        title="A step of the steering at 25 km/h", x_title="time, s",
        y_title="yaw rate over that of the same car without slip", x_range=(0.0, 1.0), y_range=(0.0, 1.25),
        legend_at=(0.6, 0.55),
    )  # fmt: skip
    for name, colour in COLOURS.items():
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
        chart.line(fine, oracle / kinematic, _paler(colour), f"{name}: linear single track")
        chart.dots(times(20), rates / kinematic, colour, f"{name}: driven, every frame")
    return chart


def circles() -> Chart:
    """Chart of the radius of steady circles over speed, relative to the one without slip."""
    chart = Chart(
        title="Steady circles at about a tenth of full lock", x_title="speed, km/h on the road",
        y_title="radius over that of the same car without slip", x_range=(5.0, 30.0), y_range=(0.98, 1.10),
        legend_at=(0.05, 0.06),
    )  # fmt: skip
    for name, colour in COLOURS.items():
        subject = SUBJECTS[name]()
        model = subject.model
        kinematic = model.wheelbase / math.tan(subject.circle * subject.lock)
        found = []
        for kmh in (7.0, 11.0, 15.0, 19.0, 23.0, 27.0, 29.0):
            car = started(subject)
            throttle = settled(car, kmh / 3.6)
            last = drive(car, round(4.0 / FRAME_TIME), -subject.circle, throttle)[-1]
            car.close()
            found.append((3.6 * last.speed, last.speed / last.yaw_rate / subject.scale / kinematic))
        speeds, radii = np.array(found).T
        fine = np.linspace(5.0, 30.0, 200)
        by_hand = 1.0 + model.understeer_gradient * (fine / 3.6 / subject.scale) ** 2 / model.wheelbase
        chart.line(fine, by_hand, _paler(colour), f"{name}: 1 + K v^2 / L")
        chart.dots(speeds, radii, colour, f"{name}: driven")
    return chart


def _paler(colour: Rgb) -> Rgb:
    """Colour halfway to white."""
    red, green, blue = ((c + 255) // 2 for c in colour)
    return (red, green, blue)


if __name__ == "__main__":
    main()
