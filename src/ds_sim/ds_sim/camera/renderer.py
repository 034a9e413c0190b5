# SPDX-License-Identifier: Apache-2.0
"""Renders the image of a camera over a painted ground plane from the pose of the vehicle.

The ray of every pixel is intersected with the ground plane, at several heights within the pixel where its footprint is
longer than wide, and the colour is read bilinearly from the pyramid level that matches the width of the footprint.
Distant lines therefore neither break into dots nor flicker, for any roll, pitch, height and lens. A panorama fills the
image above the horizon; pixels on the horizon are blended by coverage.
"""

from __future__ import annotations

import itertools
import math
import threading
import weakref
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.atlas import Ground
from ds_sim.camera.lens import (
    SPARE_RAYS,
    Vector,
    components,
    optical_axes,
    pinhole_slopes,
    reversed_rays,
    sample_rays,
)
from ds_sim.camera.panorama import Panorama
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.simulator import VehicleState

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
_MOMENTS = np.concatenate([((np.arange(n) * (n // 2 + 1)) % n + 0.5) / n for n in SAMPLES])
"""Moments within the exposure, 0 to 1, of the samples of a pixel, for one number of samples after the other. They are
permuted, so that a sample's height in the pixel does not correlate with its time."""
SHARPNESS = 1.4
"""A level is used where the footprint of a pixel is 0.7 to 1.4 raster pixels wide; chosen: crisp lines. A value of 1 is
as close to the reference for the pinholes, and 1 dB closer for the twin."""
FARTHEST = 400.0
"""Distance beyond which the ground looks the same, m."""
_SPARE = 2.5
"""Width of the ground that is painted beyond what is in view, m, so that not every image has to look for more; chosen:
several steps."""


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
        self._spec, self._look = spec, look
        self.rows = self._top, self._bottom = rows or (0, spec.height_px)
        self._panorama = Panorama(spec, look)
        self._focal = float(spec.intrinsics[0, 0])
        # The rays of a lens do not depend on how it is mounted.
        self._lens = replace(spec, height=1.0, forward=0.0, pitch=0.0, yaw=0.0)
        centre = sample_rays(self._lens, 1)[0].reshape(3, spec.height_px, spec.width)
        self._centre_rays = centre
        self._min_sample_index = SAMPLES.index(BLUR_SAMPLES) if spec.exposure else 0
        self._max_ray_length = float(np.linalg.norm(centre, axis=0).max())
        probes = np.linspace(0, spec.width - 1, 5).round().astype(int)
        self._probe_rays = centre[:, :, probes].astype(np.float64)
        self._probe_error = _distance_to_chords(centre, probes)
        # Extremes of the rays, of which those between pixel centres exceed a pixel's by less than a hundredth.
        self._right_most = float(np.abs(centre[0]).max()) + 0.01
        self._down_least, self._down_most = float(centre[1].min()) - 0.01, float(centre[1].max()) + 0.01
        self._forward_least = float(centre[2].min()) - 0.01
        self._frame = np.zeros((spec.height_px, spec.width, 4), np.uint8)
        self._revealed: _Revealed | None = None

    @cached_property
    def with_all_rows(self) -> Camera:
        """Camera like this one that draws all rows; itself if it does."""
        return self if self.rows == (0, self._spec.height_px) else Camera(self._spec, self._look)

    def render(self, ground: Ground, vehicle: VehicleState) -> NDArray[np.uint8]:
        """Render the scene as the lens projects it, before the sensor: (rows, columns, 3) uint8 RGB."""
        spec, frame = self._spec, self._frame
        axes, (x, y, z) = optical_axes(spec, vehicle)
        height = max(z, 1e-3)
        self._reveal(ground, vehicle, axes, x, y)
        # Descent per unit along each ray: > 0 is ground, <= 0 is sky.
        descent = np.einsum("i,ijk->jk", [-axis[2] for axis in axes], self._probe_rays)
        descent.sort(axis=1)
        pixel = 1.0 / self._focal
        is_ground, is_sky = descent[:, -1] > -pixel, descent[:, 0] < pixel
        first = int(is_ground.argmax()) if is_ground.any() else spec.height_px
        sky_end = spec.height_px - int(is_sky[::-1].argmax()) if is_sky.any() else 0
        top, bottom = max(first, self._top), min(sky_end, self._bottom)
        cos, sin = math.cos(vehicle.yaw), math.sin(vehicle.yaw)
        turned = [(a * cos + b * sin, b * cos - a * sin, c) for a, b, c in axes]
        self._panorama.draw(frame, self._top, bottom, turned, vehicle.yaw)
        sky = frame[top:bottom].copy()
        to_plane = np.array([(height * a - c * x, height * b - c * y, -c) for a, b, c in axes])
        bands = [
            band.within(self._top, self._bottom)
            for band in self._bands(descent[first:], height, first, ground.distance_to_border(x, y))
            if band.bottom > self._top and band.top < self._bottom
        ]
        motion = self._motion_matrices(to_plane, ground, vehicle)
        per_descent = 2.0 * SHARPNESS * ground.resolution * self._focal / height
        # Where all rows use the finest level, less is to be computed.
        is_near = descent[:, 0] * per_descent > 1.0
        for group in ([b for b in bands if not is_near[b.top]], [b for b in bands if is_near[b.top]]):
            if group:
                self._draw_bands(ground, motion, group, height)
        if len(sky):
            self._blend_horizon(sky, axes, first, sky_end, top)
        image = np.empty((spec.height_px, spec.width, 3), np.uint8)
        image[: self._top] = image[self._bottom :] = 0
        cv2.cvtColor(frame[self._top : self._bottom], cv2.COLOR_RGBA2RGB, image[self._top : self._bottom])
        return image

    def _reveal(
        self, ground: Ground, vehicle: VehicleState, axes: tuple[Vector, Vector, Vector], x: float, y: float
    ) -> None:
        """Have all ground painted that can be seen from (x, y) at the levels that are not painted in full."""
        yaw, spec = vehicle.yaw, self._spec
        cos, sin = math.cos(yaw), math.sin(yaw)
        across, down, ahead = (axis[0] * cos + axis[1] * sin for axis in axes)
        # Least component along the heading of any ray. If it is positive, nothing behind the camera is in view.
        least = ahead * self._forward_least if ahead > 0.0 else -math.inf
        least += min(down * self._down_least, down * self._down_most) - abs(across) * self._right_most
        only_ahead = least > 0.0
        # Beyond this distance, m, a footprint is wider than what the finest level is used for; see `_draw_bands`.
        reach = 2.0 * SHARPNESS * ground.resolution * self._focal * self._max_ray_length * 1.01
        farthest = reach * 2.0 ** (ground.lazy_levels - 1)
        moved = math.hypot(vehicle.speed, vehicle.lateral_speed) + 2.0 * farthest * abs(vehicle.yaw_rate)
        blur = spec.exposure * moved
        then = self._revealed
        if then is not None and then.ground() is ground and (only_ahead or not then.only_ahead):
            change = max(abs(x - then.x), abs(y - then.y)) + farthest * abs(yaw - then.yaw) + blur - then.blur
            if change < _SPARE:
                return
        margin = blur + _SPARE
        for level in range(ground.lazy_levels):
            left, right = _extent(cos, abs(sin), reach, only_ahead)
            bottom, top = _extent(sin, abs(cos), reach, only_ahead)
            ground.reveal(level, (x - left - margin, y - bottom - margin), (x + right + margin, y + top + margin))
            reach *= 2.0
        self._revealed = _Revealed(weakref.ref(ground), x, y, yaw, blur, only_ahead)

    def _bands(self, ordered: NDArray[np.float64], height: float, first: int, border_distance: float) -> list[_Band]:
        """Bands of rows that are drawn alike, from the row `first` of the image on.

        The descents of some rays of every row are sorted, (rows, rays); heights and distances are in m.
        """
        if not len(ordered):
            return []
        lowest = ordered[:, 0] - self._probe_error
        far = (lowest * border_distance < height * self._max_ray_length) | (border_distance <= 0.0)
        # The aspect ratio of a footprint is distance over height, which is 1 / descent. Where the horizon is bent or
        # tilted, the farthest fifth of a row uses the number of samples that suits the rest.
        wanted = _SAMPLES.searchsorted(DENSITY[self._spec.lens] / np.maximum(ordered[:, 1], height / FARTHEST))
        wanted = wanted.clip(self._min_sample_index, len(SAMPLES) - 1)
        edges = [0, *((wanted[1:] != wanted[:-1]).nonzero()[0] + 1).tolist()]
        samples = [SAMPLES[index] for index in wanted[edges].tolist()]
        ends = [*edges[1:], len(wanted)]
        is_far = np.logical_or.reduceat(far, edges).tolist()
        return [_Band(first + a, first + b, n, f) for a, b, n, f in zip(edges, ends, samples, is_far, strict=True)]

    def _motion_matrices(
        self, to_plane: NDArray[np.float64], ground: Ground, vehicle: VehicleState
    ) -> dict[int, NDArray[np.float32]]:
        """Matrices from rays to the atlas for each sample of a pixel during the exposure, (samples or 1, 3, 3).

        The keys are numbers of samples. `to_plane` says, for each component of a ray, what it adds to x and y in the
        road frame, times the descent, and to the descent, (3, 3).
        """
        density, (left, top) = 1.0 / ground.resolution, ground.corner
        in_pixels = to_plane * (density, density, 1.0)
        if not self._spec.exposure:
            matrix = [(a - left * c, b - top * c, c) for a, b, c in in_pixels.tolist()]
            return dict.fromkeys(SAMPLES, np.array([matrix], np.float32).swapaxes(1, 2))
        times = -self._spec.exposure * _MOMENTS
        x, y, yaw = vehicle.x, vehicle.y, vehicle.yaw
        along = vehicle.speed * math.cos(yaw) - vehicle.lateral_speed * math.sin(yaw)
        across = vehicle.speed * math.sin(yaw) + vehicle.lateral_speed * math.cos(yaw)
        c, s = np.cos(vehicle.yaw_rate * times), np.sin(vehicle.yaw_rate * times)
        motion = np.zeros((len(times), 3, 3))
        motion[:, 0, 0], motion[:, 0, 1], motion[:, 0, 2] = c, -s, (x - c * x + s * y + along * times) * density - left
        motion[:, 1, 0], motion[:, 1, 1], motion[:, 1, 2] = s, c, (y - s * x - c * y + across * times) * density - top
        motion[:, 2, 2] = 1.0
        moved = np.einsum("sij,kj->sik", motion, in_pixels).astype(np.float32)
        ends = np.cumsum(SAMPLES).tolist()
        return {samples: moved[end - samples : end] for samples, end in zip(SAMPLES, ends, strict=True)}

    def _draw_bands(
        self, ground: Ground, motion: dict[int, NDArray[np.float32]], bands: list[_Band], height: float
    ) -> None:
        """Draw some bands of the image, from matrices as `_motion_matrices` returns them."""
        width = self._spec.width
        counts = [band.samples * (band.bottom - band.top) * width for band in bands]
        count = sum(counts)
        memory = _MEMORY.of(count)
        if self._spec.lens == "pinhole" and not self._spec.exposure:
            self._transform_rows(motion[1][0], bands, memory, count)
        else:
            self._transform_rays(motion, bands, memory)
        across, along, descent = memory.points[:, :count]
        far = any(band.far for band in bands)
        if far:
            descent.clip(np.float32(height / FARTHEST), np.float32(np.inf), descent)  # faster than np.maximum
        lines, columns = ground.shape
        # Scale of the pyramid level: clearing the fraction bits of a float rounds it down to a power of two.
        per_descent = np.float32(2.0 * SHARPNESS * ground.resolution * self._focal / height)
        if descent.min() * per_descent >= 1.0:
            scale = None
        else:
            scale = np.multiply(descent, per_descent, memory.scale[:count])
            bits = scale.view(np.int32)
            np.bitwise_and(bits, 0x7F800000, bits)
            scale.clip(np.float32(ground.coarsest_scale), np.float32(1.0), scale)
        if far:
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
        drawn = memory.drawn[: 4 * count].reshape(-1, width, 4)
        cv2.remap(
            ground.atlas,
            across.reshape(-1, width),
            along.reshape(-1, width),
            cv2.INTER_LINEAR,
            drawn,
            cv2.BORDER_REPLICATE,
        )
        end = 0
        for band, size in zip(bands, counts, strict=True):
            part = self._frame[band.top : band.bottom]
            samples = memory.drawn[4 * end : 4 * (end + size)].reshape(band.samples, -1)
            end += size
            if band.samples == 1:
                part[:] = samples.reshape(part.shape)
            elif band.samples == 2:  # faster than the general case
                cv2.addWeighted(samples[0], 0.5, samples[1], 0.5, 0.0, part.reshape(-1))
            else:
                cv2.reduce(samples, 0, cv2.REDUCE_AVG, part.reshape(1, -1))

    def _transform_rows(self, matrix: NDArray[np.float32], bands: list[_Band], memory: _Memory, count: int) -> None:
        """Multiply a pinhole's rays by one matrix, with the bits of `components`, but without reading a table."""
        slopes = [pinhole_slopes(self._lens, band.samples) for band in bands]
        of_rows = [rows[:, band.top : band.bottom].ravel() for band, (_, rows) in zip(bands, slopes, strict=True)]
        right, down = slopes[0][0], memory.scale[:count].reshape(-1, self._spec.width)
        down[:] = np.concatenate(of_rows)[:, None]
        for (a, b, c), out in zip(matrix.tolist(), memory.points[:, :count].reshape(3, *down.shape), strict=True):
            np.multiply(right, np.float32(a), out)
            cv2.scaleAdd(down, b, out, out)
            np.add(out, np.float32(c), out)

    def _transform_rays(self, motion: dict[int, NDArray[np.float32]], bands: list[_Band], memory: _Memory) -> None:
        """Multiply rays by the matrices of their samples, with the bits of `components`."""
        width, end = self._spec.width, 0
        for band in bands:
            rays = reversed_rays(self._lens, band.samples)[:, band.top * width : band.bottom * width + SPARE_RAYS]
            matrices = np.ascontiguousarray(motion[band.samples][:, :, ::-1])
            for of_sample, matrix in zip(rays, np.broadcast_to(matrices, (band.samples, 3, 3)), strict=True):
                cv2.transform(of_sample[None], matrix, memory.mixed[:, end : end + len(of_sample)])
                end += len(of_sample) - SPARE_RAYS
        cv2.split(memory.mixed[:, :end], list(memory.points[:, None, :end]))

    def _blend_horizon(
        self, sky: NDArray[np.uint8], axes: tuple[Vector, Vector, Vector], first: int, sky_end: int, top: int
    ) -> None:
        """Blend sky, in the rows from `top` on, into those that the horizon crosses: from `first` to `sky_end`."""
        descent = components(self._centre_rays[:, top : top + len(sky)], [-axis[2] * self._focal for axis in axes])
        np.subtract(0.5, descent, descent)
        descent *= 256.0
        share = cv2.merge((descent.clip(0, 256, descent).astype(np.uint16),) * 4)  # faster than broadcasting it
        frame = self._frame[top : top + len(sky)]
        mixed = sky * share
        mixed += frame * (256 - share)
        mixed += 128
        mixed >>= 8
        frame[:] = mixed


class _Band(NamedTuple):
    """Rows that are drawn alike: first, end, samples per pixel, whether they may leave the rasters."""

    top: int
    bottom: int
    samples: int
    far: bool

    def within(self, top: int, bottom: int) -> _Band:
        """Return the part between two rows."""
        return self._replace(top=max(self.top, top), bottom=min(self.bottom, bottom))


class _Revealed(NamedTuple):
    """From where a camera last had ground painted: position, m, heading, rad, motion during an exposure, m."""

    ground: weakref.ref[Ground]
    x: float
    y: float
    yaw: float
    blur: float
    only_ahead: bool


class _Memory(threading.local):
    """Working memory of a thread: it stays in the cache from band to band and from camera to camera."""

    size = -1

    def of(self, size: int) -> _Memory:
        """Return this memory, with room for a number of rays."""
        if self.size < size:
            self.size = size
            self.mixed = np.empty((1, size + SPARE_RAYS, 3), np.float32)
            self.points = np.empty((3, size), np.float32)
            self.scale = np.empty(size, np.float32)
            self.drawn = np.empty(4 * size, np.uint8)
        return self


_MEMORY = _Memory()


def _extent(heading: float, side: float, reach: float, ahead_only: bool) -> tuple[float, float]:
    """Extent of a disc, or of its half that lies ahead, towards smaller and larger coordinates along one axis.

    Along it, the heading has one component, and what is at right angles to the heading the other, absolute one.
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
