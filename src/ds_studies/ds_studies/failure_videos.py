# SPDX-License-Identifier: Apache-2.0
"""Videos of failed drives, for somebody who was not there, such as the job of a continuous integration."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from ds_base.errors import DsError
from ds_base.folder_files import make_folder
from ds_base.progress import logger_of
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.network_driver import translation_of
from ds_sim.registry import SimulatorName, label_of, make_simulator
from ds_sim.scenario import OfScenario, Scenario
from ds_sim.session import resimulate
from ds_sim.video import write_video

LOG = logger_of(__name__)

MOST_VIDEOS, LONGEST = 10, 120.0
"""Videos that are written, and seconds after which no further one is begun; chosen: a verdict waits for them."""


@dataclass(frozen=True)
class FailedDrive(OfScenario):
    """Drive on which a driver failed."""

    test: str
    simulator: SimulatorName
    scenario: Scenario


def write_failure_videos(driver: DriverName, failed: Sequence[FailedDrive], folder: Path) -> list[Path]:
    """Drive the first `MOST_VIDEOS` failed tests again, write `TEST_SIMULATOR.mp4` of each, and return the paths."""
    make_folder(folder)
    videos: list[Path] = []
    began = time.monotonic()
    for one in failed[:MOST_VIDEOS]:
        if time.monotonic() - began > LONGEST:
            break
        video = folder / f"{one.test}_{label_of(one.simulator)}.mp4"
        LOG.info("rendering %s", video)
        try:
            _write_video(driver, one, video)
        except (DsError, OSError) as error:
            LOG.warning("%s cannot be drawn: %s", video, error)
        else:
            videos.append(video)
    if len(videos) < len(failed):
        LOG.info("%d further failed drives have no video", len(failed) - len(videos))
    return videos


def _write_video(driver: DriverName, drive: FailedDrive, video: Path) -> None:
    with closing(make_simulator(drive.simulator)) as simulator:
        run = drive_road(simulator, make_driver(driver, simulator.spec), drive.road, drive.seed, drive.conditions)
    write_video(
        video,
        f"{drive.simulator}, {Path(str(driver)).name}",
        drive.road,
        resimulate(drive.simulator, run),
        run.commands,
        run.conditions,
        translation_of(driver, drive.simulator),
    )
