"""Estimates a camera from a recording alone: lines give height and pitch, lines and motion together the focal length.

Lines alone leave the focal length a third off: a longer one under a flatter camera sees nearly the same lines. But it
sees another motion. So for each of several lenses and focal lengths parts of the recording are solved, and that is
taken which lines and motion contradict least; the differences between parts, and between lenses that do about as well,
say how well it is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ds_recording.errors import RecordingError
from ds_recording.floor_camera import FloorCamera
from ds_recording.lines import line_pixels
from ds_recording.mounting import mounted
from ds_recording.recording import Views

Array = NDArray[np.float64]
WIDE = (-0.26447, 0.06051, 0.0, 0.0, -0.00548)
"""Distortion of a wide-angle lens: the polynomial closest to an equidistant one up to 66 degrees from its axis."""
LENSES = tuple(tuple(strength * k for k in WIDE) for strength in (0.0, 0.4, 1.0))
FOCALS = 0.32 * 1.22 ** np.arange(7)
"""Focal lengths that are tried, widths of the image: fields of view of 115 to 51 degrees."""
PARTS, PART = 3, 150
"""Parts of the recording that are solved for each lens and focal length, and images of each."""
AS_GOOD = 1.05
"""Factor on the least contradiction within which another lens is as good."""
IMAGES = 24
"""Images whose lines are used for height and pitch."""
LARGEST_STD = 0.1
"""Standard deviation of the focal length, as a share, beyond which a camera is not used."""
SMALLEST_STD = 0.02
"""What is added to it, in squares; chosen: the differences between the steps of the grid."""
Cost = Callable[[FloorCamera, slice], float]
"""Contradiction between lines and motion in a part of the recording; raises RecordingError where nothing fits."""


def mount(views: Views, camera: FloorCamera, lane_width: float) -> FloorCamera:
    """Find height and pitch of a camera whose lens is known.

    Raises:
        RecordingError: the lines fit none.
    """
    rows, columns = views.images[0].shape[:2]
    found, _ = mounted(camera.resized(columns, rows).scaled(1.0 / lane_width), _lines(views))
    height = (found.height_m or 1.0) * lane_width
    return replace(camera, height_m=height, pitch_rad=found.pitch_rad)


def estimate_camera(
    views: Views, lane_width: float, cost: Cost, say: Callable[[int, int, str], None] = lambda *_: None
) -> FloorCamera:
    """Estimate lens, focal length, height and pitch.

    Args:
        views: the recording.
        lane_width: m.
        cost: solves a part with a camera for the recorded size.
        say: progress.

    Raises:
        RecordingError: the focal length stays uncertain, or nothing fits.
    """
    rows, columns = views.images[0].shape[:2]
    lines = _lines(views)
    advice = "calibrate with a chessboard (ds recording calibrate), and give it with --camera"

    def camera_with(focal: float, lens: tuple[float, ...]) -> tuple[FloorCamera, float]:
        plain = FloorCamera(
            width_px=columns, height_px=rows, focal_px=focal * columns, centre_x_px=(columns - 1) / 2,
            centre_y_px=(rows - 1) / 2, distortion=lens,
        )  # fmt: skip
        found, error = mounted(plain, lines)
        return found.scaled(lane_width).resized(*views.size), error

    say(0, 1, "camera: height and pitch for several lenses")
    fits: dict[tuple[int, int], tuple[FloorCamera, float]] = {}
    for lens in range(len(LENSES)):
        for focal in range(len(FOCALS)):
            try:
                fits[lens, focal] = camera_with(float(FOCALS[focal]), LENSES[lens])
            except RecordingError as error:
                reason = error
    if not fits:
        raise reason
    starts = np.linspace(0, max(len(views.images) - PART, 0), PARTS).round().astype(int).tolist()
    costs = np.full((len(LENSES), PARTS, len(FOCALS)), np.nan)
    for place, ((lens, focal), (camera, _)) in enumerate(sorted(fits.items())):
        say(place, len(fits), "camera: lenses and focal lengths tried")
        for part, start in enumerate(starts):
            try:
                costs[lens, part, focal] = cost(camera, slice(start, start + PART))
            except RecordingError:
                continue
    found = [[lowest(np.log(FOCALS), row) for row in rows] for rows in costs]
    least = [
        sum(v.cost for v in row if v) / max(sum(map(bool, row)), 1) if sum(map(bool, row)) > 1 else math.inf
        for row in found
    ]
    best = int(np.argmin(least))
    if not math.isfinite(least[best]):
        raise RecordingError(f"lines and motion leave the focal length open: {advice}")
    logs = np.array([v.place for v in found[best] if v])
    rivals = [
        np.mean([v.place for v in row if v]) for row, c in zip(found, least, strict=True) if c < AS_GOOD * least[best]
    ]
    spread = math.sqrt(float(logs.var(ddof=1)) / len(logs) + float(np.var(rivals)) + SMALLEST_STD**2)
    if spread > LARGEST_STD:
        raise RecordingError(f"the focal length stays uncertain by {spread:.0%}, expected {LARGEST_STD:.0%}: {advice}")
    camera, _ = camera_with(math.exp(float(logs.mean())), LENSES[best])
    return replace(camera, focal_std=spread * camera.focal_px)


class Lowest(NamedTuple):
    """Minimum of a curve: where, and how low."""

    place: float
    cost: float


def lowest(places: Array, costs: Array) -> Lowest | None:
    """Minimum of a smooth curve through noisy values; None if it lies at an end.

    Args:
        places: (n,).
        costs: (n,), NaN where unknown.
    """
    known = np.flatnonzero(np.isfinite(costs))
    if len(known) < 5:
        return None
    # Only the valley: the curve is no parabola far from it.
    best = int(known[np.argmin(costs[known])])
    near = known[np.abs(places[known] - places[best]) < 0.5]
    if len(near) < 4:
        return None
    bend, slope, base = np.polyfit(places[near] - places[best], costs[near], 2)
    lowest_at = -slope / (2.0 * bend) if bend > 0.0 else math.inf
    inside = bend > 0.0 and places[near[0]] - places[best] < lowest_at < places[near[-1]] - places[best]
    return Lowest(float(places[best] + lowest_at), float(base + 0.5 * slope * lowest_at)) if inside else None


def _lines(views: Views) -> list[tuple[Array, Array, NDArray[np.bool_]]]:
    """Lines of some images, below the upper quarter."""
    chosen = np.linspace(0, len(views.images) - 1, IMAGES + 2)[1:-1].round().astype(int)
    return [line_pixels(views.images[i], views.images[i].shape[0] // 3) for i in chosen.tolist()]
