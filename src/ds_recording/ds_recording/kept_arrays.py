# SPDX-License-Identifier: Apache-2.0
"""What a location that was interrupted knows: files in its folder, which name the inputs that they belong to."""

from __future__ import annotations

import hashlib
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ds_base.atomic_files import whole_file
from ds_base.bounded_file import FileError, open_regular
from ds_base.folder_files import make_folder
from ds_recording.floor_camera import FloorCamera
from ds_recording.hints import Hint
from ds_recording.lines import LinePoints
from ds_recording.motion import Motion
from ds_recording.recording import Views
from ds_recording.smoother import Evidence

Arrays = dict[str, NDArray[Any]]
_LINES, _MOTION, _HINT = (tuple(field.name for field in fields(kind)) for kind in (LinePoints, Motion, Hint))


class KeptArrays:
    """Keeps arrays in a folder until the location is finished; without a folder, nothing.

    `inputs` is a digest of everything that they depend on: what was kept for others is ignored.
    """

    def __init__(self, folder: Path | None = None, inputs: str = "") -> None:
        self._folder, self._inputs = folder, inputs

    def _file(self, name: str) -> Path | None:
        return self._folder and self._folder / f"unfinished_{name}.npz"

    def load(self, name: str) -> Arrays | None:
        """What was kept; None if nothing was, or for other inputs, or a file is damaged."""
        path = self._file(name)
        try:
            if path is None:
                return None
            with open_regular(path) as content, np.load(content, allow_pickle=False) as stored:
                return dict(stored) if str(stored["inputs"]) == self._inputs else None
        except (FileError, OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None

    def keep(self, name: str, arrays: Arrays) -> None:
        """Write arrays, in the place of what was kept under the name."""
        path = self._file(name)
        if path is None or self._folder is None:
            return
        make_folder(self._folder)
        with whole_file(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, inputs=np.array(self._inputs), **arrays)

    def forget(self) -> None:
        """Remove what was kept, at the end."""
        for path in self._folder.glob("unfinished_*.npz") if self._folder else ():
            path.unlink()


def digest_of(views: Views, camera: FloorCamera, lane_width: float) -> str:
    """SHA-256 of what a location depends on."""
    digest = hashlib.sha256(repr((astuple(camera), lane_width, views.centre, len(views.images))).encode())
    for part in (views.seconds, views.steering, *views.images):
        digest.update(np.ascontiguousarray(part).tobytes())
    for source in views.odometry:
        digest.update(source.name.encode() + source.times.tobytes() + source.values.tobytes())
    return digest.hexdigest()


def arrays_of(evidence: Evidence) -> Arrays:
    """Evidence as arrays for `evidence_of`; what was not seen is NaN."""
    none = Motion(step=np.full(3, np.nan), covariance=np.full((3, 3), np.nan), corners=-1)
    motions = [motion or none for motion in evidence.motions]
    return {
        "times": evidence.times,
        "steering": evidence.steering,
        "counts": np.array([len(points) for points in evidence.lines]),
        **{name: np.concatenate([getattr(points, name) for points in evidence.lines]) for name in _LINES},
        **{f"motion_{name}": np.array([getattr(one, name) for one in motions]) for name in _MOTION},
        **{f"hint_{name}": np.array([getattr(one, name) for one in evidence.hints]) for name in _HINT},
    }


def evidence_of(arrays: Arrays) -> Evidence:
    """The evidence again."""
    cuts = np.cumsum(arrays["counts"])[:-1]
    parts = zip(*(np.split(arrays[name], cuts) for name in _LINES), strict=True)
    motions = zip(*(arrays[f"motion_{name}"] for name in _MOTION), strict=True)
    hints = zip(*(arrays[f"hint_{name}"] for name in _HINT), strict=True)
    return Evidence(
        times=arrays["times"],
        steering=arrays["steering"],
        lines=[LinePoints(*part) for part in parts],
        motions=[None if corners < 0 else Motion(step, spread, int(corners)) for step, spread, corners in motions],
        hints=[Hint(step, std) for step, std in hints],
    )
