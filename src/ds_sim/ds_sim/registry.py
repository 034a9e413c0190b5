# SPDX-License-Identifier: Apache-2.0
"""Makes simulators by name: a shipped one, one of an installed package, or any class given as `module:Class`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Sequence
from contextlib import closing
from functools import cache, lru_cache
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

from ds_base.errors import InputError
from ds_base.extension import installed, plugin_of
from ds_base.installation import EXTRAS, missing_module
from ds_base.palette import SERIES
from ds_base.words import did_you_mean, listed

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema

    from ds_road import Road
    from ds_sim.simulator import Simulator, SimulatorSpec  # NumPy would delay every help text

SIMULATORS = {
    "bullet": "ds_sim_bullet.simulator:BulletSimulator",
    "softbody": "ds_sim_softbody.simulator:SoftbodySimulator",
    "panda": "ds_sim_panda.simulator:PandaSimulator",
    "donkey": "ds_twin_donkey.simulator:DonkeySimulator",
    "recording": "ds_recording.sibling.simulator:RecordingSimulator",
    "ros": "ds_sim_ros.simulator:RosSimulator",
}
"""Shipped simulators: name -> `module:Class`. Installed packages add others, see `simulators`."""
HYBRID = "ds_sim.hybrid:HybridSimulator"
"""Base of the names of hybrids, which end with their parts, `@camera=bullet,look=softbody,...`."""
MAX_LABEL_LENGTH = 100
"""Chosen: a bag's name contains two labels and some digits, and a file name has at most 255 bytes."""


