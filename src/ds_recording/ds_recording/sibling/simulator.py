# SPDX-License-Identifier: Apache-2.0
"""The recorded track as a simulator: `recording@FOLDER`, with the folder that `ds recording locate` wrote.

What its camera would see: the nearest photograph, moved to the car by the plane of the floor.

Every ray of the camera meets the floor, or goes to infinity above the horizon; from the place of a photograph it is the
same point of the floor, or the same direction. For rays d of a camera at height h that is d + k (p - q), with
k = max(-d_z, 0) / h and the two places p and q (Hartley and Zisserman: Multiple View Geometry, 13.1). What stands on
the floor is drawn as if infinitely far.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from ds_base.config_errors import Keys, problems, read_keys
from ds_driver.networks.images import part_for_network
from ds_recording import RecordingError
from ds_recording.sibling.recorded_drive import LENGTH, RecordedDrive, check_is_section, read_drive, sections
from ds_road import Road
from ds_sim.camera.lens import Vector, optical_axes
from ds_sim.camera.optics import LENS_CONDITIONS, SENSOR_CONDITIONS
from ds_sim.camera.rendered_scene import RenderedScene
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH, CameraSpec, Look
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Observation, OutOfSightError, SimulatorSpec, VehicleState
from ds_twin_donkey.car_files import read_parameters
from ds_twin_donkey.parameters import SCALE, DonkeyParameters
from ds_twin_donkey.simulator import DonkeySimulator, DonkeyVehicle

Array = NDArray[Any]
"""Of single precision where time counts."""
FURTHEST = 3.0
"""Largest distance of a photograph ahead or behind, road metres; chosen: some frames of a recording at walking pace."""
SIDE, TURN = 2.25, math.radians(25.0)
"""Largest offset (road metres) and turn against the nearest photograph; chosen: a lane is left 2 m from its middle."""
WEIGHTS = (2.0, 1.0, math.radians(10.0))
"""Distance ahead, offset (road metres) and turn that count alike in *nearest*; chosen: a metre aside costs a network
about as much as ten degrees, what lies ahead least, as it is seen smaller or larger but from the same side."""
BEHIND = ((1.5, 3.0), (3.5, 5.5))
"""Distances behind, road metres, of photographs that show what the nearest one does not: sides and near floor."""
_NEAR = 1e-3
_MOST = 2**14
"""Pixels of one call of OpenCV, whose images have at most 32,767 columns."""


def camera_spec(drive: RecordedDrive) -> CameraSpec:
    """The recorded camera as a pinhole of the part that a network sees, in road metres; its lens is in the pictures."""
    camera = drive.camera
    assert camera.height_m is not None and camera.pitch_rad is not None
    grid_columns, grid_rows = network_grid(camera.width_px, camera.height_px)
    return CameraSpec(
        horizontal_fov=2.0 * math.atan((grid_columns[-1] - grid_columns[0]) / 2.0 / camera.focal_px[0]),
        height=camera.height_m,
        forward=camera.forward_m,
        # A pinhole looks along its middle: rows that are cut off above turn it down.
        pitch=camera.pitch_rad + math.atan((grid_rows.mean() - camera.centre_y_px) / camera.focal_px[1]),
    )


def network_grid(width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns and rows of a photograph at the pixels of a network's image, as `fit_to_network` crops and resizes it."""
    rows, columns = part_for_network(width, height)
    across = columns.start + (np.arange(IMAGE_WIDTH) + 0.5) * (columns.stop - columns.start) / IMAGE_WIDTH - 0.5
    down = rows.start + (np.arange(IMAGE_HEIGHT) + 0.5) * (rows.stop - rows.start) / IMAGE_HEIGHT - 0.5
    return across, down


