# SPDX-License-Identifier: Apache-2.0
"""Locates the car in a recording: lines and motion of every image, a first guess of the road, and the smoother."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.progress import SILENT, Progress
from ds_recording import RecordingError
from ds_recording.closing import close_lap
from ds_recording.first_guess import chained, guess_track
from ds_recording.floor_camera import FloorCamera
from ds_recording.lines import LinePoints, line_pixels, points_on_floor
from ds_recording.located import Located
from ds_recording.motion import Hint, HintFinder, Motion, MotionFinder
from ds_recording.mounting import mount
from ds_recording.odometry import Checked, check, hints_of, stretch
from ds_recording.recording import Views
from ds_recording.smoother import TURNS, Evidence, Smoother, Solution
from ds_recording.track import Track, wrap

Array = NDArray[np.float64]
LEAST_MOTION = 0.6
"""Share of neighbouring images that must show a motion of the floor; chosen: 0.95 in order, 0.3 if shuffled."""
LEAST_LINES, ENOUGH_POINTS = 0.5, 8
"""Share of images that must show lines, and points of lines that are enough."""
STANDING = 0.004
"""Way between two images below which a car stands still, lane widths."""
LEAST_AGREEING = 0.5
"""Share of an image's line points that must be where the road has lines."""
LARGEST_STD = (0.1, 0.09)
"""Standard deviations of offset (lane widths) and heading (rad) beyond which an image counts as a gap."""
MODEL_STD = (0.015, 0.012)
"""What is added to them, in squares: a body that rolls, a floor that is not flat; chosen on simulated recordings."""
CLOSED_TURNS, WORSE_CLOSED = 10, 0.03
"""Smoother's steps on a closed line, and share of points it may lose; chosen: a wrong lap loses a third of them."""
LEAST_LOCATED = 0.5
"""Share of the stretch's images that must be located."""
LIBRARIES = ("numpy", "opencv-python-headless", "scipy")


@dataclass(frozen=True, kw_only=True)
class SolvedStretch:
    """A solved stretch in lane widths, with the evidence that it rests on."""

    evidence: Evidence
    solution: Solution
    located: NDArray[np.bool_]


def gather(views: Views, camera: FloorCamera, lane_width: float, progress: Progress = SILENT) -> Evidence:
    """Find lines and motions of a stretch's images; the camera is mounted, for images of the recorded size."""
    images, seconds = views.images, views.seconds
    scaled = camera.resized(images[0].shape[1], images[0].shape[0]).scaled(1.0 / lane_width)
    finder, before = MotionFinder(scaled), HintFinder(scaled)
    hints: list[Hint] = []
    lines: list[LinePoints] = []
    motions: list[Motion | None] = []
    progress.start(len(images))
    for index, image in enumerate(images):
        hints.append(before.see(image))
        motions.append(finder.see(image, float(seconds[index] - seconds[index - 1]) if index else 0.0, hints[-1]))
        lines.append(points_on_floor(line_pixels(image, int(scaled.horizon_row) + 1, views.centre), scaled))
        progress.advance(line="images looked at")
    return Evidence(times=seconds, lines=lines, motions=motions, hints=hints, steering=views.steering)


def with_odometry(
    evidence: Evidence, views: Views, camera: FloorCamera, lane_width: float, progress: Progress = SILENT
) -> tuple[Evidence, list[Checked]]:
    """Check other sources of motion against the images, and follow the floor anew with those that agree.

    Returns evidence of both, ways in the metres of both, and what became of each source.
    """
    pairs = list(zip(evidence.motions, evidence.hints, strict=True))[1:]
    unknown = np.full(3, np.nan)
    steps = np.array([hint.of(unknown) if motion is None else motion.step for motion, hint in pairs])
    stds = np.array([hint.std if motion is None else np.sqrt(np.diag(motion.covariance)) for motion, hint in pairs])
    checked = check(views.odometry, evidence.times, steps, stds, lane_width)
    if all(source.reason for source in checked):
        return evidence, checked
    odometry_hints = hints_of(checked, len(views.images), lane_width)
    hints = [hint.fused(other) for hint, other in zip(evidence.hints, odometry_hints, strict=True)]
    images = views.images
    finder = MotionFinder(camera.resized(images[0].shape[1], images[0].shape[0]).scaled(1.0 / lane_width))
    motions: list[Motion | None] = []
    longer = np.array([stretch(checked)] * 2 + [1.0])
    progress.start(len(images))
    for index, seconds in enumerate(np.diff(evidence.times, prepend=evidence.times[0])):
        motion = finder.see(images[index], float(seconds), hints[index])
        motions.append(motion and replace(motion, step=motion.step * longer))
        progress.advance(line="images looked at again, with odometry")
    return replace(evidence, motions=motions, hints=[replace(hint, step=hint.step * longer) for hint in hints]), checked


