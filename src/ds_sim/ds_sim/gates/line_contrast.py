"""Contrast of the lines of the driven lane in the rendered image itself, at the distance that a driver looks ahead."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ds_road import Road
from ds_sim.camera.light import decode
from ds_sim.camera.optics import mounted
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.frames import body_pose, camera_pose
from ds_sim.gates.gate import PROBE_EVERY
from ds_sim.session import RunRecord
from ds_sim.simulator import MAX_SPEED, Observation, SimulatorSpec, VehicleState

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
blends with it, and looked like 4 to 14 % of contrast where no line was painted."""
LEAST_POINTS = 4
"""Points in the picture without which a line is out of sight; chosen: 1 m of it."""
NEAREST = 0.5
"""Least distance of a point along the optical axis, m; chosen: nearer ones are below every picture."""
DARKEST = 1.0 / 255.0 / 12.92
"""Linear light of grey level 1: the darkest pavement against which contrast is taken."""
_LEAD_OUT = 40.0
"""Straight road that simulators draw beyond the end, m (`ds_sim.camera.ground`)."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue (ITU-R BT.709)."""
_Points = NDArray[np.float64]


class LineContrast:
    """Measures the contrast of the two lines beside the driven lane of one road.

    Args:
        road: road in its driven direction.
        spec: simulator that renders it.
        conditions: of the run; those of the camera's mounting change where lines are in the picture.
    """

    def __init__(self, road: Road, spec: SimulatorSpec, conditions: Conditions = DEFAULT) -> None:
        self._camera = mounted(spec.camera, conditions)
        middle, lane = np.asarray(road.points), np.asarray(road.lane_centre)
        across = (lane - middle) * (2.0 / road.lane_width)  # unit vectors from the centre line to the driven edge
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(lane, axis=0).T))))
        ahead = (middle[-1] - middle[-2]) / np.hypot(*(middle[-1] - middle[-2]))
        middle = np.vstack((middle, middle[-1] + _LEAD_OUT * ahead))
        across, along = np.vstack((across, across[-1:])), np.append(along, along[-1] + _LEAD_OUT)
        half = spec.look.line_width / 2
        edge = road.lane_width - half
        self._stations = np.arange(0.0, along[-1], STEP)
        points, sideways = (
            np.column_stack([np.interp(self._stations, along, column) for column in table.T])
            for table in (middle, across)
        )

        def at(*offsets: float) -> list[_Points]:
            return [points + offset * sideways for offset in offsets]

        # Of each line its middle, the pavement to one or both sides, and its borders if there is grass beyond it.
        self._centre_line = (at(0.0, -half - BESIDE, half + BESIDE), at())
        self._edge_line = (at(edge, edge - half - BESIDE), at(edge - half, edge + half))

    def of(self, image: NDArray[np.uint8], state: VehicleState, arc_length: float) -> float:
        """Weber contrast, in linear light, of the line that is seen best; 0 if none is brighter than the pavement.

        Args:
            image: (rows, columns, 3) uint8 RGB.
            state: vehicle when the image was exposed.
            arc_length: distance of the vehicle along its lane, m.
        """
        first, end = np.searchsorted(self._stations, (arc_length, arc_length + LOOK_AHEAD))
        light = np.asarray(decode(image) @ _LUMINANCE, np.float32)
        found = [0.0]
        for line in (self._centre_line, self._edge_line):
            parts, borders = ([_project(part[first:end], state, self._camera) for part in some] for some in line)
            wide = _width(*borders) >= LEAST_WIDTH if borders else np.ones(end - first, np.bool_)
            found.append(self._of_line(parts, wide, light))
        return max(found)

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


def _project(ground: _Points, state: VehicleState, camera: CameraSpec) -> _Points:
    """Project points of the ground, (n, 2) m, to columns and rows, (n, 2) px; NaN behind the camera."""
    if not len(ground):
        return np.empty((0, 2))
    (place, turn), (mount, optical) = body_pose(state), camera_pose(camera)
    body = Rotation.from_quat(turn)
    centre = np.array(place) + body.apply(mount)
    seen = (body * Rotation.from_quat(optical)).inv().apply(np.column_stack((ground, np.zeros(len(ground)))) - centre)
    front = seen[:, 2] > NEAREST
    pixels = np.full((len(ground), 2), np.nan)
    if front.any():
        distortion = np.array(camera.distortion)
        found, _ = cv2.projectPoints(seen[front], np.zeros(3), np.zeros(3), camera.intrinsics, distortion)
        pixels[front] = found[:, 0]
    return pixels


class LineProbe:
    """Measures the contrast of the lines during a run, from its start on, and keeps it in the run's record.

    Args:
        run: record of the run; observations are seen as they are added to it.
        spec: simulator that drives.
    """

    def __init__(self, run: RunRecord, spec: SimulatorSpec) -> None:
        self._run, self._latency = run, spec.camera.latency
        self._contrast = LineContrast(run.road, spec, run.conditions)

    def see(self, observation: Observation | None) -> None:
        """Measure an observation if it is one in `PROBE_EVERY`."""
        if observation is None or observation.step % PROBE_EVERY:
            return
        # The image is that of a moment ago.
        exposed = self._run.observations[max(0, observation.step - self._latency)]
        contrast = self._contrast.of(observation.image, exposed.vehicle, exposed.lane.arc_length)
        self._run.line_contrasts.append(contrast)
