"""Renders the image of a camera over a painted ground plane from the pose of the vehicle.

The ray of every pixel is intersected with the ground plane, at several heights within the pixel where its footprint is
longer than wide, and the colour is read bilinearly from the pyramid level that matches the width of the footprint.
Distant lines therefore neither break into dots nor flicker, for any roll, pitch, height and lens. A panorama fills the
image above the horizon; pixels on the horizon are blended by coverage.
"""

from __future__ import annotations

import math

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

    Args:
        spec: camera.
        look: appearance of the world, of which the background is used.
    """

    def __init__(self, spec: CameraSpec, look: Look) -> None:
        cv2.setNumThreads(1)
        self._spec = spec
        self._panorama = Panorama(spec, look)
        self._focal = float(spec.intrinsics[0, 0])
        self._centre_rays = sample_rays(spec, 1)[0].reshape(3, spec.height_px, spec.width)
        self._min_sample_index = SAMPLES.index(BLUR_SAMPLES) if spec.exposure else 0
        self._max_ray_length = float(np.linalg.norm(self._centre_rays, axis=0).max())
        probes = np.linspace(0, spec.width - 1, 5).round().astype(int)
        self._probe_rays = self._centre_rays[:, :, probes].astype(np.float64)

    def render(self, ground: Ground, vehicle: VehicleState) -> NDArray[np.uint8]:
        """Render the scene as the lens projects it, before the sensor: (rows, columns, 3) uint8 RGB."""
        spec = self._spec
        axes, position = self._pose(vehicle)
        height = max(float(position[2]), 1e-3)
        # Descent per unit along each ray: > 0 is ground, <= 0 is sky.
        descent = np.tensordot(-axes[:, 2], self._probe_rays, 1)
        low, high = descent.min(axis=1), descent.max(axis=1)
        pixel = 1.0 / self._focal
        is_ground, is_sky = high > -pixel, low < pixel
        first = int(np.argmax(is_ground)) if is_ground.any() else spec.height_px
        sky_end = spec.height_px - int(np.argmax(is_sky[::-1])) if is_sky.any() else 0
        frame = np.empty((spec.height_px, spec.width, 4), np.uint8)
        self._panorama.draw(frame, sky_end, axes @ _rotation(vehicle.yaw), vehicle.yaw)
        sky = frame[first:sky_end].copy()
        to_atlas = ground.to_atlas @ np.column_stack(
            (height * axes[:, :2] - axes[:, 2:] * position[:2], -axes[:, 2])
        ).T  # fmt: skip
        for top, bottom, samples, far in self._bands(
            descent[first:], height, first, ground.distance_to_border(position)
        ):
            matrices = self._motion_matrices(to_atlas, ground, vehicle, samples)
            self._draw_band(frame[top:bottom], ground, matrices, top, samples, height, far)
        if sky_end > first:
            self._blend_horizon(frame[first:sky_end], sky, axes[:, 2], first)
        return np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGBA2RGB), np.uint8)

    def _pose(self, vehicle: VehicleState) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Optical axes in the road frame, rows right, down, forward (3, 3), and the optical centre (3,), m."""
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
        # The body rotates about its centre at ground level: a common simplification of roll and pitch centres.
        position = np.array([vehicle.x, vehicle.y, vehicle.heave]) + forward * self._spec.forward
        position = position + up * self._spec.height
        ct, st = math.cos(self._spec.pitch), math.sin(self._spec.pitch)
        return np.array([-left, -(up * ct + forward * st), forward * ct - up * st]), position

    def _bands(
        self, descent: NDArray[np.float64], height: float, first: int, border_distance: float
    ) -> list[tuple[int, int, int, bool]]:
        """Bands of rows that are drawn alike: (top, bottom, samples per pixel, whether they may leave the raster)."""
        if not len(descent):
            return []
        ordered = np.sort(descent, axis=1)
        far = ordered[:, 0] * border_distance < height * self._max_ray_length
        # The aspect ratio of a footprint is distance over height, which is 1 / descent. Where the horizon is bent or
        # tilted, the farthest fifth of a row uses the number of samples that suits the rest.
        wanted = np.searchsorted(SAMPLES, DENSITY[self._spec.lens] / np.maximum(ordered[:, 1], height / FARTHEST))
        wanted = wanted.clip(self._min_sample_index, len(SAMPLES) - 1)
        cuts = np.flatnonzero(np.diff(wanted)) + 1
        edges = [0, *cuts.tolist(), len(wanted)]
        return [
            (first + a, first + b, SAMPLES[wanted[a]], bool(far[a:b].any()))
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

    def _draw_band(
        self,
        frame: NDArray[np.uint8],
        ground: Ground,
        matrices: NDArray[np.float32],
        top: int,
        samples: int,
        height: float,
        far: bool,
    ) -> None:
        """Draw one band: the rows of `frame`, the first of which is row `top` of the image."""
        rows, width = frame.shape[:2]
        part = slice(top * width, (top + rows) * width)
        points = np.matmul(matrices, sample_rays(self._spec, samples)[:, :, part])
        descent = points[:, 2]
        if far:
            descent = np.maximum(descent, np.float32(height / FARTHEST))
        # Scale of the pyramid level: clearing the fraction bits of a float rounds it down to a power of two.
        scale = descent * np.float32(2.0 * SHARPNESS * ground.resolution * self._focal / height)
        bits = scale.view(np.int32)
        np.bitwise_and(bits, 0x7F800000, out=bits)
        np.clip(scale, np.float32(ground.coarsest_scale), np.float32(1.0), out=scale)
        lines, columns = ground.levels[0].shape[:2]
        if far:
            inverse = 1.0 / descent
            across = np.clip(points[:, 0] * inverse, np.float32(-2 * columns), np.float32(-columns))
            along = np.clip(points[:, 1] * inverse, np.float32(0), np.float32(lines))
            across *= scale
            along *= scale
        else:
            scale /= descent
            across, along = points[:, 0] * scale, points[:, 1] * scale
        across += np.float32(2 * columns - 0.5)
        along -= np.float32(0.5)
        shape = (samples * rows, width)
        band = cv2.remap(
            ground.atlas, across.reshape(shape), along.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        if samples == 1:
            frame[:] = band
            return
        total = band.reshape(samples, rows, width * 4).sum(axis=0, dtype=np.uint16)
        frame[:] = cv2.convertScaleAbs(total, alpha=1.0 / samples).reshape(frame.shape)

    def _blend_horizon(
        self, frame: NDArray[np.uint8], sky: NDArray[np.uint8], axes_up: NDArray[np.float64], first: int
    ) -> None:
        """Blend sky into rows that the horizon crosses; `axes_up` holds the upward components of the optical axes."""
        rays = self._centre_rays[:, first : first + len(frame)]
        descent = np.tensordot((-axes_up * self._focal).astype(np.float32), rays, 1)
        cover = np.clip((0.5 - descent) * 256.0, 0, 256).astype(np.uint16)[:, :, None]
        frame[:] = (frame * (256 - cover) + sky * cover + 128) >> 8


def _rotation(yaw: float) -> NDArray[np.float64]:
    """Rotation matrix by yaw about the vertical, (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