def check_evidence(evidence: Evidence) -> None:
    """Refuse what cannot carry a location: images between which nothing moves together, or at all, or without lines."""
    motions = [motion for motion in evidence.motions[1:] if motion is not None]
    has_motion = [
        m is not None or h.std[0] < np.inf for m, h in zip(evidence.motions[1:], evidence.hints[1:], strict=True)
    ]
    moving = float(np.mean(has_motion))
    if moving < LEAST_MOTION:
        raise RecordingError(
            f"between {1.0 - moving:.0%} of neighbouring images no common motion of the floor is seen, expected at "
            f"most {1.0 - LEAST_MOTION:.0%}: they are shuffled, missing, or show no floor: record without dropping any"
        )
    still = float(np.mean([np.hypot(*motion.step[:2]) < STANDING for motion in motions]))
    if still > 0.9:
        raise RecordingError(f"nothing moves in {still:.0%} of the images: record the car while it drives")
    lined = float(np.mean([len(points) >= ENOUGH_POINTS for points in evidence.lines]))
    if lined < LEAST_LINES:
        raise RecordingError(
            f"{1.0 - lined:.0%} of the images show no lane lines, expected at most {1.0 - LEAST_LINES:.0%}: a yellow "
            "centre line (or --centre) between white ones is looked for below the horizon; check camera and lane width"
        )
    yellow = float(np.mean([bool((~points.white).any()) for points in evidence.lines]))
    if yellow < 0.5 * LEAST_LINES:
        raise RecordingError(
            f"only {yellow:.0%} of the images show the centre line, expected 25%: say its colour with --centre"
        )


def solve(evidence: Evidence, progress: Progress = SILENT) -> SolvedStretch:
    """Guess the road, smooth the run, and join the ends of a lap where there is one."""
    steps, last = [], np.zeros(3)
    for index, seconds in enumerate(np.diff(evidence.times), start=1):
        motion = evidence.motions[index]
        last = (evidence.hints[index].of(last * seconds) if motion is None else motion.step) / seconds
        steps.append(last * seconds)
    poses = chained(np.array(steps))
    track = guess_track(evidence.lines, poses)
    if track is None:
        raise RecordingError(
            "the lines of most images fit no road with a coloured centre line and white edges, one lane width apart: "
            "check --lane-width and the camera"
        )
    progress.start(TURNS + CLOSED_TURNS)
    smoother = Smoother(evidence, poses, track)
    solution = smoother.solve(TURNS, progress)
    lap = close_lap(solution.track, solution.along, solution.lateral, solution.heading)
    if lap is not None:
        smoother = Smoother(evidence, lap.poses, lap.track, lap.pieces)
        closed = smoother.solve(CLOSED_TURNS, progress)
        if np.nanmean(closed.agree) > np.nanmean(solution.agree) - WORSE_CLOSED:
            solution = closed
    located = _trusted(evidence, solution)
    if located.mean() < LEAST_LOCATED:
        raise RecordingError(
            f"{1.0 - located.mean():.0%} of the images could not be located, expected at most "
            f"{1.0 - LEAST_LOCATED:.0%}: lines and motion contradict each other; check --lane-width and the camera"
        )
    return SolvedStretch(evidence=evidence, solution=solution, located=located)


