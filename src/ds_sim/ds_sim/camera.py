"""A camera over a painted plane: pose in, frame out.

A frame is drawn through the homography between the ground plane and the image of the camera's full six-degree pose.
Rows are drawn in bands: a band reads the pyramid level that matches how wide a pixel is on the ground, and is
supersampled along the road only, where a pixel is many times longer than wide. So far lines neither break nor flicker.
"""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera_spec import CameraSpec
from ds_sim.ground import Ground
from ds_sim.look import Look
from ds_sim.simulator import VehicleState

MAX_SUPERSAMPLING = 8
"""Samples along the road per image row at most; chosen: 8 reach 44 dB against 4 with 40 dB in the far band."""
FARTHEST = 400.0
"""Metres; ground beyond is drawn as the horizon's colour."""
PINHOLE_SCALE = 0.75
"""Resolution of the pinhole image behind a wide-angle lens; chosen: its borders, where a lens shows less, stay sharp
and its middle is a little soft, as cheap wide lenses are."""
_NOISE_MARGIN = 64


class Camera:
    """Draws frames of one ground for one camera.

    Args:
        spec: the camera.
        look: colours of sky and horizon.
    """

    def __init__(self, spec: CameraSpec, look: Look) -> None:
        cv2.setNumThreads(1)
        self._spec = spec
        self._look = look
        self._lens = _WideLens(spec) if spec.lens == "equidistant" else None
        matrix = self._lens.pinhole if self._lens else spec.intrinsics
        self._matrix: NDArray[np.float64] = matrix
        self._inverse: NDArray[np.float64] = np.linalg.inv(matrix)
        size: tuple[int, int] = self._lens.size if self._lens else (spec.width, spec.height_px)
        self._width, self._height = size
        self._sky = _Panorama(look, focal=float(matrix[0, 0]), width=self._width)

    def render(self, ground: Ground, vehicle: VehicleState) -> NDArray[np.uint8]:
        """The scene as the lens images it, before the sensor: (rows, columns, 3) uint8 RGB."""
        axes, position = self._pose(vehicle)
        frame = np.empty((self._height, self._width, 3), np.uint8)
        # Height lost per unit of depth is linear in the pixel: > 0 is ground, <= 0 is sky.
        fall = -(axes.T @ self._inverse)[2]
        across = abs(fall[0]) * (self._width - 1) / 2
        middle = fall[0] * (self._width - 1) / 2 + fall[2] + fall[1] * np.arange(self._height)
        limit = position[2] / FARTHEST
        first = int(np.searchsorted(middle + across, limit))
        solid = min(int(np.searchsorted(middle - across, limit)), self._height)
        horizon = -(middle[0] / fall[1])
        self._sky.draw(frame, solid, horizon, vehicle.yaw)
        if first >= self._height:
            return self._imaged(frame)
        sky_part = frame[first:solid].copy()
        view = self._matrix @ np.column_stack((axes[:, :2], -axes @ position))
        for top, bottom, level, samples in self._bands(middle, limit, first, float(position[2]), ground):
            self._draw_band(frame, ground, view, top, bottom, level, samples)
        if solid > first:
            columns = fall[0] * np.arange(self._width) + fall[2]
            sky = columns[None, :] + fall[1] * np.arange(first, solid)[:, None] <= limit
            np.copyto(frame[first:solid], sky_part, where=sky[:, :, None])
        return self._imaged(frame)

    def _pose(self, vehicle: VehicleState) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rows right, down, forward of the optical axes in the road frame (3, 3), and the optical centre (3,)."""
        yaw, pitch, roll = vehicle.yaw, vehicle.pitch, vehicle.roll
        cy, sy, cp, sp, cr, sr = (
            math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
        )  # fmt: skip
        body = np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )
        forward, left, up = body.T
        # The body turns about its centre at ground level: a textbook simplification of roll and pitch centres.
        position = np.array([vehicle.x, vehicle.y, vehicle.heave]) + forward * self._spec.forward
        position = position + up * self._spec.height
        ct, st = math.cos(self._spec.pitch), math.sin(self._spec.pitch)
        return np.array([-left, -(up * ct + forward * st), forward * ct - up * st]), position

    def _bands(
        self, middle: NDArray[np.float64], limit: float, first: int, height: float, ground: Ground
    ) -> list[tuple[int, int, int, int]]:
        """Rows (top, bottom) that share a pyramid level and a number of samples along the road."""
        fall = np.maximum(middle[first:], limit)
        depth = height / fall
        pixel = 1.0 / self._matrix[0, 0]
        level = np.clip(np.log2(depth * pixel / ground.resolution), 0, len(ground.levels) - 1).astype(int)
        along = depth * depth * pixel / height
        samples = np.clip(along / (ground.resolution * 2.0**level), 1, MAX_SUPERSAMPLING)
        samples = 2 ** np.ceil(np.log2(samples) - 0.2).astype(int)
        key = level * 64 + samples
        cuts = np.flatnonzero(np.diff(key)) + 1
        edges = [0, *cuts.tolist(), len(key)]
        return [
            (first + a, first + b, int(level[a]), int(samples[a])) for a, b in zip(edges[:-1], edges[1:], strict=True)
        ]

    def _draw_band(
        self,
        frame: NDArray[np.uint8],
        ground: Ground,
        view: NDArray[np.float64],
        top: int,
        bottom: int,
        level: int,
        samples: int,
    ) -> None:
        """Draw rows [top, bottom) from one level; `view` takes ground (x, y, 1) to image pixels."""
        to_rows = np.array([[1.0, 0.0, 0.0], [0.0, samples, (0.5 - top) * samples - 0.5], [0.0, 0.0, 1.0]])
        matrix = to_rows @ view @ ground.pixel_to_world(level)
        size = (self._width, (bottom - top) * samples)
        band = cv2.warpPerspective(
            ground.levels[level],
            matrix,
            size,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=ground.outside,
        )
        if samples > 1:
            cv2.resize(band, (self._width, bottom - top), frame[top:bottom], interpolation=cv2.INTER_AREA)
        else:
            frame[top:bottom] = band

    def _imaged(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return self._lens.bend(frame) if self._lens else frame


class Sensor:
    """Turns a scene into what the sensor delivers: exposure, response, noise and latency.

    Args:
        spec: the camera.
        rng: source of the noise; one sensor serves one run.
    """

    def __init__(self, spec: CameraSpec, rng: np.random.Generator) -> None:
        self._spec = spec
        self._rng = rng
        levels = np.arange(256) / 255.0
        self._response = np.clip(255.0 * (spec.gain * levels) ** spec.gamma, 0, 255).round().astype(np.uint8)
        self._noise: NDArray[np.int16] | None = None
        if spec.noise > 0.0:
            shape = (spec.height_px + _NOISE_MARGIN, spec.width + _NOISE_MARGIN, 3)
            self._noise = np.round(rng.normal(0.0, spec.noise, shape)).astype(np.int16)
        self._delayed: list[NDArray[np.uint8]] = []

    def deliver(self, scene: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Expose one frame, and return the one that arrives now (the first one until then)."""
        image = cv2.LUT(scene, self._response)
        if self._noise is not None:
            # A random window of one noise plate: new noise for each frame at a fraction of its cost.
            row, column = self._rng.integers(0, _NOISE_MARGIN, 2)
            plate = self._noise[row : row + self._spec.height_px, column : column + self._spec.width]
            image = cv2.add(image, plate, dtype=cv2.CV_8U)
        image.setflags(write=False)
        self._delayed.append(image)
        if len(self._delayed) > self._spec.latency + 1:
            self._delayed.pop(0)
        return self._delayed[0]


