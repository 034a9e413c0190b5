# SPDX-License-Identifier: Apache-2.0
"""From a recording to one page: locates it, fits the twin, cuts and drives roads; a stopped call goes on."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ds_analysis.siblings.track_answer import TrackAnswer
from ds_base.bounded_file import FileError, open_regular, read_json, read_words
from ds_base.errors import InputError
from ds_base.folder_files import make_folder, write_json, write_whole
from ds_base.progress import SILENT, Progress, logger_of
from ds_base.words import count
from ds_driver.data.recordings import Reading
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_driver.networks.weights import shipped_networks
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks, DriveResults, Unfinished, drive_tests
from ds_orchestrator.store.model import Test
from ds_recording.floor_camera import read_camera
from ds_recording.locate import located_of
from ds_recording.located import ABOUT, LOCATED, Located, read_located, write_located
from ds_recording.odometry import summary
from ds_recording.recording import read_views
from ds_recording.sibling.recorded_drive import RecordedDrive, left_its_lane, near_photographs, read_drive, sections
from ds_recording.sibling.simulator import SETTINGS
from ds_recording.track import Track
from ds_report.recording_pages import write_recording_page, write_track_page
from ds_road import Road, write_roads
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario
from ds_twin_donkey.car_files import document_of, write_parameters
from ds_twin_donkey.fit import fit_located
from ds_twin_donkey.logs import LogError, read_log
from ds_twin_donkey.parameters import SCALE
from ds_twin_donkey.windows import FitError

LOG = logger_of(__name__)
INPUTS, TWIN, ROADS, ANSWER, PAGE = "inputs.json", "twin.json", "roads.json", "answer.json", "index.html"
CAR = "car.yaml"
NEEDED = ("max_steering_angle", "full_duty")
"""Parameters without which a fitted twin is not used: how far it turns, and how fast it is."""
LENGTH, SHARE = 80.0, 0.6
"""Length of a road, road metres, and its largest share of the track; chosen: a lap has to leave its loop open."""
SHIPPED_CROP = 40
"""Image rows at the top that the networks shipped here do not see of the twin's camera."""
LARGEST = 2**31
"""Largest file of a recording, bytes."""


class TrackTestError(InputError):
    """The folder holds the test of something else."""


@dataclass(frozen=True, kw_only=True)
class LocationInputs:
    """What is located: lanes of a width in m on the floor, `odometry` as in `ds_recording.odometry.read_sources`."""

    source: Path
    camera: Path
    lane_width: float
    reading: Reading
    odometry: str | None = None
    centre: str = "yellow"


@dataclass(frozen=True, kw_only=True)
class TrackTest:
    """What is tested; `crop` and `crop_top` are image rows at the top that the driver does not see."""

    recording: LocationInputs
    out: Path
    driver: DriverName
    roads: int = 20
    crop_top: int | None = None

    @property
    def located(self) -> Path:
        """Folder of the located recording."""
        return self.out / "located"

    @property
    def crop(self) -> int:
        """`crop_top`, or if None that of the shipped networks, or 0."""
        if self.crop_top is not None:
            return self.crop_top
        return SHIPPED_CROP if self.driver.network in shipped_networks() else 0


def locate_recording(of: LocationInputs, folder: Path, progress: Progress = SILENT) -> tuple[Located, Path]:
    """Locate a recording, or raise `RecordingError`, and write a folder; returns its page, too, which comes last."""
    camera = read_camera(of.camera)
    views = read_views(of.source, of.reading, of.odometry, of.centre)
    located, fit = located_of(views, camera, of.lane_width, progress)
    about = {"source": os.path.relpath(of.source, folder), "topic": of.reading.camera}
    located = replace(located, about=located.about | about)
    write_located(folder, located)
    return located, write_recording_page(folder / PAGE, views, located, fit)


