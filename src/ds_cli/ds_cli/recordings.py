# SPDX-License-Identifier: Apache-2.0
"""`ds recording`, `ds twin`: where a car was in a recording, its camera, its track, and the twin of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, stopped, verb
from ds_sim.conditions.text import format_3sf

recording_app = typer.Typer()


Source = Annotated[Path, typer.Argument(help="Bag or Donkey Car tub with images of a track.")]
LaneWidth = Annotated[
    float, typer.Option(min=0.02, max=50.0, help="From the middle of the centre line to that of an edge line, m.")
]
CameraFile = Annotated[Path, typer.Option(help="YAML file of the camera, as of `ds recording calibrate`.")]
Odometry = Annotated[
    str | None, typer.Option(help="Field or topic of speeds, yaw rates or poses; `none`; all if omitted.")
]
Centre = Annotated[str, typer.Option(help="Colour of the centre line: yellow, green or blue.")]
EVERY = 3.0
"""Seconds between two lines of progress."""


@verb(recording_app, "test")
def recording_test_command(
    source: Source,
    lane_width: LaneWidth,
    camera: CameraFile,
    out: Annotated[Path, typer.Option(help="Folder for the result; a stopped test is resumed.")],
    driver: options.DriverText = "dave2",
    backend: options.Backend = "auto",
    roads: Annotated[int, typer.Option(min=1, max=200, help="Roads to cut at most.")] = 20,
    crop_top: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=159,
            help="Of 160 image rows, those at the top that the network does not see; 40 for shipped ones, or 0.",
        ),
    ] = None,
    topic: options.ImageTopic = None,
    steering: options.RecordedSteering = None,
    factor: options.SteeringFactor = 1.0,
    odometry: Odometry = None,
    centre: Centre = "yellow",
    workers: options.Workers = None,
    fail_on: options.FailOnFailure = None,
) -> Result:
    """Test a network on the track of a recording: does it leave its lane there?

    Locates the recording, fits the twin and cuts roads out of the track. The network then drives these roads, in the
    photographs of the recording and on the twin. The result is one page and one sentence, after what could not be done.
    The same command resumes a stopped test.

    Example: ds recording test my_tub --driver my_net.yaml --camera camera.yaml --lane-width 0.25 --out answer
    """
    from ds_cli.progress import ScreenListener
    from ds_driver.data.recordings import Reading
    from ds_orchestrator.campaign.engine import DriveSettings
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_orchestrator.engines.start import check_driver
    from ds_studies.track_test import PAGE, ROADS, LocationInputs, TrackTest, run_track_test

    network = options.driver_named(driver, backend)
    check_driver(network, [])
    settings = DriveSettings(siblings=(), driver=network, **options.Driving(workers).without_ros())
    reading = Reading(camera=topic, steering=steering, factor=factor, whole=True)
    recording = LocationInputs(
        source=source, camera=camera, lane_width=lane_width, reading=reading, odometry=odometry, centre=centre
    )
    asked = TrackTest(recording=recording, out=out, driver=network, roads=roads, crop_top=crop_top)
    with stopped(lambda: f"what is finished is in {out}: the same command goes on"):
        answer = run_track_test(asked, settings, Callbacks(listen=ScreenListener), lambda: ScreenProgress(every=EVERY))

    def show() -> None:
        for caution in answer.cautions:
            print(f"- {caution}")
        print(answer.sentence)
        print(out / PAGE)

    failures, judged = answer.failures(network, answer.recording)
    unmet = [f"{network} fails on {failures} of {judged} roads"] if fail_on and failures else []
    more = f"recording@{asked.located},bullet,softbody"
    then = ds_command("siblings", "compare", "--file", out / ROADS, "--driver", network, "--sims", more)
    return Result(document=answer.document() | {"page": str(out / PAGE)}, show=show, unmet=unmet, next=then)


@verb(recording_app, "locate")
def locate_command(
    source: Source,
    lane_width: LaneWidth,
    out: Annotated[Path, typer.Option(help="Folder for the result.")],
    camera: CameraFile,
    topic: options.ImageTopic = None,
    steering: options.RecordedSteering = None,
    factor: options.SteeringFactor = 1.0,
    odometry: Odometry = None,
    centre: Centre = "yellow",
) -> Result:
    """Find where the car was in every image of a recording, and the track it drove on.

    The track needs a coloured centre line between two white edge lines. A recording without them is refused.

    Example: ds recording locate my_tub --lane-width 0.25 --camera camera.yaml --out located
    """
    from ds_driver.data.recordings import Reading
    from ds_recording.odometry import summary
    from ds_studies.track_test import LocationInputs, locate_recording

    reading = Reading(camera=topic, steering=steering, factor=factor, whole=True)
    recording = LocationInputs(
        source=source, camera=camera, lane_width=lane_width, reading=reading, odometry=odometry, centre=centre
    )
    located, page = locate_recording(recording, out, ScreenProgress(every=EVERY))
    document = located.about | {"out": str(out), "page": str(page)}

    def show() -> None:
        about = located.about
        loop = (
            f"a closed track of {located.track.length:.1f} m"
            if about["closed"]
            else f"{located.track.length:.1f} m of road"
        )
        print(f"{about['located']:.1%} of {about['frames']} images located, on {loop}, camera {about['calibration']}")
        if about["odometry"]:
            print(f"Motion beside the images: {summary(about)}")
        print(page)

    return Result(document=document, show=show, next=ds_command("recording", "roads", out))


@verb(recording_app, "calibrate")
def calibrate_command(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Photographs of a chessboard, or folders.")],
    squares: Annotated[str, typer.Option(help="Squares of the board along and across.")] = "8x6",
    size: Annotated[float, typer.Option(min=0.001, max=1.0, help="Side of a square, m.")] = 0.025,
    out: Annotated[Path, typer.Option(help="YAML file to write.")] = Path("camera.yaml"),
) -> Result:
    """Calibrate a camera with photographs of a chessboard, taken at the size of its recordings.

    Height and pitch above the floor stay unknown; `ds recording locate` estimates them from the lines.

    Example: ds recording calibrate photographs/ --squares 8x6 --size 0.025 --out camera.yaml
    """
    from ds_recording.chessboard import calibrate, images_of, parse_board
    from ds_recording.floor_camera import write_camera

    calibration = calibrate(images_of(images), parse_board(squares), size)
    camera = calibration.camera
    write_camera(out, camera)
    document = {
        "file": str(out),
        "focal_px": camera.focal_px,
        "focal_std": camera.focal_std,
        "distortion_model": camera.lens.model,
        "rms_px": calibration.rms_px,
        "held_out_px": calibration.held_out_px,
        "bias_px": calibration.bias_px,
        "boards": calibration.boards,
    }

    def show() -> None:
        across, down = camera.focal_px
        print(f"focal lengths {across:.1f} across and {down:.1f} down, +- {camera.focal_std:.1f} px")
        lens, error = camera.lens.model, calibration.held_out_px
        print(f"{lens}, {calibration.boards} boards; corners of held-out ones are {error:.2f} px off")
        print(f"{out}: --camera of `ds recording`")

    return Result(document=document, show=show, next=ds_command("recording", "locate", "--help"))


@verb(recording_app, "roads")
def recording_roads_command(
    folder: Annotated[Path, typer.Argument(help="Folder that `ds recording locate` wrote.")],
    out: Annotated[Path, typer.Option(help="Road file to write.")] = Path("roads.json"),
    length: Annotated[float, typer.Option(min=20.0, max=900.0, help="Length of each road, road metres.")] = 80.0,
    every: Annotated[
        float | None,
        typer.Option(min=1.0, help="Distance between two starts, road metres; 20 if left out, less on short tracks."),
    ] = None,
) -> Result:
    """Cut the recorded track into roads to test.

    A metre of the roads is 1/16 m on the floor. `ds siblings compare --file ROADS --sims recording@FOLDER,...` drives
    them.

    Example: ds recording roads located --length 60 --out roads.json
    """
    from ds_recording.sibling.recorded_drive import read_drive, sections
    from ds_road import write_roads

    drive = read_drive(folder)
    roads = sections(drive, length, every)
    write_roads(roads, out)
    document = {
        "file": str(out),
        "roads": len(roads),
        "lane_m": round(drive.lane.length, 1),
        "closed": drive.lane.closed,
    }

    def show() -> None:
        lane = f"{'a loop' if drive.lane.closed else 'open'}, {drive.lane.length:.0f} m long"
        print(f"{len(roads)} roads of {length:g} road metres; the recorded lane is {lane}.")
        print(out)

    sims = f"recording@{folder},bullet,softbody"
    following = ds_command("siblings", "compare", "--file", out, "--sims", sims)
    return Result(document=document, show=show, next=following)


MISFIT = 2.0
"""Residuals over noise above which the fit warns; chosen: the noise itself is known to some tens of a percent."""
twin_app = typer.Typer()


@verb(twin_app, "fit")
def twin_fit_command(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Bags, Donkey Car tubs and located recordings of drives.")
    ],
    out: Annotated[Path, typer.Option(help="Parameter file to write; fit.png goes beside it.")] = Path(
        "parameters.yaml"
    ),
    start: Annotated[
        Path | None,
        typer.Option(help="What to start from: parameters, myconfig.py, or a RoboRacer car's YAML or URDF."),
    ] = None,
) -> Result:
    """Fit the digital twin's parameters to recorded drives.

    `--sim donkey@FILE` then drives with them.

    Example: ds twin fit located --out car.yaml
    """
    from ds_report.error_pictures import draw_fit
    from ds_twin_donkey.car_files import document_of, read_start, write_parameters
    from ds_twin_donkey.fit import fit, fit_located
    from ds_twin_donkey.logs import read_log

    recorded = [read_log(path) for path in logs]
    initial = read_start(start) if start else None
    begin = initial.parameters if initial else None
    if initial and initial.taken:
        say(f"taken from {start}: {', '.join(initial.taken)}")
    drives = [drive for log in recorded for drive in log.drives]
    located = all(log.kind == "located" for log in recorded)
    mounting = None
    if located:
        fitted, mounting = fit_located(drives, begin, progress=ScreenProgress())
    else:
        fitted = fit(drives, begin, progress=ScreenProgress())
    for name, ratio in fitted.misfit.items():
        if ratio > MISFIT:
            say(
                f"warning: {name}: the residuals are {ratio:.1f} times the noise of the drives: "
                "the model does not follow them, and the intervals are too narrow"
            )
    document = document_of(fitted, recorded)
    if mounting is not None:
        document["poses"] = {"forward_m": round(mounting.forward, 4), "yaw_rad": round(mounting.yaw, 4)}
        say(
            f"the poses are {mounting.forward:.3f} m ahead of the car's centre, turned left by {mounting.yaw:.3f} rad: "
            "with a camera there, add that to forward_m in camera.yaml, and locate again"
        )
    write_parameters(out, document)
    picture = out.parent / "fit.png"
    draw_fit(fitted, picture)
    document |= {"file": str(out), "picture": str(picture)}

    def show() -> None:
        table = Table("parameter", "value", "95% interval", "unit", "")
        for name, row in document["parameters"].items():
            if row["status"] != "held":
                interval = " to ".join(format_3sf(value) for value in row.get("interval_95", []))
                table.add_row(name, format_3sf(row["value"]), interval, row["unit"], row["status"])
        Console().print(table)
        print(f"{out}\n{picture}")

    following = ds_command("drive", "--sim", f"donkey@{out}", "--driver", "autopilot")
    return Result(document=document, show=show, next=following)
