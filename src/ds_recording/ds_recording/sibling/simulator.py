# SPDX-License-Identifier: Apache-2.0
"""The recorded track as a simulator: `recording@FOLDER`, with the folder that `ds recording locate` wrote."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from ds_base.config_errors import Keys, problems, read_keys
from ds_recording.errors import RecordingError
from ds_recording.sibling.photo_scene import PhotoScene, camera_spec
from ds_recording.sibling.recorded_drive import RecordedDrive, read_drive
from ds_recording.sibling.sections import LENGTH, check_is_section, sections
from ds_road import Road
from ds_sim.camera.look import Look
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Observation, SimulatorSpec, VehicleState
from ds_twin_donkey.parameter_file import read_parameters
from ds_twin_donkey.parameters import SCALE, DonkeyParameters
from ds_twin_donkey.simulator import DonkeySimulator
from ds_twin_donkey.vehicle import DonkeyVehicle

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
        """Make the simulator of the folder that `ds recording locate` wrote.

        Raises:
            RecordingError: the folder cannot be used.
            ds_twin_donkey.parameter_file.ParameterFileError: nor can its car.
        """
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
