# SPDX-License-Identifier: Apache-2.0
"""Kinds of received files: located recordings and descriptions of ROS 2 simulators, as the siblings read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.fuzz.damage import damaged_file, damaged_one_of
from tests.fuzz.harness import Kind
from tests.fuzz.kinds_bags import tub

from ds_recording.errors import RecordingError
from ds_recording.floor_camera import FloorCamera, read_camera, write_camera
from ds_recording.located import COLUMNS, Located, write_located
from ds_recording.sibling.recorded_drive import sections
from ds_recording.sibling.simulator import RecordingSimulator
from ds_recording.track import Track
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command
from ds_sim_ros.settings import RosSettingsError
from ds_sim_ros.simulator import RosSimulator
from ds_twin_donkey.logs import LogError, read_log

_CAMERA = FloorCamera(
    width_px=80, height_px=40, focal_px=(37.5, 37.5), centre_x_px=39.5, centre_y_px=19.5, height_m=0.12, pitch_rad=0.2
)


def _write_located(folder: Path, n: int) -> Path:
    made = folder / "located"
    made.mkdir()
    source = tub(made, n)
    along = 0.35 * np.arange(n - 1.0)
    table = np.zeros((n - 1, len(COLUMNS)))
    frames = np.arange(n - 1.0)
    for name, values in {"frame": frames, "time_s": 0.05 * frames, "x_m": along, "along_m": along}.items():
        table[:, COLUMNS.index(name)] = values
    track = Track(np.column_stack((np.linspace(-1.0, 0.35 * n + 3.0, 4 * n + 1), np.zeros(4 * n + 1))))
    about = {"source": source.name, "lane_width_m": 0.25, "closed": False}
    write_located(made, Located(table=table, track=track, lane_width=0.25, camera=_CAMERA, about=about))
    (made / "simulator.yaml").write_text("crop_top: 40\n")
    return made


def _drive(folder: Path) -> None:
    """Make the sibling, and drive some frames of a section."""
    simulator = RecordingSimulator.from_file(folder)
    drive = simulator.drive
    session = Session(simulator)
    session.start(Scenario(sections(drive, 20.0)[0], seed=1))
    for _ in range(3):
        if session.driving:
            session.advance(Command(0.1, 0.5))


def _write_camera(folder: Path, n: int) -> Path:
    write_camera(folder / "camera.yaml", _CAMERA)
    return folder / "camera.yaml"


def _write_description(folder: Path, n: int) -> Path:
    made = folder / "described"
    made.mkdir()
    text = (Path(__file__).parents[2] / "examples/ros_simulator.yaml").read_text()
    (made / "track.csv").write_text("".join(f"{30 * k / n},{3 * (k / n) ** 2}\n" for k in range(n)))
    (made / "sim.yaml").write_text(text.replace("{service: /load_road}", "{centre_line: track.csv}"))
    return made


KINDS = [
    Kind(
        "ros-description",
        _write_description,
        damaged_one_of,
        lambda folder: RosSimulator.from_file(folder / "sim.yaml"),
        (RosSettingsError,),
        1000,
        small=4,
    ),
    Kind("located", _write_located, damaged_one_of, _drive, (RecordingError,), 60, small=6),
    Kind("located-log", _write_located, damaged_one_of, read_log, (LogError,), 200, small=6),
    Kind("floor-camera", _write_camera, damaged_file, read_camera, (RecordingError,)),
]
