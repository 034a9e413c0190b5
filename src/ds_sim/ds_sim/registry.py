# SPDX-License-Identifier: Apache-2.0
"""Makes simulators by name: one of `SIMULATORS`, or any class given as `module:Class`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path

from ds_base.errors import InputError
from ds_sim.simulator import Simulator, SimulatorSpec

SIMULATORS = {
    "bullet": "ds_sim_bullet.simulator:BulletSimulator",
    "softbody": "ds_sim_softbody.simulator:SoftbodySimulator",
    "panda": "ds_sim_panda.simulator:PandaSimulator",
    "donkey": "ds_twin_donkey.simulator:DonkeySimulator",
    "torcs": "ds_sim_torcs.simulator:TorcsSimulator",
    "recording": "ds_recording.sibling.simulator:RecordingSimulator",
    "ros": "ds_sim_ros.simulator:RosSimulator",
}
"""Name on the command line -> `module:Class`, a class without constructor arguments but for `ros` and `recording`."""
STANDARD = ("bullet", "softbody", "panda", "donkey")
"""Simulators that set-up installs; `torcs` needs Debian's TORCS and a build, so nothing takes it unasked."""
NEED_FILE = frozenset({"recording", "ros"})
"""Simulators that are nothing without the file or folder after `@`."""
FOREIGN = frozenset({"ros", SIMULATORS["ros"]})
"""Bases of names whose simulator is another program, which commands reach through ROS."""
MAX_LABEL_LENGTH = 100
"""Chosen: a bag's name contains two labels and some digits, and a file name has at most 255 bytes."""


@dataclass(frozen=True)
class SimulatorName:
    """A simulator's name, `BASE` or `BASE@FILE`, parsed.

    Attributes:
        base: key of `SIMULATORS`, or `module:Class`.
        file: parameter file; "" where the name has none.

    Examples:
        >>> SimulatorName.parse("donkey@my_car.yaml")
        SimulatorName(base='donkey', file='my_car.yaml')
    """

    base: str
    file: str = ""

    @classmethod
    def parse(cls, text: str) -> SimulatorName:
        """Parse a name; whether there is such a simulator is seen when it is made."""
        base, _, file = text.partition("@")
        return cls(base, file) if file else cls(text)

    def __str__(self) -> str:
        return f"{self.base}@{self.file}" if self.file else self.base

    def moved(self, start: Path, end: Path) -> SimulatorName:
        """The name whose path, relative to one folder, is made relative to another."""
        return replace(self, file=path_moved(self.file, start, end)) if self.file else self

    @property
    def is_shipped(self) -> bool:
        """Whether all of the simulator's code is part of this project, whatever file it is given."""
        return (self.base in SIMULATORS or self.base in SIMULATORS.values()) and not self.is_foreign

    @property
    def is_foreign(self) -> bool:
        """Whether the simulator is another program, which has one vehicle however often it is made here."""
        return self.base in FOREIGN

    @property
    def could_exist(self) -> bool:
        """Whether the name is of a known form; its class may still be missing."""
        return self.base in SIMULATORS or ":" in self.base


def path_moved(path: str, start: Path, end: Path) -> str:
    """Make a path that is relative to one folder relative to another; absolute ones stay.

    Examples:
        >>> from pathlib import Path
        >>> from ds_sim.registry import path_moved
        >>> path_moved("../nets/mine.yaml", Path("runs"), Path("."))
        'nets/mine.yaml'
    """
    return path if os.path.isabs(path) else os.path.relpath(start / path, end)