class _WideLens:
    """Bends a pinhole image as an equidistant wide-angle lens does."""

    def __init__(self, spec: CameraSpec) -> None:
        matrix = spec.intrinsics
        focal = float(matrix[0, 0])
        rows, columns = np.mgrid[0 : spec.height_px, 0 : spec.width].astype(np.float64)
        right, down = (columns - matrix[0, 2]) / focal, (rows - matrix[1, 2]) / focal
        angle = np.hypot(right, down)
        stretch = np.tan(angle) / np.maximum(angle, 1e-9)
        right, down = right * stretch, down * stretch
        focal *= PINHOLE_SCALE
        width, height = (math.ceil(2 * np.abs(v).max() * focal) + 2 for v in (right, down))
        self.size: tuple[int, int] = (width, height)
        self.pinhole = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
        map_x = (right * focal + (width - 1) / 2).astype(np.float32)
        map_y = (down * focal + (height - 1) / 2).astype(np.float32)
        self._maps = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)

    def bend(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The delivered image of a pinhole image."""
        return cv2.remap(frame, self._maps[0], self._maps[1], cv2.INTER_LINEAR)


class _Panorama:
    """Sky and far skyline all around, drawn above the horizon only."""

    def __init__(self, look: Look, *, focal: float, width: int) -> None:
        self._focal = focal
        self._width = width
        self._look = look

    @cached_property
    def _strip(self) -> NDArray[np.uint8]:
        """(rows, columns, 3): last row at the horizon, columns over a full turn to the right and one image more."""
        turn = max(round(2 * math.pi * self._focal), 1)
        rows = max(round(self._focal), 64)
        share = np.linspace(1.0, 0.0, rows)[:, None]
        sky = (1 - share) * np.asarray(self._look.horizon) + share * np.asarray(self._look.sky_top)
        strip = np.repeat(sky[:, None, :], turn, axis=1).round().astype(np.uint8)
        if self._look.hills > 0.0:
            rng = np.random.default_rng(self._look.grain_seed)
            angle = np.arange(turn) * (2 * math.pi / turn)
            ridge = sum(
                rng.uniform(0.3, 1.0) / n * np.sin(n * angle + rng.uniform(0, 2 * math.pi)) for n in range(2, 24)
            )
            share_of_height = 0.2 + 0.8 * (ridge - ridge.min()) / (ridge.max() - ridge.min())
            pixels = self._focal * math.tan(math.radians(self._look.hills)) * share_of_height
            above = np.arange(rows - 1, -1, -1)[:, None]
            strip[above < pixels[None, :]] = self._look.hill_colour
        return np.concatenate((strip, strip[:, : self._width]), axis=1)

    def draw(self, frame: NDArray[np.uint8], rows: int, horizon: float, yaw: float) -> None:
        """Fill the first `rows` rows of a frame whose horizon lies at row `horizon`."""
        if rows <= 0:
            return
        strip = self._strip
        turn = strip.shape[1] - self._width
        start = int(-yaw / (2 * math.pi) * turn) % turn
        offset = strip.shape[0] - 1 - int(math.floor(horizon))
        source = np.clip(np.arange(rows) + offset, 0, strip.shape[0] - 1)
        frame[:rows] = strip[source, start : start + self._width]
