"""Assesses checkpoints of a training by numbers on held-out frames: lane, steering, distance, flicker; chooses one.

The bounds of a generator that may be shipped, and the rule by which one is chosen, were fixed before any result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import NOT_SIMULATED
from ds_driver.processes import Progress
from ds_driver.sim2real.evaluation.image_distance import (
    PUBLIC_NETWORK,
    driving_features,
    has_public_network,
    kernel_distance,
    public_features,
)
from ds_driver.sim2real.evaluation.lane_kept import LineProjector, Truth, lane_kept, lines_of_photographs
from ds_driver.sim2real.generator import Sim2RealError, Window, load_generator, prepare, resize
from ds_driver.sim2real.pictures import evenly
from ds_driver.sim2real.simulated_frames import SimulatedFrames
from ds_driver.sim2real.trainer import EPOCHS
from ds_driver.sim2real.translator import Translator, generator_to_onnx
from ds_driver.whole_files import write_json, write_whole
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.registry import label_of, spec_of

MAX_SHIFT = 0.0125
"""Largest median shift of the lane's lines beyond that of untranslated images, in widths of the image; chosen: 2 px of
160, some 8 cm on the road beside the car, a hundredth of the road and what an autopilot deviates on a straight."""
MAX_SHIFT_95 = 0.03
"""The same for the 95th percentile; chosen: 5 px of 160, 20 cm, a tenth of the distance at which a car is out of
bounds."""
LEAST_FOUND = 0.8
"""Least share of the rows with a line, as a share of that in held-out photographs, with dashes and wear; chosen: a
fifth less than in reality. A first version asked for 0.8 of what the simulator shows, which photographs themselves do
not have (0.74): replaced before the generators that it now judges were trained."""
LEAST_OVERLAP = 0.5
"""Least overlap with the truth, as a share of that of untranslated images times the share of rows with lines in
photographs; chosen: a line of twice the width, as the tape on real tracks is, halves it."""
MAX_FLICKER = 6.0
"""Largest flicker beyond that of untranslated images, grey levels; chosen: the noise of a poor camera."""
ASSESSMENT = "assessment.json"
PLAIN = "untranslated"
PHOTOGRAPHS = "lines_of_photographs"
FRAMES = 200
"""Held-out frames, and photographs, that are looked at; chosen: shares are then known within 4 %, in minutes."""
STILL = 4
"""Grey levels by which a pixel of a simulated image changes at most from one frame to the next to count as still."""


def broken_bounds(
    checkpoint: Mapping[str, Any], plain: Mapping[str, Any], photographs: Mapping[str, float], columns: int
) -> list[str]:
    """Name the bounds that a checkpoint's entry of an assessment breaks.

    `plain` is the entry of the untranslated images, `photographs` comes from `lines_of_photographs`, and `columns` are
    those of the images.
    """
    kept, before = checkpoint["lane"], plain["lane"]
    both = (photographs["yellow"] + photographs["white"]) / 2
    checks = (
        (kept["shift"] - before["shift"], MAX_SHIFT * columns, "lines are shifted by {0:.1f} px more"),
        (
            kept["shift_95"] - before["shift_95"],
            MAX_SHIFT_95 * columns,
            "one line in twenty is shifted by {0:.1f} px more",
        ),
        *(
            (
                -kept[f"found_{line}"],
                -LEAST_FOUND * min(photographs[line], before[f"found_{line}"]),
                f"the {line} line is found in {{1:.0%}} of its rows",
            )
            for line in ("yellow", "white")
        ),
        (-kept["overlap"], -LEAST_OVERLAP * before["overlap"] * both, "lines overlap the truth by {1:.0%}"),
        (checkpoint["flicker"] - plain["flicker"], MAX_FLICKER, "still pixels flicker by {0:.1f} grey levels more"),
    )
    return [f"{text.format(value, -value)} (bound {abs(bound):.2g})" for value, bound, text in checks if value > bound]


def choose(checkpoints: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Choose a checkpoint: of those that break no bound, the one nearest to the photographs; None if there is none.

    The distance is that of the public network's features where it was computed, else Dave-2's; the earlier wins a tie.
    """
    within = [name for name in sorted(checkpoints) if not checkpoints[name]["broken"]]

    def distance(name: str) -> float:
        found = checkpoints[name]["distance"]
        return float(found[next(iter(found))]["value"])

    return min(within, key=distance, default=None)


class HeldOut:
    """Held-out frames, with the truth about their lines, and photographs, prepared, (n, rows, columns, 3) uint8 RGB."""

    def __init__(self, simulator: str, frames: SimulatedFrames, photographs: NDArray[np.uint8], window: Window) -> None:
        size = (photographs.shape[1], photographs.shape[2])
        pairs = frames.pairs()
        if len(pairs) < 2 or len(photographs) < 2:
            raise Sim2RealError("too few held-out frames to assess a generator: train with more roads and photographs")
        chosen = pairs[evenly(len(pairs), FRAMES)]
        spec = spec_of(simulator)
        projectors = {
            drive: LineProjector(frames.roads[drive], spec.camera, spec.look.line_width)
            for drive in map(int, np.unique(frames.drives[chosen]))
        }
        self.images = [prepare(frames.images[i], window, size) for i in chosen]
        self.next_images = [prepare(frames.images[i + 1], window, size) for i in chosen]
        self.truths: list[Truth] = [
            projectors[int(frames.drives[i])].masks(frames.state(int(i)), window, size) for i in chosen
        ]
        self.photographs = photographs[evenly(len(photographs), FRAMES)]


