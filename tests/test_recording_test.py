# SPDX-License-Identifier: Apache-2.0
"""`ds recording test` from a tub to its sentence, on a short recording of the twin, stopped at each step."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest
from benchmarks.recording.drives import Plan, line_distance, record
from progress_lines import ProgressLines
from tests.command_line import ds

from ds_base.progress import SILENT
from ds_driver.data.recordings import Reading
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.executor import Listener, Stopped
from ds_orchestrator.engines.drive_tests import Callbacks
from ds_orchestrator.store.model import Execution, Test
from ds_recording import RecordingError
from ds_recording.floor_camera import read_camera, write_camera
from ds_recording.sibling.recorded_drive import read_drive, sections
from ds_sim.gates.gate import Gate
from ds_sim.registry import spec_of
from ds_studies.track_test import LocationInputs, TrackTest, TrackTestError, _fit_twin, run_track_test
from ds_twin_donkey.parameters import SCALE

LANE = line_distance(spec_of("donkey")) / SCALE
SETTINGS = DriveSettings(siblings=(), driver=AUTOPILOT)


class Stops(ProgressLines):
    """Stops at the first line that begins so."""

    def __init__(self, begin: str) -> None:
        super().__init__()
        self._begin = begin

    def describe(self, line: str) -> None:
        super().describe(line)
        if line.startswith(self._begin):
            raise KeyboardInterrupt


class StopsAfterOne(Listener):
    def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
        raise KeyboardInterrupt


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("recording")
    record(Plan(simulator="donkey", seed=5, course="loop", frames=260), made)
    write_camera(made / "camera.yaml", read_camera(made / "camera.yaml").scaled(1.0 / SCALE))
    return made


def asked(folder: Path, lane: float = LANE) -> TrackTest:
    reading = Reading(whole=True)
    recording = LocationInputs(source=folder / "tub", camera=folder / "camera.yaml", lane_width=lane, reading=reading)
    return TrackTest(recording=recording, out=folder / "out", driver=AUTOPILOT, roads=2)


def stopped(folder: Path, progress: Callable[[], ProgressLines], listener: type[Listener] = Listener) -> None:
    def listen() -> AbstractContextManager[Listener]:
        return nullcontext(listener())

    with pytest.raises((KeyboardInterrupt, Stopped)):
        run_track_test(asked(folder), SETTINGS, Callbacks(listen=listen), progress)


def test_a_test_that_is_stopped_at_each_step_goes_on_and_ends_in_one_sentence(folder: Path) -> None:
    out = folder / "out"
    stopped(folder, lambda: Stops("steps of the solution"))
    assert not (out / "located" / "index.html").exists()
    stopped(folder, lambda: Stops("phase 2"))  # of the fit, once it is located
    since = (out / "located" / "index.html").stat().st_mtime_ns
    stopped(folder, lambda: Stops("nothing"), StopsAfterOne)
    assert json.loads((out / "located" / "twin.json").read_text()) == {"fitted": True, "cautions": []}
    arguments = [
        "recording", "test", folder / "tub", "--driver", "autopilot", "--camera", folder / "camera.yaml",
        "--lane-width", LANE, "--out", out, "--roads", 2, "--workers", 1, "--fail-on", "failure",
    ]  # fmt: skip
    first = ds(*arguments)
    assert first.returncode == 0, first.stderr
    assert "step 4 of 4" in first.stderr and "step 1" not in first.stderr and "step 2" not in first.stderr
    *cautions, sentence, page = first.stdout.splitlines()
    assert sentence == (
        "autopilot leaves its lane on 0 of the 2 roads of the recorded track (the recorded drive left it on 0 of 2; "
        "on the twin autopilot fails on 0 of 2)."
    )
    assert any(one.startswith("- Too little track for 2 independent roads") for one in cautions), cautions
    text = Path(page).read_text()
    assert sentence in text and text.index("What this cannot say") < text.index("The answer")
    files = [out / "answer.json", out / "index.html", out / "roads.json"]
    before = [file.read_bytes() for file in files]
    again = ds(*arguments)
    assert again.stdout == first.stdout and "on donkey" not in again.stderr  # nothing was driven
    assert [file.read_bytes() for file in files] == before
    assert (out / "located" / "index.html").stat().st_mtime_ns == since


def test_a_folder_of_another_lane_is_refused(folder: Path) -> None:
    run = asked(folder, lane=0.3)
    run.out.mkdir(exist_ok=True)
    if not (run.out / "inputs.json").exists():  # this test alone
        stopped(folder, lambda: Stops("images looked at"))
    with pytest.raises(TrackTestError, match="out was begun with another lane width: choose another --out"):
        run_track_test(run, SETTINGS)


def located(folder: Path) -> Path:
    """The located recording, which the first test has left."""
    if not (folder / "out" / "located" / "index.html").exists():
        stopped(folder, lambda: Stops("phase 2"))
    return folder / "out" / "located"


def test_a_short_track_gives_enough_roads(folder: Path) -> None:
    drive = read_drive(located(folder))
    assert drive.lane.length < 100.0
    assert len(sections(drive, 40.0, 20.0)) < 4 and len(sections(drive, 40.0)) >= 20
    with pytest.raises(RecordingError, match="shorten --length"):
        sections(drive, 200.0)


def test_without_throttle_the_twin_stays_nominal_and_says_so(folder: Path, tmp_path: Path) -> None:
    header, *rows = (located(folder) / "located.csv").read_text().splitlines()
    bare = [row[: row.rindex(",") + 1] for row in rows]
    (tmp_path / "located.csv").write_text("\n".join([header, *bare]) + "\n")
    _fit_twin(tmp_path, SILENT)
    twin = json.loads((tmp_path / "twin.json").read_text())
    assert not twin["fitted"] and not (tmp_path / "car.yaml").exists()
    assert twin["cautions"][0].startswith("The twin is not fitted, it is the nominal car: ")
    assert "no record has throttle" in twin["cautions"][0]
