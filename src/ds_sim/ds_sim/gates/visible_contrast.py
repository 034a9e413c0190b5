# SPDX-License-Identifier: Apache-2.0
"""Contrast of the lines of the driven lane in the rendered image itself, at the distance that a driver looks ahead."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_road.geometry import arc_lengths
from ds_sim.camera.lens import project
from ds_sim.camera.optics import decode, mounted
from ds_sim.camera.surface import LEAD_OUT
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.gates.gate import PROBE_EVERY
from ds_sim.session import RunRecord
from ds_sim.simulator import MAX_SPEED, Observation, Simulator, SimulatorSpec, VehicleState

PREVIEW_TIME = 1.8
"""Least time that a driver must see road markings ahead, s (COST 331, Requirements for Horizontal Road
Marking, 1999)."""
LOOK_AHEAD = PREVIEW_TIME * MAX_SPEED
"""Distance along the lane up to which lines are looked at, m: 15, at the speed limit of the driving task."""
WINDOW = 5.0
"""Length of line that is measured, m: the farthest in the picture within `LOOK_AHEAD`; chosen: two and a half bare
pieces of worn line."""
STEP = 0.25
"""Distance of two measured points of a line, m; chosen: less than a row of pixels at `LOOK_AHEAD`."""
BESIDE = 0.5
"""Distance of the pavement from a line's edge, m; chosen: three widths of a line, within the lane."""
LEAST_WIDTH = 2.0
"""Width in the picture of the edge line where it is measured, px; chosen: where it is narrower, grass beyond the road
blends with it, and looked like 4 to 14% of contrast where no line was painted."""
LEAST_POINTS = 4
"""Points in the picture without which a line is out of sight; chosen: 1 m of it."""
DARKEST = 1.0 / 255.0 / 12.92
"""Linear light of grey level 1: the darkest pavement against which contrast is taken."""
_RED, _GREEN, _BLUE = 0.2126, 0.7152, 0.0722
"""Weights of linear red, green and blue (ITU-R BT.709)."""
_Points = NDArray[np.float64]


class VisibleContrast:
    """Measures the contrast of the lines beside the driven lane of one road, of one in its middle of all lines.

    Args:
        road: road in its driven direction.
        spec: simulator that renders it.
        conditions: of the run; those of the camera's mounting change where lines are in the picture.
    """

    def __init__(self, road: Road, spec: SimulatorSpec, conditions: Conditions = DEFAULT) -> None:
        self._camera = mounted(spec.camera, conditions)
        middle, lane = np.asarray(road.points), np.asarray(road.lane_centre)
        if road.lane in ("right", "left"):  # unit vectors from the centre line to the driven edge
            across = (lane - middle) * (2.0 / road.lane_width)
        else:
            across = (road.right_edge - middle) / road.half_width
        along = arc_lengths(lane)
        ahead = (middle[-1] - middle[-2]) / np.hypot(*(middle[-1] - middle[-2]))
        middle = np.vstack((middle, middle[-1] + LEAD_OUT * ahead))
        across, along = np.vstack((across, across[-1:])), np.append(along, along[-1] + LEAD_OUT)
        half = spec.look.line_width / 2
        edge = road.half_width - half
        self._stations = np.arange(0.0, along[-1], STEP)
        points, sideways = (
            np.column_stack([np.interp(self._stations, along, column) for column in table.T])
            for table in (middle, across)
        )

        def at(*offsets: float) -> list[_Points]:
            return [points + offset * sideways for offset in offsets]

        # Of each line its middle, the pavement to one or both sides, and its borders if there is grass beyond it.
        self._lines = [(at(0.0, -half - BESIDE, half + BESIDE), at())] if road.has_centre_line else []
        for side in (1.0,) if road.lane in ("right", "left") else (1.0, -1.0):
            inner = side * (edge - half - BESIDE)
            self._lines.append((at(side * edge, inner), at(side * (edge - half), side * (edge + half))))

    def of(self, image: NDArray[np.uint8], state: VehicleState, arc_length: float) -> float:
        """Weber contrast, in linear light, of the line that is seen best; 0 if none is brighter than the pavement.

        Args:
            image: (rows, columns, 3) uint8 RGB.
            state: vehicle when the image was exposed.
            arc_length: distance of the vehicle along its lane, m.
        """
        first, end = np.searchsorted(self._stations, (arc_length, arc_length + LOOK_AHEAD))
        red, green, blue = np.moveaxis(decode(image).astype(np.float64), -1, 0)
        light = np.asarray(_RED * red + _GREEN * green + _BLUE * blue, np.float32)
        contrasts = [0.0]
        for line in self._lines:
            parts, borders = ([project(part[first:end], state, self._camera)[0] for part in some] for some in line)
            wide = _width(*borders) >= LEAST_WIDTH if borders else np.ones(end - first, np.bool_)
            contrasts.append(self._of_line(parts, wide, light))
        return max(contrasts)

    def _of_line(self, pixels: list[_Points], wide: NDArray[np.bool_], light: NDArray[np.float32]) -> float:
        """Contrast of a line against the pavement beside it, over the farthest `WINDOW` that can be measured."""
        rows, columns = light.shape
        inside = np.logical_and.reduce(
            [wide, *(((p >= 0.0) & (p <= (columns - 1, rows - 1))).all(axis=1) for p in pixels)]
        )  # NaN, behind the camera, is outside
        chosen = np.flatnonzero(inside)[-round(WINDOW / STEP) :]
        if len(chosen) < LEAST_POINTS:
            return 0.0
        paint, *pavement = (
            cv2.remap(light, p[chosen].astype(np.float32)[None], None, cv2.INTER_LINEAR).mean() for p in pixels
        )
        background = float(np.mean(pavement))
        return (float(paint) - background) / max(background, DARKEST)


def _width(inner: _Points, outer: _Points) -> NDArray[np.float64]:
    """Width of a line across its direction in the picture, px, (n,); NaN behind the camera."""
    if len(inner) < 2:
        return np.zeros(len(inner))
    along, across = np.gradient(inner, axis=0), outer - inner
    return np.asarray(np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]) / np.hypot(*along.T))


class ContrastProbe:
    """Measures the contrast of the lines during a run, from its start on, and keeps it in the run's record.

    Contrast is a ratio of luminances of the scene (CIE S 017, International Lighting Vocabulary), so it is measured
    before the sensor adds noise, which over the few pixels of a line does not average out: the better of two lines
    would gain contrast by it. How much noise hides a line of a given contrast is another question (Rose, J. Opt. Soc.
    Am. 38(2), 1948), which no gate answers: noise excludes no test.

    Args:
        run: record of the run; observations are seen as they are added to it.
        simulator: drives; one that takes no stills is judged by its camera's images.
    """

    def __init__(self, run: RunRecord, simulator: Simulator) -> None:
        self._run, self._simulator = run, simulator
        self._contrast = VisibleContrast(run.road, simulator.spec, run.conditions)

    def see(self, observation: Observation | None) -> None:
        """Measure an observation if it is one in `PROBE_EVERY`."""
        if observation is None or observation.step % PROBE_EVERY:
            return
        if self._simulator.takes_stills:
            exposed, image = observation, self._simulator.still()
        else:  # the image is that of a moment ago
            latency = self._simulator.spec.camera.latency
            exposed, image = self._run.observations[max(0, observation.step - latency)], observation.image
        contrast = self._contrast.of(image, exposed.vehicle, exposed.lane.arc_length)
        self._run.visible_contrasts.append(contrast)
