"""A driver that somebody brings as a Python class, `module:Class`."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ds_driver.networks.backends import last_line
from ds_driver.networks.pilot import DriverError, Frame, Prediction
from ds_driver.networks.preprocessing import checked
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH


class UserClassPilot:
    """Drives by a class without constructor arguments, with a method `drive(seen)` and, if it remembers, `start()`.

    `drive` takes a `Frame` and gives the steering, or a pair of steering and throttle.

    Args:
        target: `module:Class`.

    Raises:
        DriverError: it cannot be imported or made, or it does not answer a black image.
    """

    def __init__(self, target: str) -> None:
        kind = _find(target)
        self._target = target
        try:
            self._driver = kind()
        except Exception as error:
            raise DriverError(f"driver {target} cannot be made ({_said(error)}): mend its __init__") from None
        if not callable(getattr(self._driver, "drive", None)):
            raise DriverError(f"driver {target} has no method drive(seen): see docs/bring_your_own_network.md")
        self.start()
        self.predict(Frame(image=np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8), speed=0.0))
        self.start()

    def start(self) -> None:
        """Tell the class, if it wants to know, that a run begins."""
        start = getattr(self._driver, "start", None)
        if start is not None:
            try:
                start()
            except Exception as error:
                raise DriverError(f"{self._target}.start failed ({_said(error)})") from None

    def predict(self, seen: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        checked(seen.image)
        try:
            answer: Any = self._driver.drive(seen)
        except Exception as error:  # whatever breaks in somebody's class is its error, and never a failure on the road
            raise DriverError(f"{self._target}.drive failed ({_said(error)})") from None
        steering, throttle = answer if isinstance(answer, (tuple, list)) and len(answer) == 2 else (answer, None)
        try:
            return Prediction(float(steering), None if throttle is None else float(throttle))
        except (TypeError, ValueError) as error:
            if isinstance(error, DriverError):
                raise
            raise DriverError(
                f"{self._target}.drive gave {answer!r:.60}: expected the steering, or steering and throttle"
            ) from None


def source_of(target: str) -> Path:
    """The file in which a class is written.

    Raises:
        DriverError: it cannot be imported, or has none.
    """
    file = getattr(sys.modules[_find(target).__module__], "__file__", None)
    if file is None:
        raise DriverError(f"driver {target} comes from no file: write it into a module")
    return Path(file)


def _find(target: str) -> type:
    module, _, attribute = target.partition(":")
    try:
        kind: type = getattr(import_module(module), attribute)
    except Exception as error:  # a module can fail in any way while it is imported
        raise DriverError(
            f"driver {target!r} cannot be imported ({_said(error)}): expected module:Class, with the module in this "
            "folder or on PYTHONPATH"
        ) from None
    return kind


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {last_line(error)}"
