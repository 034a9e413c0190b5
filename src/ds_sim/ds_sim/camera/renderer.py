"""Renders the image of a camera over a painted ground plane from the pose of the vehicle.

The ray of every pixel is intersected with the ground plane, at several heights within the pixel where its footprint is
longer than wide, and the colour is read bilinearly from the pyramid level that matches the width of the footprint.
Distant lines therefore neither break into dots nor flicker, for any roll, pitch, height and lens. A panorama fills the
image above the horizon; pixels on the horizon are blended by coverage.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.ground import Ground
from ds_sim.camera.lens import sample_rays
from ds_sim.camera.look import Look
from ds_sim.camera.panorama import Panorama
from ds_sim.camera.sensor import Sensor
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

__all__ = ["Camera", "Sensor"]

SAMPLES = (1, 2, 4, 8)
"""Possible numbers of vertical samples per pixel; chosen: more than eight bring no visible gain in the distance, and
every further band of rows costs 40 us of overhead."""
BLUR_SAMPLES = 2
"""Smallest number of samples with motion blur; chosen: at full speed they are two pixels apart at the bottom of the
image, where raster pixels are wider than that."""
_SAMPLES = np.array(SAMPLES)
DENSITY = {"pinhole": 0.4, "equidistant": 0.25}
"""Samples per unit of aspect ratio (length over width) of a pixel's footprint; chosen: the smallest values with at
least 40 dB for every simulator (a low pinhole: 42 dB with 0.4, 38 dB with 0.3; the twin's lens: 44 dB with 0.25)."""
SHARPNESS = 1.4
"""A level is used where the footprint of a pixel is 0.7 to 1.4 raster pixels wide; chosen: crisp lines. A value of 1 is
as close to the reference for the pinholes, and 1 dB closer for the twin."""
FARTHEST = 400.0
"""Distance beyond which the ground looks the same, m."""


class Camera:
    """Renders images of one camera.

    It keeps its working memory between images, so that two threads need two of them.

    Args:
        spec: camera.
        look: appearance of the world, of which the background is used.
        rows: first row and end of the rows that are drawn; all rows if omitted. The others are zero.
    """

    def __init__(self, spec: CameraSpec, look: Look, rows: tuple[int, int] | None = None) -> None:
        cv2.setNumThreads(1)
        self._spec = spec
        self._top, self._bottom = rows or (0, spec.height_px)
        self._panorama = Panorama(spec, look)
        self._focal = float(spec.intrinsics[0, 0])
        centre = sample_rays(spec, 1)[0].reshape(3, spec.height_px, spec.width)
        self._centre_rays = centre
        self._min_sample_index = SAMPLES.index(BLUR_SAMPLES) if spec.exposure else 0
        self._max_ray_length = float(np.linalg.norm(centre, axis=0).max())
        probes = np.linspace(0, spec.width - 1, 5).round().astype(int)
        self._probe_rays = np.ascontiguousarray(centre[:, :, probes].reshape(3, -1), np.float64)
        self._probe_error = _distance_to_chords(centre, probes)
        # Extremes of the rays, of which those between pixel centres exceed a pixel's by less than a hundredth.
        self._right_most = float(np.abs(centre[0]).max()) + 0.01
        self._down_least, self._down_most = float(centre[1].min()) - 0.01, float(centre[1].max()) + 0.01
        self._forward_least = float(centre[2].min()) - 0.01
        self._frame = np.zeros((spec.height_px, spec.width, 4), np.uint8)
        self._memory = _Memory(0)

    def render(self, ground: Ground, vehicle: VehicleState) -> NDArray[np.uint8]:
        """Render the scene as the lens projects it, before the sensor: (rows, columns, 3) uint8 RGB."""
        spec, frame = self._spec, self._frame
        axes, position = self._pose(vehicle)
        x, y, z = position.tolist()
        height = max(z, 1e-3)
        self._reveal(ground, vehicle, axes, x, y)
        # Descent per unit along each ray: > 0 is ground, <= 0 is sky.
        descent = np.dot(-axes[None, :, 2], self._probe_rays).reshape(spec.height_px, -1)
        ordered = np.sort(descent, axis=1)
        pixel = 1.0 / self._focal
        is_ground, is_sky = ordered[:, -1] > -pixel, ordered[:, 0] < pixel
        first = int(is_ground.argmax()) if is_ground.any() else spec.height_px
        sky_end = spec.height_px - int(is_sky[::-1].argmax()) if is_sky.any() else 0
        top, bottom = max(first, self._top), self._bottom
        self._panorama.draw(frame, self._top, min(sky_end, bottom), axes @ _rotation(vehicle.yaw), vehicle.yaw)
        sky = frame[top : min(sky_end, bottom)].copy()
        to_atlas = ground.to_atlas @ np.column_stack((height * axes[:, :2] - axes[:, 2:] * position[:2], -axes[:, 2])).T
        for band in self._bands(ordered[first:], height, first, ground.distance_to_border(x, y)):
            if band.bottom > top and band.top < bottom:
                matrices = self._motion_matrices(to_atlas, ground, vehicle, band.samples)
                self._draw_band(ground, matrices, band.within(top, bottom), height)
        if len(sky):
            self._blend_horizon(sky, axes[:, 2], first, sky_end, top)
        image = np.zeros((spec.height_px, spec.width, 3), np.uint8)
        cv2.cvtColor(frame[self._top : bottom], cv2.COLOR_RGBA2RGB, image[self._top : bottom])
        return image

    def _pose(self, vehicle: VehicleState) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Optical axes in the road frame, rows right, down, forward (3, 3), and the optical centre (3,), m."""
        spec = self._spec
        yaw, pitch, roll = vehicle.yaw, vehicle.pitch, vehicle.roll
        cy, sy, cp, sp, cr, sr = (
            math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
        )  # fmt: skip
        forward = (cy * cp, sy * cp, -sp)
        left = (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
        up = (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
        # The body rotates about its centre at ground level: a common simplification of roll and pitch centres.
        centre = (vehicle.x, vehicle.y, vehicle.heave)
        position = np.array(
            [c + f * spec.forward + u * spec.height for c, f, u in zip(centre, forward, up, strict=True)]
        )
        ct, st = math.cos(spec.pitch), math.sin(spec.pitch)
        axes = np.array(
            [
                [-v for v in left],
                [-(u * ct + f * st) for f, u in zip(forward, up, strict=True)],
                [f * ct - u * st for f, u in zip(forward, up, strict=True)],
            ]
        )
        return axes, position

    def _reveal(self, ground: Ground, vehicle: VehicleState, axes: NDArray[np.float64], x: float, y: float) -> None:
        """Have all ground painted that can be seen from (x, y) at the levels that are not painted in full."""
        cos, sin = math.cos(vehicle.yaw), math.sin(vehicle.yaw)
        across, down, ahead = (axes[:, 0] * cos + axes[:, 1] * sin).tolist()
        # Least component along the heading of any ray. If it is positive, nothing behind the camera is in view.
        least = ahead * self._forward_least if ahead > 0.0 else -math.inf
        least += min(down * self._down_least, down * self._down_most) - abs(across) * self._right_most
        for level in range(ground.lazy_levels):
            # Beyond this distance, m, a footprint is wider than what the level is used for; see `_draw_band`.
            reach = 2.0**level * 2.0 * SHARPNESS * ground.resolution * self._focal * self._max_ray_length * 1.01
            moved = math.hypot(vehicle.speed, vehicle.lateral_speed) + 2.0 * reach * abs(vehicle.yaw_rate)
            margin = self._spec.exposure * moved + 0.1
            ahead_only = least > 0.0
            left, right = _extent(cos, abs(sin), reach, ahead_only)
            bottom, top = _extent(sin, abs(cos), reach, ahead_only)
            ground.reveal(level, (x - left - margin, y - bottom - margin), (x + right + margin, y + top + margin))

    def _bands(self, ordered: NDArray[np.float64], height: float, first: int, border_distance: float) -> list[_Band]:
        """Bands of rows that are drawn alike.

        Args:
            ordered: descents of some rays of every row, sorted, (rows, rays).
            height: height of the camera, m.
            first: row of the image to which the first row of `ordered` belongs.
            border_distance: distance to the border of the rasters, m.
        """
        if not len(ordered):
            return []
        lowest = ordered[:, 0] - self._probe_error
        far = (lowest * border_distance < height * self._max_ray_length) | (border_distance <= 0.0)
        # The aspect ratio of a footprint is distance over height, which is 1 / descent. Where the horizon is bent or
        # tilted, the farthest fifth of a row uses the number of samples that suits the rest.
        wanted = _SAMPLES.searchsorted(DENSITY[self._spec.lens] / np.maximum(ordered[:, 1], height / FARTHEST))
        wanted = wanted.clip(self._min_sample_index, len(SAMPLES) - 1)
        edges = [0, *((wanted[1:] != wanted[:-1]).nonzero()[0] + 1).tolist(), len(wanted)]
        return [
            _Band(first + a, first + b, SAMPLES[wanted[a]], bool(far[a:b].any()))
            for a, b in zip(edges[:-1], edges[1:], strict=True)
        ]

    def _motion_matrices(
        self, to_atlas: NDArray[np.float64], ground: Ground, vehicle: VehicleState, samples: int
    ) -> NDArray[np.float32]:
        """Matrices from rays to the atlas for each sample of a pixel during the exposure, (samples or 1, 3, 3)."""
        if not self._spec.exposure:
            return to_atlas[None].astype(np.float32)
        # Times are permuted, so that a sample's height in the pixel does not correlate with its time.
        order = (np.arange(samples) * (samples // 2 + 1)) % samples if samples > 1 else np.zeros(1)
        times = -self._spec.exposure * (order + 0.5) / samples
        x, y, yaw = vehicle.x, vehicle.y, vehicle.yaw
        along = vehicle.speed * math.cos(yaw) - vehicle.lateral_speed * math.sin(yaw)
        across = vehicle.speed * math.sin(yaw) + vehicle.lateral_speed * math.cos(yaw)
        c, s = np.cos(vehicle.yaw_rate * times), np.sin(vehicle.yaw_rate * times)
        motion = np.zeros((samples, 3, 3))
        motion[:, 0, 0], motion[:, 0, 1], motion[:, 0, 2] = c, -s, x - c * x + s * y + along * times
        motion[:, 1, 0], motion[:, 1, 1], motion[:, 1, 2] = s, c, y - s * x - c * y + across * times
        motion[:, 2, 2] = 1.0
        return np.asarray(ground.to_atlas @ motion @ ground.from_atlas @ to_atlas, np.float32)

    def _draw_band(self, ground: Ground, matrices: NDArray[np.float32], band: _Band, height: float) -> None:
        """Draw one band of the image."""
        width, samples = self._spec.width, band.samples
        rows = band.bottom - band.top
        count = samples * rows * width
        if self._memory.size < count:
            self._memory = _Memory(count)
        across, along, descent = points = self._memory.points[:, :count]
        np.matmul(
            matrices,
            sample_rays(self._spec, samples)[:, :, band.top * width : band.bottom * width],
            points.reshape(3, samples, -1).transpose(1, 0, 2),
        )
        if band.far:
            np.maximum(descent, np.float32(height / FARTHEST), out=descent)
        lines, columns = ground.shape
        # Scale of the pyramid level: clearing the fraction bits of a float rounds it down to a power of two.
        per_descent = np.float32(2.0 * SHARPNESS * ground.resolution * self._focal / height)
        if descent.min() * per_descent >= 1.0:
            scale = None
        else:
            scale = np.multiply(descent, per_descent, self._memory.scale[:count])
            bits = scale.view(np.int32)
            np.bitwise_and(bits, 0x7F800000, bits)
            scale.clip(np.float32(ground.coarsest_scale), np.float32(1.0), scale)
        if band.far:
            np.divide(np.float32(1.0), descent, descent)
            np.multiply(across, descent, across).clip(np.float32(-2 * columns), np.float32(-columns), across)
            np.multiply(along, descent, along).clip(np.float32(0), np.float32(lines), along)
            if scale is not None:
                across *= scale
                along *= scale
        else:
            np.divide(np.float32(1.0) if scale is None else scale, descent, descent)
            across *= descent
            along *= descent
        across += np.float32(2 * columns - 0.5)
        along -= np.float32(0.5)
        shape = (samples * rows, width)
        part = self._frame[band.top : band.bottom]
        drawn = part if samples == 1 else self._memory.drawn[: 4 * count].reshape(*shape, 4)
        cv2.remap(
            ground.atlas, across.reshape(shape), along.reshape(shape), cv2.INTER_LINEAR, drawn, cv2.BORDER_REPLICATE
        )
        if samples > 1:
            mean = cv2.reduce(drawn.reshape(samples, -1), 0, cv2.REDUCE_AVG)
            part[:] = mean.reshape(part.shape)

    def _blend_horizon(
        self, sky: NDArray[np.uint8], axes_up: NDArray[np.float64], first: int, sky_end: int, top: int
    ) -> None:
        """Blend sky into rows that the horizon crosses.

        Args:
            sky: background in the rows to blend, (rows, columns, 4).
            axes_up: upward components of the optical axes.
            first: first row that shows ground.
            sky_end: end of the rows that show sky.
            top: first row of `sky`.
        """
        rays = self._centre_rays[:, first:sky_end]
        descent = np.dot((-axes_up * self._focal).astype(np.float32)[None], rays.reshape(3, -1)).reshape(rays.shape[1:])
        cover = np.clip((0.5 - descent[top - first : top - first + len(sky)]) * 256.0, 0, 256)
        share = cover.astype(np.uint16)[:, :, None]
        frame = self._frame[top : top + len(sky)]
        frame[:] = (frame * (256 - share) + sky * share + 128) >> 8


class _Band(NamedTuple):
    """Rows that are drawn alike: first, end, samples per pixel, whether they may leave the rasters."""

    top: int
    bottom: int
    samples: int
    far: bool

    def within(self, top: int, bottom: int) -> _Band:
        """Return the part between two rows."""
        return self._replace(top=max(self.top, top), bottom=min(self.bottom, bottom))


class _Memory:
    """Working memory for a number of rays: it stays in the cache from band to band."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.points = np.empty((3, size), np.float32)
        self.scale = np.empty(size, np.float32)
        self.drawn = np.empty(4 * size, np.uint8)


def _extent(heading: float, side: float, reach: float, ahead_only: bool) -> tuple[float, float]:
    """Extent of a disc, or of its half that lies ahead, towards smaller and larger coordinates along one axis.

    Args:
        heading: component of the heading along the axis.
        side: absolute component along the axis of what is at right angles to the heading.
        reach: radius of the disc.
        ahead_only: whether to take the half.
    """
    if not ahead_only:
        return reach, reach
    return (side * reach, reach) if heading >= 0.0 else (reach, side * reach)


def _distance_to_chords(rays: NDArray[np.float32], probes: NDArray[np.int64]) -> float:
    """Largest distance of a ray from the chords between the probes of its row.

    No descent along a unit vector is less than the least of the row's probes by more than that.
    """
    nearest = np.full(rays.shape[1:], np.inf)
    for left, right in itertools.pairwise(probes.tolist()):
        start, chord = rays[:, :, left, None], (rays[:, :, right] - rays[:, :, left])[:, :, None]
        offset = rays[:, :, left : right + 1] - start
        share = np.clip((offset * chord).sum(axis=0) / (chord * chord).sum(axis=0), 0.0, 1.0)
        distance = np.linalg.norm(offset - share * chord, axis=0)
        nearest[:, left : right + 1] = np.minimum(nearest[:, left : right + 1], distance)
    return float(nearest.max())


def _rotation(yaw: float) -> NDArray[np.float64]:
    """Rotation matrix by yaw about the vertical, (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
