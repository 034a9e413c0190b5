# SPDX-License-Identifier: Apache-2.0
"""Prepares both domains of a training (paper 4.1.2): simulated frames, photographs, crops that show the lane alike."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_bags.donkey_tub import is_tub, read_tub
from ds_base.bounded_file import open_regular
from ds_base.folder_files import enter_folder, whole_file, write_json
from ds_base.processes import map_in_processes
from ds_base.progress import Progress, counted, logger_of
from ds_driver.closed_loop.simulation import make_driver
from ds_driver.data.collection import roads_both_ways
from ds_driver.data.dataset import road_ids
from ds_driver.data.recordings import Reading, open_recording
from ds_driver.networks.driver_name import AUTOPILOT
from ds_driver.networks.images import ImageError, read_rgb
from ds_driver.sim2real.generator import Sim2RealError, Window, generator_input, resize
from ds_driver.sim2real.lane_pairs import LanePairs, align_lane, pair_lanes
from ds_driver.sim2real.lane_view import BOUND, LEAST_KEPT, LanePosition, Match, evenly, match_windows, measure_lane
from ds_driver.sim2real.settings import FEWEST, HELD_OUT, Sim2RealSettings
from ds_road import Road
from ds_sim.registry import SimulatorName, simulator_of_process, spec_of
from ds_sim.simulator import Outcome, SimulatorSpec

Images = NDArray[np.uint8]
"""(n, rows, columns, 3) uint8 RGB."""
LOG = logger_of(__name__)
FRAMES = "simulated.npz"
CARD = "sim2real.json"
SHOWN = 4
"""Pictures of each domain on a sheet."""
SUFFIXES = (".jpg", ".jpeg", ".png")
LARGEST_WIDTH = 640
"""Columns to which larger photographs are reduced; chosen: twice what the largest generator sees."""


@dataclass(frozen=True, kw_only=True)
class Domains:
    """Images of both domains, of the generators' size, and what their user should know."""

    simulated: Images
    real: Images
    pairs: LanePairs  # of each simulated image, the real ones to draw from, and where both show the lines
    shown_simulated: Images  # held-out ones for the sheets, as `shown_real`
    shown_real: Images
    simulator: str
    match: Match
    warnings: tuple[str, ...] = ()

    def pair(self, simulated: int, real: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return a simulated image and a real one, aligned to it."""
        shown, wanted = self.pairs.photographed_lanes[real], self.pairs.simulated_lanes[simulated]
        return self.simulated[simulated], align_lane(self.real[real], shown, wanted)


def make_domains(
    simulator: SimulatorName,
    photographs: Path,
    out: Path,
    settings: Sim2RealSettings,
    progress: Progress,
    *,
    data_sets: Iterable[Path] = (),
) -> Domains:
    """Read photographs, drive for simulated images, crop both so that they show the lane alike, and pair them.

    The folder `out`, created if missing, keeps the simulated images, and gets the card `sim2real.json`. Roads of
    `data_sets` must not be used. Lines to the logger say how both are cropped.

    Raises:
        Sim2RealError: photographs or settings cannot be used, or too few images show the lane.
        ds_bags.layout.BagError: the tub or bag is damaged.
    """
    window = network_window(spec_of(simulator))
    check_roads_are_new(settings, data_sets)
    real = read_photographs(photographs, settings.photographs)
    # Before the drives, which take minutes.
    real_view = measure_lane(real, "photographs")
    enter_folder(out)
    simulated, held_out_simulated = simulated_frames(simulator, settings, out / FRAMES, progress)
    view = measure_lane(simulated, f"images of {simulator}")
    match = match_windows(view, window, real_view)
    positions = view.seen_through(match.simulated), real_view.seen_through(match.real)
    for name, window, position in zip(
        (simulator, "photographs"), (match.simulated, match.real), positions, strict=True
    ):
        LOG.info("%s: cropped to %s; %s", name, window, position)
    real, held_out_real = split(real)

    def small(images: Images, most: int, window: Window) -> Images:
        return np.stack([generator_input(images[i], window, settings.shape.size) for i in evenly(len(images), most)])

    images, small_real = small(simulated, settings.images, match.simulated), small(real, len(real), match.real)
    pairs = pair_lanes(images, small_real)
    domains = Domains(
        simulated=images[pairs.simulated],
        real=small_real,
        pairs=pairs,
        shown_simulated=small(held_out_simulated, SHOWN, match.simulated),
        shown_real=small(held_out_real, SHOWN, match.real),
        simulator=simulator,
        match=match,
        warnings=tuple(_warnings(match, positions, pairs)),
    )
    lane = {
        name: {"share_of_images": round(one.share, 4), **{k: round(v, 4) for k, v in asdict(position).items()}}
        for name, one, position in zip(("simulated", "real"), (view, real_view), positions, strict=True)
    }
    card = {
        "simulator": simulator,
        "photographs": photographs.resolve().name,
        "settings": asdict(settings),
        "images": {"simulated": len(domains.simulated), "real": len(domains.real)},
        "crop": {"simulated": asdict(match.simulated), "real": asdict(match.real), "kept": round(match.kept, 4)},
        "lane": lane,
        "difference": round(match.difference, 4),
        "pairs": {"photographs_used": len(np.unique(pairs.photographs)), "lines_apart": round(pairs.apart, 4)},
    }
    write_json(out / CARD, card)
    return domains


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Deprecated, goes in 0.5: `Domains` that `read_sources` made."""

    domains: Domains

    @property
    def match(self) -> Match:
        """Crops that show the lane alike."""
        return self.domains.match


def read_sources(
    simulator: SimulatorName,
    source: Path,
    out: Path,
    settings: Sim2RealSettings,
    progress: Progress,
    *,
    data_sets: Iterable[Path] = (),
) -> Sources:
    """Deprecated, goes in 0.5: `make_domains`."""
    warnings.warn("read_sources goes in 0.5: use make_domains", DeprecationWarning, stacklevel=2)
    return Sources(domains=make_domains(simulator, source, out, settings, progress, data_sets=data_sets))


def prepare_domains(sources: Sources, source: Path, out: Path) -> tuple[Domains, tuple[str, ...]]:
    """Deprecated, goes in 0.5: the domains that `read_sources` made, and warnings for their user."""
    warnings.warn("prepare_domains goes in 0.5: use make_domains", DeprecationWarning, stacklevel=2)
    return sources.domains, sources.domains.warnings


def network_window(spec: SimulatorSpec) -> Window:
    """Return the part of a simulator's images that networks see."""
    return Window(spec.crop_top, spec.camera.height_px - spec.crop_bottom, 0, spec.camera.width)


def _warnings(match: Match, positions: tuple[LanePosition, LanePosition], pairs: LanePairs) -> Iterator[str]:
    if match.difference > BOUND:
        yield (
            f"lines differ by {match.difference:.2f} of the picture's width between simulated images ({positions[0]}) "
            f"and photographs ({positions[1]}), expected at most {BOUND:g}: the generator will move lines; take "
            "photographs from the right lane, with the camera mounted alike"
        )
    if match.kept < LEAST_KEPT:
        yield (
            f"the photographs show {match.kept:.0%} of what the simulator shows, expected at least {LEAST_KEPT:.0%}: "
            "networks will see little of the road"
        )
    if pairs.warning is not None:
        yield pairs.warning


def sim2real_roads(settings: Sim2RealSettings) -> tuple[Road, ...]:
    """Generate the roads of all drives: each road forwards, then backwards."""
    roads = roads_both_ways(settings.roads, settings.road_seed)
    return tuple(way for road in roads for way in (road, road.reversed()))


def check_roads_are_new(settings: Sim2RealSettings, data_sets: Iterable[Path]) -> None:
    """Refuse, by a Sim2RealError, roads that are in a data set, too."""
    ids = {road.road_id for road in sim2real_roads(settings)}
    for folder in data_sets:
        if used := ids & road_ids(folder):
            raise Sim2RealError(
                f"{len(used)} of the roads are in {folder}, too, expected new ones: collect it with another --seed"
            )


def simulated_frames(
    simulator: SimulatorName, settings: Sim2RealSettings, file: Path, progress: Progress
) -> tuple[Images, Images]:
    """Drive the roads, or read the `.npz` of an earlier call; return images for training, and of held-out roads."""
    relevant = {name: getattr(settings, name) for name in ("roads", "seed", "road_seed", "every", "longest")}
    identity = json.dumps({"simulator": simulator, **relevant})
    roads = sim2real_roads(settings)
    if file.exists():
        images, numbers = _read(file, identity)
    else:
        drives, work = [], partial(_drive, simulator, settings, roads)
        progress.start(len(roads))
        for drive in map_in_processes(work, range(len(roads)), workers=settings.threads):
            drives.append(drive)
            progress.advance(line=f"{simulator}: {len(drive)} images")
        images = np.concatenate(drives)
        numbers = np.repeat(np.arange(len(drives), dtype=np.int32), list(map(len, drives)))
        with whole_file(file) as unfinished, unfinished.open("wb") as stream:
            np.savez(stream, images=images, drives=numbers, identity=np.array(identity))
    held_out = numbers >= len(roads) - 2 * max(1, round(HELD_OUT * len(roads) / 2))  # each is driven both ways
    return images[~held_out], images[held_out]


def _read(file: Path, identity: str) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    try:
        with open_regular(file) as content, np.load(content, allow_pickle=False) as stored:
            identity_there = str(stored["identity"])
            images, drives = stored["images"], stored["drives"]
            if drives.shape != images.shape[:1] or drives.dtype != np.int32 or images.dtype != np.uint8:
                raise ValueError("its arrays do not belong together")
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        raise Sim2RealError(f"{file} cannot be read ({type(error).__name__}): delete it and train again") from None
    if identity_there != identity:
        raise Sim2RealError(f"{file} has other simulated drives: choose another --out, or delete the folder")
    return images, drives


def _drive(name: str, settings: Sim2RealSettings, roads: tuple[Road, ...], index: int) -> NDArray[np.uint8]:
    simulator, longest = simulator_of_process(name), settings.longest
    driver = make_driver(AUTOPILOT, simulator.spec)
    seed = int(np.random.default_rng([settings.seed, index]).integers(2**31))
    observation = simulator.load(roads[index], seed=seed)
    images = []
    while observation.outcome is Outcome.RUNNING and (longest is None or observation.step < longest):
        if observation.step % settings.every == 0:
            images.append(observation.image.copy())
        observation = simulator.step(driver(observation))
    return np.array(images)


def read_photographs(source: Path, limit: int) -> NDArray[np.uint8]:
    """Read photographs in their order, files in that of their names, evenly chosen if there are more than `limit`."""
    images: list[NDArray[np.uint8]] = []
    for name, image in _read_images(source, limit):
        if image.shape[1] > LARGEST_WIDTH:
            image = resize(image, (round(image.shape[0] * LARGEST_WIDTH / image.shape[1]), LARGEST_WIDTH))
        if images and image.shape != images[0].shape:
            sizes = " and ".join(f"{shape[1]} x {shape[0]}" for shape in (images[0].shape, image.shape))
            raise Sim2RealError(f"{name}: photographs of {sizes} px, expected one size: sort them into folders by size")
        images.append(image)
    if len(images) < FEWEST:
        count = {0: "no photographs", 1: "one photograph"}.get(len(images), f"{len(images)} photographs")
        raise Sim2RealError(f"{source}: {count}, expected at least {FEWEST}: JPEG or PNG files, a tub, or a bag")
    return np.stack(images)


def split(photographs: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Split photographs into those for training and the last fifth, which is held out."""
    first = len(photographs) - max(1, round(HELD_OUT * len(photographs)))
    return photographs[:first], photographs[first:]


def _read_images(source: Path, limit: int) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Read images with the name of each; see `read_photographs`."""
    if not source.exists():
        raise Sim2RealError(f"{source} does not exist: expected a tub, a bag, or a folder of photographs")
    if is_tub(source):
        files = [file for _, file in read_tub(source).pictures]
    elif (source / "metadata.yaml").exists() or source.suffix in (".bag", ".mcap", ".db3"):
        recording = open_recording(source, Reading())
        wanted = set(evenly(sum(1 for _ in recording.frames()), limit))
        for number, frame in enumerate(recording.frames()):  # twice, as all images at once fill the memory
            if number not in wanted:
                continue
            if frame.image is None:
                raise Sim2RealError(f"{frame.trouble}: remove that image, or record it again")
            yield f"{source}, image {frame.index}", frame.image
        return
    elif not source.is_dir():
        raise Sim2RealError(f"{source} is a file: expected a tub, a bag, or a folder of photographs")
    else:
        files = sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    yield from (_decoded(files[i]) for i in counted(evenly(len(files), limit), str(source)))


def _decoded(file: Path) -> tuple[str, NDArray[np.uint8]]:
    try:
        return str(file), read_rgb(file)
    except ImageError as error:
        raise Sim2RealError(f"{file}: {error}: remove that file, or copy it again") from None