class Assessor:
    """Computes the numbers of a set of images; what does not depend on a generator is computed once."""

    def __init__(self, held_out: HeldOut, driver: str) -> None:
        self._held_out = held_out
        self._driver = NetworkDriver(driver)
        self._features: dict[str, Callable[[NDArray[np.uint8]], NDArray[np.float32]]] = {}
        if has_public_network():
            self._features[PUBLIC_NETWORK] = public_features
        self._features["dave2"] = driving_features
        self._real = {name: compute(held_out.photographs) for name, compute in self._features.items()}
        self._steering = self._steer(held_out.images)

    def assess(self, translate: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> dict[str, Any]:
        """Assess a translation of prepared images; the identity assesses the untranslated ones."""
        held_out = self._held_out
        images = [translate(image) for image in held_out.images]
        following = [translate(image) for image in held_out.next_images]
        change = np.abs(self._steer(images) - self._steering)
        stack = np.stack(images)
        return {
            "lane": _rounded(asdict(lane_kept(images, held_out.truths))),
            "steering_change": _rounded({"mean": float(change.mean()), "p95": float(np.quantile(change, 0.95))}),
            "distance": {
                name: _rounded(asdict(kernel_distance(compute(stack), self._real[name])))
                for name, compute in self._features.items()
            },
            "flicker": round(flicker(held_out.images, held_out.next_images, images, following), 6),
        }

    def _steer(self, images: list[NDArray[np.uint8]]) -> NDArray[np.float64]:
        whole = (resize(image, (IMAGE_HEIGHT, IMAGE_WIDTH)) for image in images)
        return np.array([self._driver.steering(image, Crop(), NOT_SIMULATED) for image in whole])


def flicker(
    before: list[NDArray[np.uint8]],
    after: list[NDArray[np.uint8]],
    translated_before: list[NDArray[np.uint8]],
    translated_after: list[NDArray[np.uint8]],
) -> float:
    """Mean change, in grey levels, of the translation of pixels that hardly change from one frame to the next."""
    total = count = 0
    for a, b, x, y in zip(before, after, translated_before, translated_after, strict=True):
        still = np.abs(a.astype(int) - b).max(axis=2) <= STILL
        total += int(np.abs(x.astype(int) - y)[still].sum())
        count += int(still.sum()) * 3
    return total / count if count else 0.0


def assess_checkpoints(folder: Path, held_out: HeldOut, driver: str, progress: Progress) -> dict[str, Any]:
    """Assess every checkpoint of a training, choose one, and return what is written to `assessment.json`.

    Raises:
        Sim2RealError: there is no checkpoint, or one is damaged.
    """
    files = sorted((folder / EPOCHS).glob("epoch_*.safetensors"))
    if not files:
        raise Sim2RealError(f"{folder} has no checkpoint yet: train at least one epoch")
    assessor = Assessor(held_out, driver)
    plain = assessor.assess(lambda image: image)
    seen = _rounded(lines_of_photographs(held_out.photographs))
    found: dict[str, dict[str, Any]] = {}
    columns = held_out.images[0].shape[1]
    for done, file in enumerate(files, start=1):
        translator = Translator(load_generator(file))
        numbers = assessor.assess(translator.small)
        found[file.stem] = numbers | {"broken": broken_bounds(numbers, plain, seen, columns)}
        progress(done, len(files), f"{file.stem}: " + ("; ".join(found[file.stem]["broken"]) or "within all bounds"))
    document = {
        "frames": len(held_out.images),
        "photographs": len(held_out.photographs),
        "driver": driver,
        PHOTOGRAPHS: seen,
        PLAIN: plain,
        "checkpoints": found,
        "chosen": choose(found),
    }
    write_json(folder / ASSESSMENT, document)
    return document


def ship(folder: Path, assessment: dict[str, Any], card: dict[str, Any], out: Path) -> list[Path]:
    """Write the chosen generator with its card and its ONNX file; return the files.

    Raises:
        Sim2RealError: no checkpoint is within the bounds.
    """
    chosen = assessment["chosen"]
    if chosen is None:
        last = max(assessment["checkpoints"])
        reason = "; ".join(assessment["checkpoints"][last]["broken"])
        raise Sim2RealError(
            f"no generator in {folder} may be shipped: {last}: {reason}: train longer, or match the crops"
        )
    generator = load_generator(folder / EPOCHS / f"{chosen}.safetensors")
    stem = label_of(generator.simulator)
    document = card | {"checkpoint": chosen, "sha256": generator.sha256, "assessment": assessment}
    write_whole(out / f"{stem}.safetensors", generator.content)
    write_whole(out / f"{stem}.onnx", generator_to_onnx(generator))
    write_json(out / f"{stem}.json", document)
    return [out / f"{stem}.{suffix}" for suffix in ("safetensors", "onnx", "json")]


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}
