"""Compares networks' steering on real photographs, held out of all training, with that of the human who drove there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_bags.donkey_tub import TubRecord, is_tub, read_tub
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import NOT_SIMULATED
from ds_driver.processes import Progress
from ds_driver.sim2real.generator import Sim2RealError, StoredGenerator, Window, prepare, resize
from ds_driver.sim2real.lane_view import SAMPLE, match_windows, measure_lane
from ds_driver.sim2real.pictures import FEWEST, read_photograph, read_photographs
from ds_driver.sim2real.settings import HELD_OUT
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

GAP = 0.5
"""Time between two frames that belong to one drive, s; chosen: ten frames at 20 Hz."""
BLOCK = 100
"""Largest number of frames that are resampled together; chosen: 5 s at 20 Hz, longer than a bend of a small track."""
SMOOTHED = 0.5
"""Half of the time over which the human's steering is also averaged, s; chosen: humans with a hand controller steer in
jerks, and a second is shorter than a bend."""
RESAMPLES = 1000
"""Bootstrap resamples; chosen: ends of an interval are accurate to about a tenth of its width."""
LEVEL = 0.95
SEED = 1

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Photographed:
    """Photographs of a drive by a human.

    Attributes:
        images: (n, rows, columns, 3) uint8 RGB.
        steering: (n,) the human's, -1 full left to +1 full right.
        smoothed: (n,) the same, averaged over `SMOOTHED` before and after within a block.
        blocks: (n,) number of the block of consecutive frames.
    """

    images: NDArray[np.uint8]
    steering: Array
    smoothed: Array
    blocks: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Value with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How a network's steering agrees with the human's.

    Attributes:
        network: name.
        correlation: with the human's steering.
        smoothed: with the human's smoothed steering.
        beyond_first: correlation minus that of the first network, on the same photographs; None for the first.
        windows: simulator -> correlation with the photographs cropped as for its generator.
    """

    network: str
    correlation: Estimate
    smoothed: Estimate
    beyond_first: Estimate | None
    windows: dict[str, float]


def read_human_drive(source: Path, *, whole: bool = False) -> Photographed:
    """Read the photographs of a tub that training never saw, its last fifth, with the human's steering.

    `whole` reads all of it, for a tub that no training has used.

    Raises:
        Sim2RealError: it is no tub, or has too few photographs with steering, or the human never steered.
        ds_bags.donkey_tub.TubError: the tub is damaged.
    """
    if not is_tub(source):
        raise Sim2RealError(f"{source} is no Donkey Car tub: expected photographs with the steering of a human")
    records = [record for record in read_tub(source).records if record.image is not None]
    if not whole:
        records = records[len(records) - max(1, round(HELD_OUT * len(records))) :]
    records = [record for record in records if record.steering is not None]
    if len(records) < FEWEST:
        raise Sim2RealError(f"{source}: {len(records)} photographs with steering, expected at least {FEWEST}")
    steering = np.array([record.steering for record in records], np.float64)
    if np.ptp(steering) == 0.0:
        raise Sim2RealError(f"{source}: the human's steering is always {steering[0]:g}: nothing to compare with")
    seconds = np.array([record.seconds for record in records])
    blocks = _blocks(seconds)
    return Photographed(
        images=np.stack(list(_images(records))),
        steering=steering,
        smoothed=_smoothed(steering, seconds, blocks),
        blocks=blocks,
    )


def matched_windows(
    generators: Sequence[StoredGenerator], photographed: Photographed, trained_on: Path | None
) -> dict[str, Window]:
    """Return the crop of the photographs for each generator's simulator.

    Give the photographs that the generators were trained on, if those are of another track or camera: the lane is then
    shown as there.

    Raises:
        Sim2RealError: photographs show nothing like a lane, or are of another size than in training.
    """
    windows = {generator.simulator: generator.real_window for generator in generators}
    if trained_on is not None:
        known = measure_lane(read_photographs(trained_on, limit=SAMPLE), "photographs of the training")
        new = measure_lane(photographed.images, "photographs")
        windows = {name: match_windows(known, window, new).real for name, window in windows.items()}
    return windows


