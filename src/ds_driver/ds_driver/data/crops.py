"""What a network need not see of each part of a data set."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ds_driver.data.dataset import imported_names
from ds_driver.networks.preprocessing import Crop
from ds_sim.registry import spec_of


def crops_of(data: Path, names: Iterable[str]) -> dict[str, Crop]:
    """Rows to cut off for each name in a data set: the simulator's own, none of a recording, which is whole.

    Args:
        data: folder of the data set.
        names: that its samples have as simulator.

    Raises:
        ds_sim.registry.UnknownSimulatorError: a name is neither a simulator's nor a recording's.
    """
    recorded = imported_names(data)
    return {name: Crop() if name in recorded else simulator_crop(name) for name in sorted(set(names))}


def simulator_crop(name: str) -> Crop:
    """What a network need not see on a simulator."""
    spec = spec_of(name)
    return Crop(spec.crop_top, spec.crop_bottom)
