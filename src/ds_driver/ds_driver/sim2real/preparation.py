# SPDX-License-Identifier: Apache-2.0
"""Prepares both domains of a training: frames, photographs, and the crops that show the lane alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_base.atomic_files import write_json
from ds_base.folder_files import enter_folder
from ds_base.progress import Progress
from ds_driver.sim2real.generator import Window, generator_input
from ds_driver.sim2real.lane_pairs import LanePairs, pair_lanes
from ds_driver.sim2real.lane_view import BOUND, LEAST_KEPT, LaneView, Match, match_windows, measure_lane
from ds_driver.sim2real.pictures import evenly, read_photographs, split
from ds_driver.sim2real.settings import Sim2RealSettings
from ds_driver.sim2real.simulated_frames import SimulatedFrames, check_roads_are_new, simulated_frames
from ds_driver.sim2real.trainer import SHOWN, Domains
from ds_sim.registry import SimulatorName, spec_of
from ds_sim.simulator import SimulatorSpec

FRAMES = "simulated.npz"
CARD = "sim2real.json"


@dataclass(frozen=True, kw_only=True)
class Sources:
    """What both domains are made of: whole images, where they show the lane, simulated and real, and the crops."""

    simulator: SimulatorName
    settings: Sim2RealSettings
    frames: SimulatedFrames
    photographs: NDArray[np.uint8]
    held_out_photographs: NDArray[np.uint8]
    views: tuple[LaneView, LaneView]
    match: Match


def read_sources(
    simulator: SimulatorName,
    source: Path,
    out: Path,
    settings: Sim2RealSettings,
    progress: Progress,
    *,
    data_sets: Sequence[Path] = (),
) -> Sources:
    """Read photographs, drive for simulated images, and find the crops that show the lane alike.

    The folder `out`, created if missing, keeps the simulated images. Roads of `data_sets` must not be used.

    Raises:
        Sim2RealError: photographs or settings cannot be used.
        ds_bags.layout.BagError: the tub or bag is damaged.
    """
    spec = spec_of(simulator)
    check_roads_are_new(settings, data_sets)
    photographs = read_photographs(source, settings.photographs)
    # Before the drives, which take minutes.
    real = measure_lane(photographs, "photographs")
    enter_folder(out)
    frames = simulated_frames(simulator, settings, out / FRAMES, progress)
    simulated = measure_lane(frames.images[~frames.held_out], f"images of {simulator}")
    match = match_windows(simulated, network_window(spec), real)
    training, held_out = split(photographs)
    return Sources(
        simulator=simulator,
        settings=settings,
        frames=frames,
        photographs=training,
        held_out_photographs=held_out,
        views=(simulated, real),
        match=match,
    )


def prepare_domains(sources: Sources, source: Path, out: Path) -> tuple[Domains, tuple[str, ...]]:
    """Crop and pair the images of both domains, and write the card `sim2real.json`; return warnings for the user, too.

    Raises:
        Sim2RealError: too few images show the lane.
    """
    frames, match, size = sources.frames, sources.match, sources.settings.shape.size
    images = frames.images[~frames.held_out]
    small = _prepared(images[evenly(len(images), sources.settings.images)], match.simulated, size)
    small_real = _prepared(sources.photographs, match.real, size)
    pairs = pair_lanes(small, small_real)
    held_out_frames = np.flatnonzero(frames.held_out)
    shown = frames.images[held_out_frames[evenly(len(held_out_frames), SHOWN)]]
    held_out_real = sources.held_out_photographs
    domains = Domains(
        simulated=small[pairs.simulated],
        real=small_real,
        pairs=pairs,
        shown_simulated=_prepared(shown, match.simulated, size),
        shown_real=_prepared(held_out_real[evenly(len(held_out_real), SHOWN)], match.real, size),
        simulator=sources.simulator,
        window=match.simulated,
        real_window=match.real,
    )
    _write_card(out / CARD, source, sources, domains)
    return domains, _warnings(match, pairs)


def network_window(spec: SimulatorSpec) -> Window:
    """Return the part of a simulator's images that networks see."""
    return Window(spec.crop_top, spec.camera.height_px - spec.crop_bottom, 0, spec.camera.width)


def _warnings(match: Match, pairs: LanePairs) -> tuple[str, ...]:
    warnings = []
    if match.difference > BOUND:
        warnings.append(
            f"lines differ by {match.difference:.2f} of the picture's width between simulated images "
            f"({match.positions[0]}) and photographs ({match.positions[1]}), expected at most {BOUND:g}: the generator "
            "will move lines; take photographs from the right lane, with the camera mounted alike"
        )
    if match.kept < LEAST_KEPT:
        warnings.append(
            f"the photographs show {match.kept:.0%} of what the simulator shows, expected at least {LEAST_KEPT:.0%}: "
            "networks will see little of the road"
        )
    if pairs.warning is not None:
        warnings.append(pairs.warning)
    return tuple(warnings)


def _write_card(path: Path, source: Path, sources: Sources, domains: Domains) -> None:
    match, pairs = sources.match, domains.pairs
    card = {
        "simulator": sources.simulator,
        "photographs": source.resolve().name,
        "settings": asdict(sources.settings),
        "images": {"simulated": len(domains.simulated), "real": len(domains.real)},
        "crop": {"simulated": asdict(match.simulated), "real": asdict(match.real), "kept": round(match.kept, 4)},
        "lane": {
            name: {"share_of_images": round(view.share, 4), **{k: round(v, 4) for k, v in asdict(position).items()}}
            for name, view, position in zip(("simulated", "real"), sources.views, match.positions, strict=True)
        },
        "difference": round(match.difference, 4),
        "pairs": {"photographs_used": len(np.unique(pairs.photographs)), "lines_apart": round(pairs.apart, 4)},
    }
    write_json(path, card)


def _prepared(images: NDArray[np.uint8], window: Window, size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.stack([generator_input(image, window, size) for image in images])
