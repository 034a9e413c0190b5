# SPDX-License-Identifier: Apache-2.0
"""Drives with a Python class of the user's."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.backends import last_line
from ds_driver.networks.images import checked
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction


class UserClassPilot(Pilot):
    """Wraps a class without constructor arguments, with a method `drive(frame)` and, if it has state, `start()`.

    `drive` takes a `Frame` and returns the steering, or a pair of steering and throttle.

    Raises:
        DriverError: the class cannot be imported or instantiated, or fails on a black image.
    """

    def __init__(self, target: str) -> None:
        kind, self._target = _find(target), target
        try:
            self._driver: Any = kind()
        except Exception as error:
            raise DriverError(f"driver {target} cannot be created ({_describe(error)}): fix its __init__") from None
        if not callable(getattr(self._driver, "drive", None)):
            raise DriverError(f"driver {target} has no method drive(frame): see docs/bring_your_own_network.md")
        self.has_memory = getattr(self._driver, "start", None) is not None
        self.start()
        self.predict(Frame.black())
        self.start()

    def start(self) -> None:
        """Call `start` of the class, if it has one, at the start of a run."""
        if self.has_memory:
            try:
                self._driver.start()
            except Exception as error:
                raise DriverError(f"{self._target}.start failed ({_describe(error)})") from None

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        checked(frame.image)
        try:
            answer: Any = self._driver.drive(frame)
        except Exception as error:  # any exception in user code is an error, never a failed test
            raise DriverError(f"{self._target}.drive failed ({_describe(error)})") from None
        steering, throttle = answer if isinstance(answer, (tuple, list)) and len(answer) == 2 else (answer, None)
        try:
            return Prediction(float(steering), None if throttle is None else float(throttle))
        except (TypeError, ValueError) as error:
            if isinstance(error, DriverError):
                raise
            raise DriverError(
                f"{self._target}.drive returned {answer!r:.60}: expected the steering, or steering and throttle"
            ) from None

    def seen(self, frame: Frame) -> tuple[NDArray[np.uint8], str]:
        """Return the whole image; see `Pilot.seen`."""
        return frame.image, "rgb"


def source_of(target: str) -> Path:
    """Return the source file of a class; a `DriverError` if it cannot be imported, or comes from no file."""
    file = getattr(sys.modules[_find(target).__module__], "__file__", None)
    if file is None:
        raise DriverError(f"driver {target} comes from no file: move it to a module")
    return Path(file)


def _find(target: str) -> type:
    module, _, attribute = target.partition(":")
    try:
        kind: type = getattr(import_module(module), attribute)
    except Exception as error:  # importing a module can raise anything
        raise DriverError(
            f"driver {target!r} cannot be imported ({_describe(error)}): expected module:Class, with the module in "
            "this folder or on PYTHONPATH"
        ) from None
    return kind


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {last_line(error)}"
