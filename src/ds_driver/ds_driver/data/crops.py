"""Image rows that networks do not see, for each simulator of a data set."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from ds_driver.data.dataset import imported_names
from ds_driver.networks.preprocessing import Crop
from ds_sim.registry import received_simulator, spec_of

TRUST = "--trust"
"""Option with which a user confirms code that a file names."""


def crops_of(data: Path, names: Iterable[str], *, trusted: Collection[str] = ()) -> dict[str, Crop]:
    """Rows to cut off for each name in a data set: the simulator's own, none of a recording, which is whole.

    Args:
        data: folder of the data set.
        names: simulators that its samples name.
        trusted: simulators of the user's own whose code may run.

    Raises:
        ds_sim.registry.UnknownSimulatorError: a name is neither a simulator's nor a recording's.
        ds_sim.registry.UntrustedSimulatorError: a name is code that is neither shipped nor trusted.
    """
    recorded = imported_names(data)
    return {
        name: Crop() if name in recorded else simulator_crop(received_simulator(name, confirmed=trusted, option=TRUST))
        for name in sorted(set(names))
    }


def simulator_crop(name: str) -> Crop:
    """Rows that a network does not see on a simulator."""
    spec = spec_of(name)
    return Crop(spec.crop_top, spec.crop_bottom)
