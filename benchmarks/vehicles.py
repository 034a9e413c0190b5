# SPDX-License-Identifier: Apache-2.0
"""Draws where the same commands take the four vehicles: `python -m benchmarks.vehicles [--out docs/images]`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from unittest import mock

import numpy as np
from benchmarks.physics import cars, random_roads
from benchmarks.physics import drive as drive_road
from matplotlib.figure import Figure

from ds_base.figures import draw_figure
from ds_road import Road
from ds_sim.camera.encodings import png

COLOURS = {"bullet": "#005ab5", "softbody": "#d55e00", "panda": "#943ca0", "donkey": "#008c64"}


def main() -> None:
    """Draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    same_commands(random_roads(1)[0], out / "vehicles_commands.png")


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


if __name__ == "__main__":
    main()
