"""Finds the crop of each simulator in a data set."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from ds_driver.data.dataset import imported_names
from ds_driver.networks.images import Crop
from ds_sim.registry import received_simulator, spec_of

TRUST = "--trust"
"""Command line option that confirms code named by a file."""


def crops_of(data: Path, names: Iterable[str], *, trusted: Collection[str] = ()) -> dict[str, Crop]:
    """Return the crop for each name in a data set: that of the simulator, or none for recordings.

    Args:
        data: folder of the data set.
        names: names of simulators or recordings in its samples.
        trusted: user-provided simulators whose code may run.

    Raises:
        ds_sim.registry.UnknownSimulatorError: a name denotes neither a simulator nor recordings.
        ds_sim.registry.UntrustedSimulatorError: a name denotes code that is neither shipped nor trusted.
    """
    recorded = imported_names(data)
    return {
        name: Crop() if name in recorded else simulator_crop(received_simulator(name, confirmed=trusted, option=TRUST))
        for name in sorted(set(names))
    }


def simulator_crop(name: str) -> Crop:
    """Return the crop for the images of a simulator."""
    spec = spec_of(name)
    return Crop(spec.crop_top, spec.crop_bottom)
