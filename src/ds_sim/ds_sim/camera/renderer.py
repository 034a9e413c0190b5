"""A camera over a painted plane: pose in, frame out.

Every pixel's ray is met with the ground plane, at several heights within the pixel where a pixel is longer on the
ground than wide, and read bilinearly from the pyramid level that matches the pixel's width there. So far lines
neither break into dots nor flicker, for any roll, pitch, height and lens. Above the horizon stands a panorama; the
horizon itself is blended by the share of the pixel that it covers.
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
"""Samples below each other in a pixel; chosen: the far band gains nothing visible from more than eight, and every
further count costs 40 us to begin."""
BLUR_SAMPLES = 2
"""Samples at least with motion blur; chosen: at full speed they lie two pixels apart at the
image's bottom, where raster pixels are wider than that."""
DENSITY = {"pinhole": 0.4, "equidistant": 0.25}
"""Samples over length per width of a pixel on the ground; chosen: the least with 40 dB and more for every simulator
(a low pinhole has 42 dB with 0.4 and 38 dB with 0.3, the twin's lens 44 dB with 0.25)."""
SHARPNESS = 1.4
"""A level is read when a pixel on the ground is as wide as 0.7 to 1.4 of its raster pixels; chosen: crisp lines.
1 is as close to the reference for the pinholes, and 1 dB closer for the twin."""
FARTHEST = 400.0
"""Metres; ground beyond looks as it does there."""