class SimulatorName(str):
    """A simulator's name, `BASE` or `BASE@FILE`: made where text comes in, and carried as a value from there on.

    It is its text, so that files, tables and pages have it as that, and it knows its parts. Whether there is such a
    simulator is seen when that is made.

    Examples:
        >>> from ds_sim.registry import HYBRID, SimulatorName
        >>> name = SimulatorName("donkey@my_car.yaml")
        >>> name, name.base, name.file
        ('donkey@my_car.yaml', 'donkey', 'my_car.yaml')
        >>> SimulatorName(HYBRID + "@camera=donkey,look=bullet,vehicle=bullet,delays=bullet").in_words
        'bullet with the camera of donkey'
    """

    __slots__ = ()

    @classmethod
    def __get_pydantic_core_schema__(cls, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Read it from text, each name into one object, and write it as text."""
        from pydantic_core.core_schema import no_info_after_validator_function, to_string_ser_schema

        one_object = lru_cache(maxsize=1024)(cls)
        return no_info_after_validator_function(
            one_object, handler(str), serialization=to_string_ser_schema(when_used="always")
        )

    @property
    def base(self) -> str:
        """One of `simulators`, or `module:Class`."""
        base, _, ending = self.partition("@")
        return base if ending else str(self)

    @property
    def file(self) -> str:
        """Parameter file; "" where the name has none."""
        return "" if self.base == HYBRID else self.partition("@")[2]

    @property
    def parts(self) -> dict[str, SimulatorName]:
        """Of a hybrid, each part and the simulator that gives it."""
        ending = self.partition("@")[2] if self.base == HYBRID else ""
        pairs = (part.partition("=") for part in ending.split(",") if ending)
        return {part: SimulatorName(name) for part, _, name in pairs}

    @property
    def in_words(self) -> str:
        """The name for a person; of a hybrid its parts: `bullet with the camera of donkey`."""
        if not self.parts:
            return self
        names = list(self.parts.values())
        most = max(names, key=names.count)
        others = [f"the {part} of {name}" for part, name in self.parts.items() if name != most]
        return f"{most} with {listed(others)}" if others else most

    def moved(self, start: Path, end: Path) -> SimulatorName:
        """The name whose paths, relative to one folder, are made relative to another."""
        parts = ",".join(f"{part}={name.moved(start, end)}" for part, name in self.parts.items())
        ending = path_moved(self.file, start, end) if self.file else parts
        return SimulatorName(f"{self.base}@{ending}") if ending else self

    @property
    def exists(self) -> bool:
        """Whether the name is a registered one, or has the form of a class, which may still be missing."""
        return self.base in simulators() or ":" in self.base

    @property
    def is_external(self) -> bool:
        """Whether it is another program, see `Simulator.is_external`; False where its class cannot be imported."""
        try:
            return simulator_class(self.base).is_external
        except UnknownSimulatorError:
            return False

    @property
    def runs_no_foreign_code(self) -> bool:
        """Whether a received file may name it: code that is shipped or was installed, and no other program.

        A shipped simulator may read one file of bounded size, in which nothing can run; of others that is not known,
        and one that is nothing without a file opens what that names, such as a folder of photographs.
        """
        shipped = self.base in SIMULATORS or self.base in SIMULATORS.values()
        if not (shipped or (self.base in installed("simulators") and not self.file)):
            return False
        return not self.is_external and not (self.file and simulator_class(self.base).needs_file)


BULLET, SOFTBODY, PANDA, DONKEY = STANDARD = tuple(map(SimulatorName, ("bullet", "softbody", "panda", "donkey")))
"""Simulators that drive any road without a file; `all` stands for them."""
NO_SIMULATOR = SimulatorName("")
"""In place of a name where none applies."""


def simulators() -> list[SimulatorName]:
    """Names of all registered simulators: the shipped ones, then those of installed packages."""
    return [SimulatorName(name) for name in {**SIMULATORS, **installed("simulators")}]


def path_moved(path: str, start: Path, end: Path) -> str:
    """Make a path that is relative to one folder relative to another; absolute ones stay.

    Examples:
        >>> from pathlib import Path
        >>> from ds_sim.registry import path_moved
        >>> path_moved("../nets/mine.yaml", Path("runs"), Path("."))
        'nets/mine.yaml'
    """
    return path if os.path.isabs(path) else os.path.relpath(start / path, end)


def colours_of(names: Sequence[SimulatorName]) -> dict[SimulatorName, str]:
    """Colour of each of several simulators: a shipped one's is always the same, the others take free ones in order.

    Examples:
        >>> from ds_sim.registry import SimulatorName, colours_of
        >>> bullet, donkey, other = map(SimulatorName, ("bullet", "donkey", "mine:Sim"))
        >>> colours_of([bullet, other])[bullet] == colours_of([donkey, bullet])[bullet]
        True
    """
    own = dict(zip(SIMULATORS, SERIES, strict=False))
    colours: dict[SimulatorName, str] = {}
    for name in names:
        colour = own.get(name.base)
        if colour is not None and colour not in colours.values():
            colours[name] = colour
    free = cycle([colour for colour in SERIES if colour not in colours.values()] or SERIES)
    return {name: colours.get(name) or next(free) for name in names}


def label_of(name: str) -> str:
    """Convert a simulator's name to a label for file names and test ids, at most `MAX_LABEL_LENGTH` ASCII characters.

    A name of letters, digits, `_`, `-` and `.` is its own label. In any other name, all other characters become `.`,
    the middle is left out if the name is long, and the first eight digits of its SHA-256 are appended, so that
    different names have different labels.
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


def received_simulator(name: object, *, confirmed: Collection[str] = ()) -> SimulatorName:
    """Check a simulator name that was read from a received file, before anything is imported.

    A shipped simulator may be named freely, with a parameter file too: `donkey@FILE` opens one regular file of YAML, of
    bounded size, in which nothing can run. Any other name imports Python code, and `ros@FILE` commands whatever listens
    to its topics: the user repeats exactly that name with `--trust`.

    Args:
        name: as the file has it.
        confirmed: names that the user gave on the command line or in a configuration of their own.

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
        raise UntrustedSimulatorError(
            f"simulator is a {type(name).__name__}, expected one of {', '.join(simulators())}"
        )
    parsed = SimulatorName(name)
    if parsed.runs_no_foreign_code or name in confirmed:
        return parsed
    shown = repr(name) if len(name) <= MAX_LABEL_LENGTH else f"{name[:MAX_LABEL_LENGTH]!r}..."
    if not parsed.exists:
        raise UntrustedSimulatorError(f"unknown simulator {shown}: expected one of {', '.join(simulators())}")
    if parsed.base in simulators() or parsed.base in SIMULATORS.values():
        what = (
            "sends commands to whatever listens to its topics" if parsed.is_external else "opens a file of its own kind"
        )
        reason = f"{what}, which a received file must not decide"
    else:
        reason = "is Python code that is not shipped, and a received file must not run code"
    raise UntrustedSimulatorError(f"simulator {shown} {reason}: if you trust it, name it yourself with --trust {shown}")


def simulator_class(base: str) -> type[Simulator]:
    """Import the class of one of `simulators`, or of `module:Class`; UnknownSimulatorError where that is impossible."""
    from ds_sim.simulator import Simulator

    plugin = installed("simulators").get(base)
    target = SIMULATORS.get(base) or (plugin.value if plugin else base)
    module, _, attribute = target.partition(":")
    if not attribute:
        raise UnknownSimulatorError(unknown_simulator(base))
    try:
        kind = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        library = str(getattr(error, "name", "")).partition(".")[0]
        problem = missing_module(library) if library in EXTRAS else error
        raise UnknownSimulatorError(_cannot_be_loaded(base, problem)) from None
    if not (isinstance(kind, type) and issubclass(kind, Simulator)):
        raise UnknownSimulatorError(f"{target} is no subclass of ds_sim.Simulator: docs/add_a_simulator.md")
    return kind


def unknown_simulator(name: str) -> str:
    """Say in one line that there is no such simulator, which there are, and how one of this checkout is installed."""
    near = did_you_mean(name, simulators())
    names = f"unknown simulator {name!r}{near}: expected one of {', '.join(simulators())}, or module:Class"
    folder = plugin_of(name)
    return f"{names}; {folder} of this checkout has it: type make {name}" if folder else names


def with_libraries(names: Sequence[SimulatorName]) -> tuple[list[SimulatorName], list[str]]:
    """Sort simulators: those whose libraries are installed, and for each other one a line with what to type."""
    missing = {name: simulator_class(name).missing() for name in names}
    return (
        [name for name in names if not missing[name]],
        [f"{name} is left out: {problem}" for name, problem in missing.items() if problem],
    )


def _cannot_be_loaded(name: str, error: Exception | str) -> str:
    advice = ": check module:Class" if ":" in name else ""
    return f"simulator {name!r} cannot be loaded ({error}){advice}"


def make_simulator(name: str) -> Simulator:
    """Make a simulator by name.

    Args:
        name: one of `simulators`, or `module:Class`. `NAME@FILE` passes a parameter file.

    Raises:
        UnknownSimulatorError: no simulator has this name, its class cannot be imported, or it needs a file.
        ValueError: the file cannot be used.

    Examples:
        >>> from ds_sim import make_simulator
        >>> simulator = make_simulator("softbody")
        >>> simulator.spec.name, simulator.spec.camera.width
        ('softbody', 320)
    """
    parsed = SimulatorName(name)
    kind = simulator_class(parsed.base)
    if kind.needs_file and not parsed.file:
        raise UnknownSimulatorError(f"simulator {parsed.base!r} needs a file or folder: {parsed.base}@PATH")
    try:
        return kind.named(parsed)
    except (ImportError, AttributeError) as error:
        raise UnknownSimulatorError(_cannot_be_loaded(parsed.base, kind.missing() or error)) from None


def simulator_of_process(name: str) -> Simulator:
    """Return a simulator by name that this process keeps, as some are slow to make; it draws every image whole.

    The next call with the same name returns the same simulator, so a process has one run on it at a time. Raises as
    `make_simulator` does.
    """
    simulator = _kept(name)
    simulator.draw_rows(0, simulator.spec.camera.height_px)  # the run before may have drawn fewer
    simulator.draw_images(True)
    return simulator


_kept = cache(make_simulator)


@lru_cache
def spec_of(name: str) -> SimulatorSpec:
    """Spec of a simulator, cached because some are slow to make; raises as `make_simulator` does.

    Examples:
        >>> from ds_sim import spec_of
        >>> spec_of("donkey").camera.width
        320
    """
    with closing(make_simulator(name)) as simulator:
        return simulator.spec


def own_road_of(name: str) -> Road | None:
    """The road of a simulator that takes only its own, such as a recorded track; raises as `make_simulator` does."""
    with closing(make_simulator(name)) as simulator:
        return simulator.own_road