def run_track_test(
    test: TrackTest,
    settings: DriveSettings,
    callbacks: Callbacks | None = None,
    progress: Callable[[], Progress] = lambda: SILENT,
) -> TrackAnswer:
    """Do what is left to do, and write `answer.json` and the page; a `DsError` says which step cannot be done.

    `TrackTestError` if the folder holds the test of another recording, camera or lane.
    """
    make_folder(test.out)
    _check_inputs(test)
    folder = test.located
    if not (folder / PAGE).exists():
        LOG.info("step 1 of 4: where the car was")
        locate_recording(test.recording, folder, progress())
    if not (folder / TWIN).exists():
        LOG.info("step 2 of 4: the twin of the car")
        _fit_twin(folder, progress())
    twin = read_json(folder / TWIN, LARGEST)
    chosen = {"crop_top": test.crop} | ({"car": CAR} if twin["fitted"] else {})
    write_whole(folder / SETTINGS, yaml.safe_dump(chosen))
    LOG.info("step 3 of 4: roads of the track")
    drive = read_drive(folder)
    every = sections(drive, max(20.0, min(LENGTH, np.floor(SHARE * drive.lane.length))))
    spread = np.linspace(0, len(every), min(test.roads, len(every)), endpoint=False).astype(int)
    roads = [every[index] for index in spread]
    write_roads(roads, test.out / ROADS)
    LOG.info("step 4 of 4: %d roads are driven", len(roads))
    twin_name = f"donkey@{folder / CAR}" if twin["fitted"] else "donkey"
    names = SimulatorName(f"recording@{folder}"), SimulatorName(twin_name)
    answer = _driven(test, settings, names, roads, drive, callbacks)
    answer = replace(answer, limits=_limits(read_located(folder), twin["cautions"], drive, roads, test.roads))
    write_json(test.out / ANSWER, answer.document() | {"crop_top": test.crop})
    write_track_page(test.out / PAGE, answer, drive, _facts(read_located(folder), twin, drive, test.crop))
    return answer


def _check_inputs(test: TrackTest) -> None:
    """Begin the folder, or refuse one of other inputs."""
    of = test.recording
    inputs: dict[str, Any] = {
        "recording": _sha256(of.source, test.out),
        "camera": _sha256(of.camera),
        "lane width": of.lane_width,
        "options": {**asdict(of.reading), "trusted": [], "odometry": of.odometry, "centre": of.centre},
    }
    path = test.out / INPUTS
    if not path.exists():
        write_json(path, inputs)
        return
    try:
        inputs_before = read_json(path, LARGEST)
        differ = [name for name, value in inputs.items() if inputs_before[name] != value]
    except (ValueError, KeyError, TypeError, FileError):
        differ = [INPUTS]
    if differ:
        raise TrackTestError(f"{test.out} was begun with another {', '.join(differ)}: choose another --out")


def _sha256(path: Path, without: Path | None = None) -> str:
    """Digest of a file, or of all files of a folder with their names, without those of a folder in it."""
    digest = hashlib.sha256()
    try:
        files = sorted(one for one in path.rglob("*") if one.is_file()) if path.is_dir() else [path]
        if without is not None:
            files = [one for one in files if not one.resolve().is_relative_to(without.resolve())]
        for file in files:
            digest.update(f"{file.relative_to(path)}\0{file.stat().st_size}\0".encode(errors="surrogateescape"))
            with open_regular(file) as stream:
                while block := stream.read(2**20):
                    digest.update(block)
    except OSError as error:
        raise TrackTestError(f"{path}: {error.strerror}: give a bag or tub, and the file of its camera") from None
    return digest.hexdigest()


def _fit_twin(folder: Path, progress: Progress) -> None:
    """Fit the twin, or say why the nominal one is used."""
    fitted, cautions = False, []
    try:
        log = read_log(folder)
        fitted_twin, mounting = fit_located(log.drives, progress=progress)
    except (FitError, LogError) as error:
        cautions.append(f"The twin is not fitted, it is the nominal car: {error}.")
    else:
        unknown = [one.name for one in fitted_twin.estimates if not one.determined]
        fitted = not set(unknown) & set(NEEDED)
        if unknown:
            which = "keeps these of the nominal one" if fitted else "is not fitted, it is the nominal car"
            cautions.append(f"The recording does not determine {', '.join(unknown)}: the twin {which}.")
        if fitted:
            write_parameters(folder / CAR, document_of(fitted_twin, [log]))
        if abs(mounting.forward) > 0.02:
            cautions.append(
                f"The poses are {mounting.forward:.3f} m ahead of the car's centre: with a camera there, add that to "
                "forward_m in the camera's file, and test again in another folder."
            )
    write_json(folder / TWIN, {"fitted": fitted, "cautions": cautions})


