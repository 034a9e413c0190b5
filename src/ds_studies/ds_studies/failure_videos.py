# SPDX-License-Identifier: Apache-2.0
"""Videos of failed drives, for somebody who was not there, such as the job of a continuous integration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ds_base.folder_files import make_folder
from ds_base.progress import logger_of
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.network_driver import translation_of
from ds_sim.registry import label_of, make_simulator
from ds_sim.resimulation import resimulate
from ds_sim.scenario import OfScenario, Scenario
from ds_sim.video import write_video

LOG = logger_of(__name__)

MOST_VIDEOS = 10
"""Videos that are written; chosen: half a minute of computing, 30 MB."""


@dataclass(frozen=True)
class FailedDrive(OfScenario):
    """Drive on which a driver failed.

    Attributes:
        test: name of the test.
        simulator: name of the simulator.
        scenario: that was driven.
    """

    test: str
    simulator: str
    scenario: Scenario


def write_failure_videos(driver: str, failed: Sequence[FailedDrive], folder: Path) -> list[Path]:
    """Drive failed tests once more, which gives the same drives, and write a video of each.

    Args:
        driver: name of the driver.
        failed: the drives; the first `MOST_VIDEOS` are shown.
        folder: receives `TEST_SIMULATOR.mp4`, created if missing.

    Returns:
        Paths of the videos.
    """
    make_folder(folder)
    videos = []
    for one in failed[:MOST_VIDEOS]:
        simulator = make_simulator(one.simulator)
        try:
            run = drive_road(simulator, make_driver(driver, simulator.spec), one.road, one.seed, one.conditions)
        finally:
            simulator.close()
        video = folder / f"{one.test}_{label_of(one.simulator)}.mp4"
        LOG.info("rendering %s", video)
        write_video(
            video,
            f"{one.simulator}, {Path(driver).name}",
            one.road,
            resimulate(one.simulator, run),
            run.commands,
            run.conditions,
            translation_of(driver, one.simulator),
        )
        videos.append(video)
    if len(failed) > MOST_VIDEOS:
        LOG.info("%d further failed drives have no video", len(failed) - MOST_VIDEOS)
    return videos