def agreements(
    networks: Sequence[str],
    photographed: Photographed,
    windows: dict[str, Window],
    size: tuple[int, int],
    progress: Progress,
) -> list[Agreement]:
    """Correlate networks' steering on photographs with the human's; the mean over the windows is a network's steering.

    Blocks of consecutive frames are resampled together, as neighbours are alike.

    Each network sees the photographs as they are, whatever it was trained on, cropped by `windows`, of each simulator,
    and reduced to `size`, the generators' rows and columns, as in driving.
    """
    answers: dict[str, dict[str, Array]] = {}
    for index, network in enumerate(networks):
        driver = NetworkDriver(network)
        answers[network] = {}
        for done, (name, window) in enumerate(windows.items(), start=1):
            seen = (resize(prepare(image, window, size), (IMAGE_HEIGHT, IMAGE_WIDTH)) for image in photographed.images)
            answers[network][name] = np.array([driver.steering(image, Crop(), NOT_SIMULATED) for image in seen])
            progress(index * len(windows) + done, len(networks) * len(windows), f"{network}, cropped as for {name}")
    samples = _resamples(photographed.blocks)
    found: list[Agreement] = []
    first: tuple[float, Array] | None = None
    for network, by_window in answers.items():
        steering = np.mean(list(by_window.values()), axis=0)
        plain, smoothed = (
            _correlations(steering, human, samples) for human in (photographed.steering, photographed.smoothed)
        )
        beyond = None if first is None else _estimate(plain[0] - first[0], plain[1] - first[1])
        first = first or plain
        found.append(
            Agreement(
                network=network,
                correlation=_estimate(*plain),
                smoothed=_estimate(*smoothed),
                beyond_first=beyond,
                windows={name: _correlation(values, photographed.steering) for name, values in by_window.items()},
            )
        )
    return found


def _images(records: Iterable[TubRecord]) -> Iterable[NDArray[np.uint8]]:
    first: NDArray[np.uint8] | None = None
    for record in records:
        assert record.image is not None
        image = read_photograph(record.image)
        first = image if first is None else first
        if image.shape != first.shape:
            raise Sim2RealError(f"{record.image}: photographs of several sizes, expected one")
        yield image


def _blocks(seconds: Array) -> NDArray[np.int64]:
    """Number the blocks: a new one begins after a gap, and after `BLOCK` frames."""
    blocks, length = np.zeros(len(seconds), np.int64), 1
    for i in range(1, len(seconds)):
        begins = not 0.0 <= seconds[i] - seconds[i - 1] <= GAP or length == BLOCK
        blocks[i], length = blocks[i - 1] + begins, 1 if begins else length + 1
    return blocks


def _smoothed(steering: Array, seconds: Array, blocks: NDArray[np.int64]) -> Array:
    near = (np.abs(seconds[:, None] - seconds) <= SMOOTHED) & (blocks[:, None] == blocks)
    return np.asarray((near @ steering) / near.sum(axis=1), np.float64)


def _resamples(blocks: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    rng = np.random.default_rng(SEED)
    members = [np.flatnonzero(blocks == block) for block in range(int(blocks[-1]) + 1)]
    return [
        np.concatenate([members[i] for i in rng.integers(len(members), size=len(members))]) for _ in range(RESAMPLES)
    ]


def _correlations(answered: Array, human: Array, samples: Sequence[NDArray[np.int64]]) -> tuple[float, Array]:
    return _correlation(answered, human), np.array([_correlation(answered[i], human[i]) for i in samples])


def _correlation(answered: Array, human: Array) -> float:
    """Pearson's r; 0 where one of both never changes, as such a network follows nothing."""
    x, y = answered - answered.mean(), human - human.mean()
    spread = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / spread if spread > 0.0 else 0.0


def _estimate(value: float, resampled: Array) -> Estimate:
    low, high = np.quantile(resampled, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Estimate(value=value, low=float(low), high=float(high))