def _driven(
    test: TrackTest,
    settings: DriveSettings,
    names: tuple[SimulatorName, SimulatorName],
    roads: list[Road],
    drive: RecordedDrive,
    callbacks: Callbacks | None,
) -> TrackAnswer:
    """Drive the driver and the autopilot on both simulators."""
    tests = [Test(f"{road.road_id}-{seed}", Scenario(road, seed=seed)) for seed, road in enumerate(roads)]
    drives, undecided = {}, {}
    for driver in dict.fromkeys((test.driver, AUTOPILOT)):
        # A folder of drives belongs to its driver, car and roads.
        what = [str(driver), *names, drive.sha256, read_words(test.located / SETTINGS), *(one.test_id for one in tests)]
        place = test.out / "drives" / hashlib.sha256("\n".join(what).encode()).hexdigest()[:12]
        chosen = replace(settings, driver=driver, siblings=names, twin=None)
        LOG.info("%s drives", driver)
        results = drive_tests(chosen, dict.fromkeys(names, tests), place, callbacks)
        for name in names:
            keys = [(one.test_id, name) for one in tests]
            drives[driver, name] = [results.executions.get(key) for key in keys]
            undecided[driver, name] = [_why(results, key) for key in keys if key not in results.executions]
    return TrackAnswer(
        driver=test.driver,
        recording=names[0],
        twin=names[1],
        roads=roads,
        drives=drives,
        undecided=undecided,
        recorded=[left_its_lane(drive, road) for road in roads],
    )


def _why(results: DriveResults, key: tuple[str, SimulatorName]) -> str:
    """Why a test has no verdict on a simulator."""
    gate = results.gates.get(key)
    text = str(results.errors.get(key, Unfinished())) if gate is None else gate.message
    return text.removeprefix("OutOfSightError: ")


def _limits(
    located: Located, cautions: list[str], drive: RecordedDrive, roads: list[Road], wanted: int
) -> tuple[str, ...]:
    """What could not be done before any drive, one sentence each."""
    said = []
    about = located.about
    if about["located"] < 0.995:
        said.append(f"{1.0 - about['located']:.1%} of the recording's {about['frames']} images are not located.")
    shown = float(near_photographs(drive.lane.points, drive.poses).mean())
    if shown < 0.995:
        said.append(f"{1.0 - shown:.0%} of the track has no photograph near it, and so no road.")
    length = Track(roads[0].lane_centre).length
    apart = max(int(drive.lane.length // length), 1)
    if len(roads) < wanted:
        said.append(f"Too little track: {len(roads)} roads, {wanted} were wanted.")
    if apart < len(roads):
        said.append(
            f"Too little track for {len(roads)} independent roads: in {drive.lane.length:.0f} road metres only {apart} "
            f"of {length:.0f} do not overlap, so the counts below are worth about {count(apart, 'test')}."
        )
    return (*said, *cautions)


def _facts(located: Located, twin: Mapping[str, Any], drive: RecordedDrive, crop: int) -> dict[str, str]:
    """Rows of the page's table."""
    loop = "a closed track" if located.about["closed"] else "open"
    return {
        "Recording": f"{located.about['source']}, {located.about['frames']} images, {located.about['located']:.1%} "
        f"located (located/{PAGE}, {ABOUT}, {LOCATED})",
        "Track": f"{loop}, {drive.lane.length:.0f} road metres, {drive.lane.length / SCALE:.1f} m on the floor",
        "Motion": summary(located.about) or "from images alone",
        "Twin": f"fitted (located/{CAR})" if twin["fitted"] else "nominal",
        "Images": f"the network does not see the first {crop} of 160 rows" if crop else "all rows",
    }