def _trusted(evidence: Evidence, solution: Solution) -> NDArray[np.bool_]:
    """Which images are located: known well enough, and not contradicted by what they show themselves."""
    enough = np.array([len(points) >= ENOUGH_POINTS for points in evidence.lines])
    contradicted = enough & ~(solution.agree >= LEAST_AGREEING)
    sure = (solution.std_lateral < LARGEST_STD[0]) & (solution.std_heading < LARGEST_STD[1])
    return np.asarray(sure & ~contradicted & (np.abs(solution.lateral) < 3.0))


def in_metres(
    views: Views,
    fit: SolvedStretch,
    camera: FloorCamera,
    lane_width: float,
    calibration: str,
    checked: Sequence[Checked] = (),
) -> Located:
    """Tables of a solved stretch, in metres."""
    solution, times = fit.solution, fit.evidence.times
    # Speeds over two images on either side, in which the errors of single steps are evened out.
    low, high = np.maximum(np.arange(len(times)) - 2, 0), np.minimum(np.arange(len(times)) + 2, len(times) - 1)
    way, seconds = solution.poses[high] - solution.poses[low], times[high] - times[low]
    ahead = way[:, 0] * np.cos(solution.poses[:, 2]) + way[:, 1] * np.sin(solution.poses[:, 2])
    stds = [
        np.hypot(std, more) for std, more in zip((solution.std_lateral, solution.std_heading), MODEL_STD, strict=True)
    ]
    yaw = wrap(solution.poses[:, 2])
    table = np.stack(
        (
            views.frames, times, solution.poses[:, 0] * lane_width, solution.poses[:, 1] * lane_width, yaw,
            solution.along * lane_width, solution.lateral * lane_width, solution.heading, ahead / seconds * lane_width,
            way[:, 2] / seconds, stds[0] * lane_width, stds[1], views.steering, views.throttle.clip(0.0, 1.0),
        ),
        axis=1,
    )  # fmt: skip
    track = solution.track
    steering = solution.steering
    about: dict[str, Any] = {
        "source": str(views.recording.path),
        "kind": "tub" if views.recording.kind == "tub" else "bag",
        "frames": views.total,
        "located": float(fit.located.sum()) / views.total,
        "closed": track.closed,
        "centre": views.centre,
        "lane_width_m": lane_width,
        "calibration": calibration,
        "versions": {name: version(name) for name in LIBRARIES},
        "stretch": {"first": int(views.frames[0]), "last": int(views.frames[-1]), "located": float(fit.located.mean())},
        "steering": None
        if steering is None
        else {
            "gain_per_m": steering.gain / lane_width,
            "trim_per_m": steering.trim / lane_width,
            "delay_s": steering.delay,
            "lag_s": steering.lag,
            "explained": steering.explained,
        },
        "odometry": [source.about for source in checked],
        "ways_in_images_times": stretch(checked),
        "median_line_residual_m": float(np.nanmedian(solution.residuals)) * lane_width,
    }
    return Located(
        table=table[fit.located],
        track=Track(track.points * lane_width, track.closed),
        lane_width=lane_width,
        camera=camera,
        about=about,
    )


def located_of(
    views: Views, camera: FloorCamera, lane_width: float, progress: Progress = SILENT
) -> tuple[Located, SolvedStretch]:
    """Locate a stretch; if it cannot be, a RecordingError has the reason, and the share of images that failed."""
    if (camera.width_px, camera.height_px) != views.size:
        raise RecordingError(
            f"the camera is for {camera.width_px} x {camera.height_px} px, the images have {views.size[0]} x "
            f"{views.size[1]}: give the camera of this recording"
        )
    calibration = "given"
    if not camera.mounted:
        calibration = "chessboard"
        camera = mount(views, camera, lane_width)
    evidence = gather(views, camera, lane_width, progress)
    check_evidence(evidence)
    checked: list[Checked] = []
    if views.odometry:
        evidence, checked = with_odometry(evidence, views, camera, lane_width, progress)
    progress.describe("lines and motion found; solving for the whole run")
    fit = solve(evidence, progress)
    return in_metres(views, fit, camera, lane_width, calibration, checked), fit