class PhotoScene(RenderedScene):
    """Implements `ds_sim.parts.Scene` with the photographs of a located recording.

    Attributes:
        unseen: largest share of a picture of this run that no photograph shows, filled with what is next to it.
    """

    conditions: ClassVar[frozenset[str]] = LENS_CONDITIONS | SENSOR_CONDITIONS | {"camera_pitch", "camera_yaw"}
    sun = (math.pi / 2, math.asin(math.sqrt(0.5)))  # unknown; chosen: 45 degrees high, for `low_sun` alone

    def __init__(self, drive: RecordedDrive) -> None:
        super().__init__(camera_spec(drive))
        self._drive = drive
        self._photograph = lru_cache(maxsize=64)(drive.photograph)
        self.unseen = 0.0
        camera = drive.camera
        columns, rows = network_grid(camera.width_px, camera.height_px)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        rays, self._inside_lens = camera.rays(grid)
        # As the optical axis of the photographs has them, whatever part of the image a network sees.
        self._rays = np.concatenate((rays.T, np.ones((1, len(rays))))).reshape(3, IMAGE_HEIGHT, IMAGE_WIDTH)
        self._rays = self._rays.astype(np.float32)  # half the time; rounds a pixel by 1e-4
        self._mount = CameraSpec(
            horizontal_fov=1.0, height=self._spec.height, forward=self._spec.forward, pitch=camera.pitch_rad or 0.0
        )

    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        self.unseen = 0.0

    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        spec = self._run_spec
        axes, position = optical_axes(spec, state)
        yaw = math.atan2(axes[2][1], axes[2][0])
        place = (position[0] - spec.forward * math.cos(yaw), position[1] - spec.forward * math.sin(yaw))
        first, others = self._chosen(*place, yaw - spec.yaw)
        # The rays turn with the camera; its pitch is relative to the photographs'.
        right, down, forward = optical_axes(self._mount, _pose(*place, yaw, pitch=spec.pitch - self._spec.pitch))[0]
        top, bottom = rows
        x, y, z = self._rays[:, top:bottom].reshape(3, -1)
        directions = np.stack([right[k] * x + down[k] * y + forward[k] * z for k in range(3)])
        nearness = np.maximum(-directions[2], 0.0) / position[2]
        part, missing = np.empty((x.size, 3), np.uint8), np.arange(x.size)
        for index in (first, *others):
            columns, lines, shown = self._seen_from(index, directions[:, missing], nearness[missing], position)
            # What the nearest photograph does not show keeps what is on its border, unless another one shows it.
            hidden = missing if index == first else missing[shown]
            chosen = slice(None) if index == first else shown
            part[hidden] = _sampled(self._photograph(index), columns[chosen], lines[chosen])
            missing = missing[~shown]
            if not missing.size:
                break
        self.unseen = max(self.unseen, missing.size / x.size)
        image = np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8)
        image[top:bottom] = part.reshape(bottom - top, IMAGE_WIDTH, 3)
        return image

    def _chosen(self, x: float, y: float, yaw: float) -> tuple[int, list[int]]:
        """Nearest photograph, and those that fill what it does not show; OutOfSightError if none is near enough."""
        poses = self._drive.poses
        cos, sin = math.cos(yaw), math.sin(yaw)
        dx, dy = poses[:, 0] - x, poses[:, 1] - y
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        turn = (poses[:, 2] - yaw + math.pi) % math.tau - math.pi
        far = (ahead / WEIGHTS[0]) ** 2 + (left / WEIGHTS[1]) ** 2 + (turn / WEIGHTS[2]) ** 2
        usable = (np.abs(left) <= SIDE) & (np.abs(turn) <= TURN)
        near = usable & (np.abs(ahead) <= FURTHEST)
        first = int(np.argmin(np.where(near, far, np.inf) if near.any() else far))
        if not near[first]:
            raise OutOfSightError(
                f"the car is {abs(left[first]):.1f} m beside the nearest photograph, turned by "
                f"{math.degrees(abs(turn[first])):.0f} degrees, {abs(ahead[first]):.1f} m from it along the road: "
                f"this recording does not show what it would see (limits {SIDE:g} m, {math.degrees(TURN):.0f}, "
                f"{FURTHEST:g} m)"
            )
        others = []
        for low, high in BEHIND:
            wider = usable & (ahead < -low) & (ahead > -high)
            if wider.any():
                others.append(int(np.argmin(np.where(wider, far, np.inf))))
        return first, others

    def _seen_from(
        self, index: int, directions: Array, nearness: Array, position: Vector
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Columns and rows of rays, (3, n), in a photograph, and which of them it shows."""
        axes, place = optical_axes(self._mount, _pose(*self._drive.poses[index].tolist()))
        way = [directions[k] + nearness * (position[k] - place[k]) for k in range(3)]
        across, down, depth = (axis[0] * way[0] + axis[1] * way[1] + axis[2] * way[2] for axis in axes)
        front = depth > _NEAR
        depth = np.where(front, depth, 1.0)
        camera = self._drive.camera
        columns, rows, inside = camera.pixels(across / depth, down / depth)
        within = (columns >= -0.5) & (columns <= camera.width_px - 0.5)
        within &= (rows >= -0.5) & (rows <= camera.height_px - 0.5)
        return columns, rows, front & inside & within


def _pose(x: float, y: float, yaw: float, *, pitch: float = 0.0) -> VehicleState:
    return VehicleState(x=x, y=y, yaw=yaw, speed=0.0, yaw_rate=0.0, steering_angle=0.0, pitch=pitch)


def _sampled(photograph: NDArray[np.uint8], columns: Array, rows: Array) -> NDArray[np.uint8]:
    """Pixels between those of a photograph, (n, 3); beyond its border, those on it."""
    height, width = photograph.shape[:2]
    across = np.clip(columns, 0.0, width - 1.0).astype(np.float32, copy=False)
    down = np.clip(rows, 0.0, height - 1.0).astype(np.float32, copy=False)
    parts = [
        cv2.remap(photograph, across[None, k : k + _MOST], down[None, k : k + _MOST], cv2.INTER_LINEAR)[0]
        for k in range(0, len(across), _MOST)
    ]
    return np.concatenate(parts) if parts else np.empty((0, 3), np.uint8)


SETTINGS = "simulator.yaml"
"""Optional file in the folder, with the keys of `RecordingSettings`."""
LOOK = Look(asphalt=(90, 90, 90), grass=(90, 90, 90))
"""Stands for a look that is not known; nothing is painted with it."""


class RecordingSettings(Keys, strict=True):
    """What a user may add to a located recording."""

    # Parameter file of the car, written by `ds twin fit`, relative to the folder; None for the nominal car.
    car: str | None = None
    crop_top: Annotated[int, Field(ge=0, lt=160)] = 0  # image rows at the top, of 160, that a network does not see
    crop_bottom: Annotated[int, Field(ge=0, lt=160)] = 0


class FloorVehicle(DonkeyVehicle):
    """The twin without roll and pitch, which are in the photographs already."""

    def state(self) -> VehicleState:
        """State of the car's centre, in road metres; the body stays level."""
        return replace(super().state(), roll=0.0, pitch=0.0)


class RecordingSimulator(RoadSimulator):
    """The twin's dynamics on a recorded track, seen in the photographs of the recording.

    Nominal parameters of the car are taken if none are given.
    """

    needs_file = True

    def __init__(
        self,
        drive: RecordedDrive,
        parameters: DonkeyParameters | None = None,
        settings: RecordingSettings | None = None,
    ) -> None:
        settings, parameters = settings or RecordingSettings(), parameters or DonkeyParameters()
        self.drive, self._photos = drive, PhotoScene(drive)
        twin = DonkeySimulator(parameters).spec
        spec = replace(
            twin,
            name="recording",
            physics="the twin's 1:16 car, on the track of a recording",
            camera=camera_spec(drive),
            look=LOOK,
            crop_top=settings.crop_top,
            crop_bottom=settings.crop_bottom,
            engine=f"{twin.engine}; photographs moved by the floor",
            extra={
                "scale": f"1:{SCALE:g}",
                "car": settings.car or "nominal",
                "photographs": f"{len(drive.poses)}",
                "recording": f"sha256 {drive.sha256}",
            },
        )
        super().__init__(spec, FloorVehicle(parameters), scene=self._photos)

    @classmethod
    def from_file(cls, path: Path) -> RecordingSimulator:
        """Make the simulator of the folder that `ds recording locate` wrote; an InputError if it cannot be used."""
        settings = RecordingSettings()
        if (path / SETTINGS).exists():
            try:
                settings = RecordingSettings.model_validate(read_keys(path / SETTINGS, RecordingError))
            except ValidationError as error:
                raise RecordingError(f"{path / SETTINGS}: {problems(error, RecordingSettings)}") from None
        parameters = read_parameters(path / settings.car)[0] if settings.car else None
        return cls(read_drive(path), parameters, settings)

    @property
    def spec(self) -> SimulatorSpec:
        """Description of this simulator, with the largest share of a picture of the last run that nothing shows."""
        spec = super().spec
        return replace(spec, extra=spec.extra | {"unseen": f"at most {100 * self._photos.unseen:.1f}% of a picture"})

    @property
    def own_road(self) -> Road:
        """The first road of `ds recording roads`; see `Simulator.own_road`."""
        return sections(self.drive, LENGTH)[0]

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        """Load a section of the recorded track; see `Simulator.load`."""
        check_is_section(road, self.drive)
        return super().load(road, seed=seed, conditions=conditions)
