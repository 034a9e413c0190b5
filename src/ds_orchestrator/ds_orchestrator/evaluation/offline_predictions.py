"""What a network would steer on the images of a data set, against what the autopilot did steer there (paper 4.2.3)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_driver.closed_loop.simulation import AUTOPILOT
from ds_orchestrator.evaluation.offline_errors import ErrorsError

REPORT_EVERY = 500
"""Images between two lines of progress; chosen: some seconds."""


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """One simulator's images.

    Attributes:
        labels: (n,) the autopilot's steering in [-1, 1].
        steering: (n,) the network's, not clipped, as in the authors' package.
    """

    labels: NDArray[np.float64]
    steering: NDArray[np.float64]

    @property
    def errors(self) -> NDArray[np.float64]:
        """(n,) absolute differences."""
        return np.abs(self.steering - self.labels)


def predict(
    data: Path,
    network: str,
    progress: Callable[[int, int, str], None],
    *,
    images: int | None = None,
    trusted: Collection[str] = (),
) -> dict[str, Predictions]:
    """Run a network over a data set, one image at a time as when it drives.

    Args:
        data: folder of the data set; see `ds_driver.data.dataset`.
        network: any name that `ds_driver.networks.network_driver.NetworkDriver` takes.
        progress: told images done, images in all, and the simulator.
        images: at most so many of each simulator, evenly spread over its drives; all if left out.
        trusted: simulators of the user's own that the data set may name.

    Returns:
        Simulator -> its predictions, in the order of the data set.

    Raises:
        ErrorsError: the autopilot is no network.
        ds_driver.data.dataset.DatasetError: the data set cannot be used.
        ValueError: the network cannot be used.
    """
    from ds_driver.data.crops import crops_of
    from ds_driver.data.dataset import Sample, decode, read_samples
    from ds_driver.networks.network_driver import load_pilot
    from ds_driver.networks.pilot import Frame

    if network == AUTOPILOT:
        raise ErrorsError("the autopilot made the labels: name a network, such as dave2")
    pilot = load_pilot(network)
    groups: dict[str, list[Sample]] = {}
    for sample in read_samples(data):
        groups.setdefault(sample.simulator, []).append(sample)
    if images is not None:
        groups = {name: _spread(group, images) for name, group in groups.items()}
    total, done = sum(map(len, groups.values())), 0
    found, crops = {}, crops_of(data, groups, trusted=trusted)
    for name, group in groups.items():
        steering = np.empty(len(group))
        for index, sample in enumerate(group):
            if index == 0 or sample.road_id != group[index - 1].road_id:
                pilot.start()
            steering[index] = pilot.predict(Frame(image=decode(sample.jpeg), speed=0.0, crop=crops[name])).steering
            done += 1
            if done % REPORT_EVERY == 0 or done == total:
                progress(done, total, f"images, {name}")
        found[name] = Predictions(labels=np.array([s.steering for s in group]), steering=steering)
    return found


def _spread(group: list, images: int) -> list:  # type: ignore[type-arg]
    """So many of a list, evenly spread."""
    if len(group) <= images:
        return group
    return [group[i] for i in np.linspace(0, len(group) - 1, images).round().astype(int)]


def architecture_of(network: str) -> str:
    """The architecture of a shipped network or a weights file, "" if it has none."""
    from ds_driver.networks.backends import split_backend
    from ds_driver.networks.weights import architecture_in, shipped_networks

    network = split_backend(network)[0]
    return architecture_in(shipped_networks().get(network, Path(network)))
