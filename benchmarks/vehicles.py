"""Draws how the four vehicles differ, for docs/simulators.md: `python -m benchmarks.vehicles [--out docs/images]`.

The charts show the same commands on one road, a steering step beside the linear single-track model, and steady circles
over speed. The last two use the cars of tests/evidence, whose steering has no Ackermann toe, play or delay.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
from benchmarks.physics import cars, random_roads
from benchmarks.physics import drive as drive_road
from numpy.typing import NDArray
from tests.evidence.subjects import SUBJECTS, drive, settled, started, times

from ds_road import Road
from ds_sim.simulator import FRAME_TIME

Rgb = tuple[int, int, int]
INK: Rgb = (30, 30, 30)
GRID: Rgb = (225, 225, 225)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
"""Fractional bits of the pixel coordinates passed to OpenCV."""


@dataclass(kw_only=True)
class Chart:
    """Chart to which lines are added before it is saved.

    Attributes:
        title: text above the chart.
        x_title: text below the x axis.
        y_title: text at the top of the y axis.
        x_range: ends of the x axis.
        y_range: ends of the y axis.
        size: width and height, pixels.
        legend_at: upper left corner of the legend, as shares of the plot's width and height.
        equal: whether both axes have the same scale; `y_range` is then adjusted.
    """

    title: str
    x_title: str
    y_title: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    size: tuple[int, int] = (900, 520)
    legend_at: tuple[float, float] = (0.62, 0.06)
    equal: bool = False
    _names: list[tuple[str, Rgb, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        width, height = self.size
        self._image = np.full((height, width, 3), 255, np.uint8)
        self._left, self._top = 70, 66
        self._wide, self._high = width - 95, height - 120
        if self.equal:
            middle = sum(self.y_range) / 2.0
            half = (self.x_range[1] - self.x_range[0]) * self._high / self._wide / 2.0
            self.y_range = (middle - half, middle + half)
        self._axes()

    def line(
        self, x: NDArray[np.float64], y: NDArray[np.float64], colour: Rgb, name: str = "", *, dash: int = 0
    ) -> None:
        """Draw a line through points; `dash` is the length of dashes and gaps in pixels, 0 for a solid line."""
        points = np.column_stack([self._column(x), self._row(y)])
        steps = np.hypot(*np.diff(points, axis=0).T)
        distance = np.concatenate([[0.0], np.cumsum(steps)])
        # Points at equal distances make dashes of equal length.
        even = np.arange(0.0, distance[-1], 1.0)
        points = np.column_stack([np.interp(even, distance, points[:, k]) for k in (0, 1)])
        plot = self._image[self._top : self._top + self._high, self._left : self._left + self._wide]
        pieces = [points[k : k + dash + 1] for k in range(0, len(points), 2 * dash)] if dash else [points]
        for piece in pieces:
            shifted = np.round((piece - (self._left, self._top)) * 2**_SHIFT).astype(np.int32)
            cv2.polylines(plot, [shifted], False, colour, 2, cv2.LINE_AA, _SHIFT)
        if name:
            self._names.append((name, colour, dash))

    def dots(self, x: NDArray[np.float64], y: NDArray[np.float64], colour: Rgb, name: str = "") -> None:
        """Draw dots at points."""
        for column, row in zip(self._column(x), self._row(y), strict=True):
            cv2.circle(self._image, (round(column * 2**_SHIFT), round(row * 2**_SHIFT)), 4 * 2**_SHIFT, colour, -1,
                       cv2.LINE_AA, _SHIFT)  # fmt: skip
        if name:
            self._names.append((name, colour, -1))

    def save(self, path: Path) -> None:
        """Draw the legend and write the chart as PNG."""
        left = self._left + round(self.legend_at[0] * self._wide)
        for k, (name, colour, dash) in enumerate(self._names):
            row = self._top + round(self.legend_at[1] * self._high) + 20 * k
            if dash < 0:
                cv2.circle(self._image, (left + 18, row), 4, colour, -1, cv2.LINE_AA)
            for start in range(0, 36, 2 * dash) if dash > 0 else [0] * (dash == 0):
                end = start + (dash or 36)
                cv2.line(self._image, (left + start, row), (left + min(end, 36), row), colour, 2, cv2.LINE_AA)
            self._write(name, (left + 44, row + 4))
        cv2.imwrite(str(path), cv2.cvtColor(self._image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])

    def _column(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.x_range
        return self._left + (np.asarray(x) - low) / (high - low) * self._wide

    def _row(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.y_range
        return self._top + (high - np.asarray(y)) / (high - low) * self._high

    def _axes(self) -> None:
        bottom, right = self._top + self._high, self._left + self._wide
        for value in _ticks(*self.x_range):
            column = round(float(self._column(np.array(value))))
            cv2.line(self._image, (column, self._top), (column, bottom), GRID, 1)
            self._write(f"{value:g}", (column, bottom + 18), middle=True)
        for value in _ticks(*self.y_range):
            row = round(float(self._row(np.array(value))))
            cv2.line(self._image, (self._left, row), (right, row), GRID, 1)
            text = f"{value:g}"
            self._write(text, (self._left - 8 - cv2.getTextSize(text, _FONT, 0.42, 1)[0][0], row + 4))
        cv2.rectangle(self._image, (self._left, self._top), (right, bottom), (150, 150, 150), 1)
        cv2.putText(self._image, self.title, (14, 26), _FONT, 0.6, INK, 2, cv2.LINE_AA)
        self._write(self.y_title, (14, 52))
        self._write(self.x_title, (self._left + self._wide // 2, bottom + 42), middle=True)

    def _write(self, text: str, at: tuple[int, int], *, middle: bool = False) -> None:
        left = at[0] - (cv2.getTextSize(text, _FONT, 0.42, 1)[0][0] // 2 if middle else 0)
        cv2.putText(self._image, text, (left, at[1]), _FONT, 0.42, INK, 1, cv2.LINE_AA)


def _ticks(low: float, high: float) -> list[float]:
    """Four to nine round values within a range."""
    power = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step = max(m * power for m in (1.0, 2.0, 5.0) if m * power <= (high - low) / 4.0)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


COLOURS: dict[str, Rgb] = {
    "bullet": (0, 90, 181),
    "softbody": (213, 94, 0),
    "panda": (148, 60, 160),
    "donkey": (0, 140, 100),
}
GREY: Rgb = (170, 170, 170)


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
