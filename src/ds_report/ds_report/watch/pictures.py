"""Renders finished drives for the page, one at a time, on simulators that are created once."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict
from typing import Any

from ds_orchestrator.store.model import Execution, Test
from ds_report.camera_pictures import render_drive
from ds_report.picture_plan import SPACINGS, replay_frames
from ds_sim.registry import make_simulator, received_simulator
from ds_sim.simulator import Simulator


class DrivePictures:
    """Renders camera pictures of drives from their recorded paths; use it from one thread only.

    Args:
        driver: name of the driver, whose translated images stand below the camera's.
        trusted: user-defined simulators whose code may run.
    """

    def __init__(self, driver: str, trusted: Collection[str] = ()) -> None:
        self._driver, self._trusted = driver, trusted
        self._simulators: dict[str, Simulator] = {}
        self._refused: dict[str, str] = {}

    def render(self, test: Test, execution: Execution) -> dict[str, Any]:
        """Render a picture every half second, as `ds_report.camera_pictures.Drive` in JSON values."""
        name = execution.simulator
        if name not in self._simulators and name not in self._refused:
            try:
                checked = received_simulator(name, confirmed=self._trusted, option="--trust")
                self._simulators[name] = make_simulator(checked)
            except Exception as error:  # a missing or broken simulator must not prevent the page
                self._refused[name] = " ".join(str(error).split())
        if name in self._refused or not len(execution.trajectory):
            return {
                "frames": [],
                "times": [],
                "strip": [],
                "note": f"no pictures: {self._refused.get(name, 'no frame')}",
            }
        frames = replay_frames(execution, SPACINGS[0])
        return asdict(render_drive(self._simulators[name], name, test, execution, frames, self._driver))

    def close(self) -> None:
        """Close the simulators."""
        for simulator in self._simulators.values():
            simulator.close()
        self._simulators.clear()
