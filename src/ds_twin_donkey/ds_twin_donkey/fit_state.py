# SPDX-License-Identifier: Apache-2.0
"""State of a fit that was interrupted: a file beside its result, with a digest of what is fitted."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_base.atomic_files import write_json
from ds_base.bounded_file import FileError
from ds_base.bounded_json import read_json
from ds_twin_donkey.logs import CHANNELS, LogSegment
from ds_twin_donkey.windows import UNKNOWNS

Array = NDArray[np.float64]
MAX_STATE = 2**24
"""Largest file of a state, bytes; chosen: ten times the initial states of ten minutes."""


@dataclass(frozen=True, kw_only=True)
class FitState:
    """What a fit knows after a round, from 1 on, of a phase from 1 to 3, which may be settled."""

    phase: int
    round: int
    settled: bool
    theta: Array  # scaled parameters, (parameters,)
    eta: Array  # initial states, (windows, 7)
    sigma: Array  # noise of each channel, (5,)


class Kept:
    """Keeps the state of one fit in a file, if there is one; a state of other inputs is ignored, and replaced."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._digest = path, ""

    def begin(self, digest: str) -> FitState | None:
        """State after which a fit of these inputs goes on; None if it starts."""
        self._digest = digest
        try:
            raw = read_json(self._path, MAX_STATE) if self._path is not None else None
            if raw is None or raw["inputs"] != digest:
                return None
            theta, eta, sigma = (np.array(raw[name], dtype=np.float64) for name in ("theta", "eta", "sigma"))
            if theta.ndim != 1 or eta.shape[1:] != (UNKNOWNS,) or sigma.shape != (len(CHANNELS),):
                return None
            return FitState(
                phase=int(raw["phase"]),
                round=int(raw["round"]),
                settled=bool(raw["settled"]),
                theta=theta,
                eta=eta,
                sigma=sigma,
            )
        except (OSError, ValueError, KeyError, TypeError, FileError):
            return None  # none, or one that this program has not written

    def keep(self, state: FitState) -> None:
        """Write a state."""
        if self._path is None:
            return
        values = {name: getattr(state, name).tolist() for name in ("theta", "eta", "sigma")}
        about = {"phase": state.phase, "round": state.round, "settled": state.settled}
        write_json(self._path, {"inputs": self._digest, **about, **values})

    def forget(self) -> None:
        """Remove the file of a finished fit."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)


FORGETFUL = Kept(None)


def digest_of(drives: Sequence[LogSegment], settings: str) -> str:
    """SHA-256 of everything that a fit depends on."""
    digest = hashlib.sha256(settings.encode())
    for drive in drives:
        digest.update(f"{drive.commands.shape} {drive.measured.shape} {drive.from_rest}".encode())
        digest.update(drive.commands.tobytes() + drive.measured.tobytes())
    return digest.hexdigest()