def label_of(name: str) -> str:
    """Convert a simulator's name to a label for file names and test ids, at most `MAX_LABEL_LENGTH` ASCII characters.

    A name of letters, digits, `_`, `-` and `.` is its own label. In any other name, all other characters become `.`,
    the middle is left out if the name is long, and the first eight digits of its SHA-256 are appended, so that
    different names have different labels.

    Examples:
        >>> from ds_sim.registry import label_of
        >>> label_of("bullet"), label_of("donkey@cars/mine.yaml")
        ('bullet', 'donkey.cars.mine.yaml-3014bbc5')
    """
    label = "".join(c if c.isascii() and (c.isalnum() or c in "_-.") else "." for c in name)
    if label == name and len(label) <= MAX_LABEL_LENGTH:
        return label
    ending = "-" + hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:8]
    space = MAX_LABEL_LENGTH - len(ending)
    return (label if len(label) <= space else label[: space // 3] + label[-(space - space // 3) :]) + ending


class UnknownSimulatorError(InputError):
    """A name does not identify a simulator."""


class UntrustedSimulatorError(InputError):
    """A received file names a simulator whose code is not shipped, and nobody confirmed it."""


def received_simulator(name: object, *, confirmed: Collection[str] = (), option: str = "--trust") -> str:
    """Check a simulator name that was read from a received file, before anything is imported.

    A shipped simulator may be named freely, with a parameter file too: `donkey@FILE` opens one regular file of YAML,
    of bounded size, in which nothing can run. Any other name imports a Python module, which runs its code, so a file
    alone never decides it: the user repeats exactly that name in an option. The same holds for `ros@FILE`, which
    commands whatever listens to its topics.

    Args:
        name: as the file has it.
        confirmed: names that the user gave on the command line or in a configuration of their own.
        option: option that confirms a name, for the message.

    Returns:
        The name, safe to hand to `make_simulator`.

    Raises:
        UntrustedSimulatorError: not a string, or neither shipped nor confirmed.

    Examples:
        >>> from ds_sim import received_simulator
        >>> received_simulator("panda")
        'panda'
        >>> received_simulator("their_lab:Simulator", confirmed=["their_lab:Simulator"])
        'their_lab:Simulator'
    """
    if not isinstance(name, str):
        raise UntrustedSimulatorError(f"simulator is a {type(name).__name__}, expected one of {', '.join(SIMULATORS)}")
    if SimulatorName.parse(name).is_shipped or name in confirmed:
        return name
    shown = repr(name) if len(name) <= MAX_LABEL_LENGTH else f"{name[:MAX_LABEL_LENGTH]!r}..."
    if SimulatorName.parse(name).is_foreign:
        raise UntrustedSimulatorError(
            f"simulator {shown} sends commands to whatever listens to its topics, which a received file must not "
            f"decide: if you trust it, name it yourself with {option} {shown}"
        )
    if ":" not in name:
        raise UntrustedSimulatorError(f"unknown simulator {shown}: expected one of {', '.join(SIMULATORS)}")
    raise UntrustedSimulatorError(
        f"simulator {shown} is Python code that is not shipped, and a received file must not run code: if you trust "
        f"it, name it yourself with {option} {shown}"
    )


def make_simulator(name: str) -> Simulator:
    """Make a simulator by name.

    Args:
        name: key of `SIMULATORS`, or `module:Class`. `NAME@FILE` passes a parameter file to the class's `from_file`.

    Raises:
        UnknownSimulatorError: no simulator has this name, its class cannot be imported, or it takes no file.
        ValueError: the file cannot be used.

    Examples:
        >>> from ds_sim import make_simulator
        >>> simulator = make_simulator("softbody")
        >>> simulator.spec.name, simulator.spec.camera.width
        ('softbody', 320)
    """
    parsed = SimulatorName.parse(name)
    name, file = parsed.base, parsed.file
    target = SIMULATORS.get(name, name)
    module, _, attribute = target.partition(":")
    if not attribute:
        raise UnknownSimulatorError(
            f"unknown simulator {name!r}: expected one of {', '.join(SIMULATORS)}, or module:Class"
        )
    try:
        kind = getattr(import_module(module), attribute)
        if file and not hasattr(kind, "from_file"):
            raise UnknownSimulatorError(f"simulator {name!r} takes no parameter file: leave out @{file}")
        simulator: Simulator = kind.from_file(Path(file)) if file else kind()
    except (ImportError, AttributeError) as error:
        advice = "" if name in SIMULATORS else ": check module:Class"
        raise UnknownSimulatorError(f"simulator {name!r} cannot be loaded ({error}){advice}") from None
    return simulator


def simulator_of_process(name: str) -> Simulator:
    """Return a simulator by name that this process keeps, as some are slow to make; it draws all rows.

    The next call with the same name returns the same simulator, so a process has one run on it at a time. Raises as
    `make_simulator` does.
    """
    simulator = _kept(name)
    simulator.draw_rows(0, simulator.spec.camera.height_px)  # the run before may have drawn fewer
    return simulator


@cache
def _kept(name: str) -> Simulator:
    return make_simulator(name)


@lru_cache
def spec_of(name: str) -> SimulatorSpec:
    """Spec of a simulator, cached because some are slow to make; raises as `make_simulator` does.

    Examples:
        >>> from ds_sim import spec_of
        >>> spec_of("donkey").camera.width
        320
    """
    made = make_simulator(name)
    try:
        return made.spec
    finally:
        made.close()
