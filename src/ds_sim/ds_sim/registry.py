"""Finds a simulator by its name; a new simulator is one line here, or `module:Class` wherever a name is asked for."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from ds_sim.simulator import Simulator

SIMULATORS = {
    "bullet": "ds_sim_bullet.simulator:BulletSimulator",
    "softbody": "ds_sim_softbody.simulator:SoftbodySimulator",
    "donkey": "ds_twin_donkey.simulator:DonkeySimulator",
}
"""Name on the command line -> `module:Class`, a class without constructor arguments."""


def label_of(name: str) -> str:
    """A simulator's name as a part of file names and test ids; different names keep different labels."""
    return "".join(c if c.isalnum() or c in "_-." else "." for c in name)


class UnknownSimulatorError(ValueError):
    """A name that stands for no simulator."""


def make_simulator(name: str) -> Simulator:
    """Make the simulator with a known name, or any other one given as `module:Class`.

    `NAME@FILE` makes it with the parameters of a file, by its class's `from_file`.

    Raises:
        UnknownSimulatorError: no simulator has this name, its class cannot be imported, or it takes no file.
        ValueError: the file cannot be used.
    """
    name, at, file = name.partition("@")
    target = SIMULATORS.get(name, name)
    module, _, attribute = target.partition(":")
    if not attribute:
        raise UnknownSimulatorError(
            f"unknown simulator {name!r}: expected one of {', '.join(SIMULATORS)}, or module:Class"
        )
    try:
        kind = getattr(import_module(module), attribute)
        if at and not hasattr(kind, "from_file"):
            raise UnknownSimulatorError(f"simulator {name!r} takes no parameter file: leave out @{file}")
        simulator: Simulator = kind.from_file(Path(file)) if at else kind()
    except (ImportError, AttributeError) as error:
        raise UnknownSimulatorError(f"simulator {name!r} cannot be loaded ({error}): check module:Class") from None
    return simulator