class Camera:
    """Draws frames of one ground for one camera.

    Args:
        spec: the camera.
        look: colours of sky and horizon.
    """

    def __init__(self, spec: CameraSpec, look: Look) -> None:
        cv2.setNumThreads(1)
        self._spec = spec
        self._panorama = Panorama(spec, look)
        self._focal = float(spec.intrinsics[0, 0])
        self._centre_rays = sample_rays(spec, 1)[0].reshape(3, spec.height_px, spec.width)
        self._least = SAMPLES.index(BLUR_SAMPLES) if spec.exposure else 0
        self._longest = float(np.linalg.norm(self._centre_rays, axis=0).max())
        probes = np.linspace(0, spec.width - 1, 5).round().astype(int)
        self._probe_rays = self._centre_rays[:, :, probes].astype(np.float64)

    def render(self, ground: Ground, vehicle: VehicleState) -> NDArray[np.uint8]:
        """The scene as the lens images it, before the sensor: (rows, columns, 3) uint8 RGB."""
        spec = self._spec
        axes, position = self._pose(vehicle)
        height = max(float(position[2]), 1e-3)
        # Height lost per unit along each ray: > 0 is ground, <= 0 is sky.
        fall = np.tensordot(-axes[:, 2], self._probe_rays, 1)
        low, high = fall.min(axis=1), fall.max(axis=1)
        pixel = 1.0 / self._focal
        is_ground, is_sky = high > -pixel, low < pixel
        first = int(np.argmax(is_ground)) if is_ground.any() else spec.height_px
        solid = spec.height_px - int(np.argmax(is_sky[::-1])) if is_sky.any() else 0
        frame = np.empty((spec.height_px, spec.width, 4), np.uint8)
        self._panorama.draw(frame, solid, axes @ _turn(vehicle.yaw), vehicle.yaw)
        sky = frame[first:solid].copy()
        to_atlas = ground.to_atlas @ np.column_stack(
            (height * axes[:, :2] - axes[:, 2:] * position[:2], -axes[:, 2])
        ).T  # fmt: skip
        for top, bottom, samples, far in self._bands(fall[first:], height, first, ground.room(position)):
            moved = self._moved(to_atlas, ground, vehicle, samples)
            self._draw_band(frame[top:bottom], ground, moved, top, samples, height, far)
        if solid > first:
            self._blend_horizon(frame[first:solid], sky, axes[:, 2], first)
        return np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGBA2RGB), np.uint8)

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
        self, fall: NDArray[np.float64], height: float, first: int, room: float
    ) -> list[tuple[int, int, int, bool]]:
        """Rows (top, bottom, samples in a pixel, may leave the raster) that are drawn alike."""
        if not len(fall):
            return []
        ordered = np.sort(fall, axis=1)
        far = ordered[:, 0] * room < height * self._longest
        # Length over width of a pixel on the ground is distance over height, which is 1 / fall; under a horizon that
        # is bent or tilted the farthest fifth of a row must do with what is good for the rest.
        wanted = np.searchsorted(SAMPLES, DENSITY[self._spec.lens] / np.maximum(ordered[:, 1], height / FARTHEST))
        wanted = wanted.clip(self._least, len(SAMPLES) - 1)
        cuts = np.flatnonzero(np.diff(wanted)) + 1
        edges = [0, *cuts.tolist(), len(wanted)]
        return [
            (first + a, first + b, SAMPLES[wanted[a]], bool(far[a:b].any()))
            for a, b in zip(edges[:-1], edges[1:], strict=True)
        ]

    def _moved(
        self, to_atlas: NDArray[np.float64], ground: Ground, vehicle: VehicleState, samples: int
    ) -> NDArray[np.float32]:
        """The matrix from rays to the atlas for each sample of a pixel, over the exposure, (samples or 1, 3, 3)."""
        if not self._spec.exposure:
            return to_atlas[None].astype(np.float32)
        # Times are dealt out of order, so that the sample's height in the pixel says nothing about its time.
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
        """Draw the rows of `frame`, of which the first is row `top` of the image."""
        rows, width = frame.shape[:2]
        part = slice(top * width, (top + rows) * width)
        points = np.matmul(matrices, sample_rays(self._spec, samples)[:, :, part])
        fall = points[:, 2]
        if far:
            fall = np.maximum(fall, np.float32(height / FARTHEST))
        # The power of two at or above raster pixel / pixel width: the bits of a float without its fraction.
        scale = fall * np.float32(2.0 * SHARPNESS * ground.resolution * self._focal / height)
        bits = scale.view(np.int32)
        np.bitwise_and(bits, 0x7F800000, out=bits)
        np.clip(scale, np.float32(ground.coarsest), np.float32(1.0), out=scale)
        lines, columns = ground.levels[0].shape[:2]
        if far:
            near = 1.0 / fall
            across = np.clip(points[:, 0] * near, np.float32(-2 * columns), np.float32(-columns))
            along = np.clip(points[:, 1] * near, np.float32(0), np.float32(lines))
            across *= scale
            along *= scale
        else:
            scale /= fall
            across, along = points[:, 0] * scale, points[:, 1] * scale
        across += np.float32(2 * columns - 0.5)
        along -= np.float32(0.5)
        shape = (samples * rows, width)
        picture = cv2.remap(
            ground.atlas, across.reshape(shape), along.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        if samples == 1:
            frame[:] = picture
            return
        total = picture.reshape(samples, rows, width * 4).sum(axis=0, dtype=np.uint16)
        frame[:] = cv2.convertScaleAbs(total, alpha=1.0 / samples).reshape(frame.shape)

    def _blend_horizon(
        self, frame: NDArray[np.uint8], sky: NDArray[np.uint8], down: NDArray[np.float64], first: int
    ) -> None:
        """Mix sky into rows that the horizon crosses; `down` holds how far the optical axes point up."""
        rays = self._centre_rays[:, first : first + len(frame)]
        fall = np.tensordot((-down * self._focal).astype(np.float32), rays, 1)
        cover = np.clip((0.5 - fall) * 256.0, 0, 256).astype(np.uint16)[:, :, None]
        frame[:] = (frame * (256 - cover) + sky * cover + 128) >> 8


def _turn(yaw: float) -> NDArray[np.float64]:
    """Columns: the axes of a frame turned by yaw, in the road frame (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
