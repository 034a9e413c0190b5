"""Assesses the checkpoints of a training by numbers on held-out frames: lane, steering, distance, flicker."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import NOT_SIMULATED
from ds_driver.sim2real.evaluation.choice import broken_bounds, choose
from ds_driver.sim2real.evaluation.features import PUBLIC_NETWORK, driving_features, has_public_network, public_features
from ds_driver.sim2real.evaluation.kernel_distance import kernel_distance
from ds_driver.sim2real.evaluation.lane_kept import Truth, lane_kept, lines_of_photographs
from ds_driver.sim2real.evaluation.line_truth import LineProjector
from ds_driver.sim2real.generator_file import StoredGenerator, load_generator
from ds_driver.sim2real.generator_onnx import generator_to_onnx
from ds_driver.sim2real.simulated_frames import SimulatedFrames
from ds_driver.sim2real.trainer import EPOCHS
from ds_driver.sim2real.translator import Translator
from ds_driver.sim2real.window import Sim2RealError, Window, prepare, resize
from ds_driver.whole_files import write_whole
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.registry import label_of, spec_of

ASSESSMENT = "assessment.json"
PLAIN = "untranslated"
PHOTOGRAPHS = "lines_of_photographs"
FRAMES = 200
"""Held-out frames, and photographs, that are looked at; chosen: shares are then known within 4 %, in minutes."""
STILL = 4
"""Grey levels by which a pixel of a simulated image changes at most from one frame to the next to count as still."""


class HeldOut:
    """Held-out frames of a simulator, with the truth about their lines, and held-out photographs.

    Args:
        simulator: name of the simulator.
        frames: simulated frames.
        photographs: held-out photographs, prepared, (n, rows, columns, 3) uint8 RGB.
        window: part of the simulated images that generators see.
    """

    def __init__(self, simulator: str, frames: SimulatedFrames, photographs: NDArray[np.uint8], window: Window) -> None:
        size = (photographs.shape[1], photographs.shape[2])
        pairs = frames.pairs()
        if len(pairs) < 2 or len(photographs) < 2:
            raise Sim2RealError("too few held-out frames to assess a generator: train with more roads and photographs")
        chosen = pairs[np.unique(np.linspace(0, len(pairs) - 1, min(FRAMES, len(pairs))).round().astype(int))]
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
        even = np.unique(np.linspace(0, len(photographs) - 1, min(FRAMES, len(photographs))).round().astype(int))
        self.photographs = photographs[even]


class Assessor:
    """Computes the numbers of a set of images; what does not depend on a generator is computed once.

    Args:
        held_out: frames and photographs.
        driver: name of the frozen network.
    """

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


def assess_checkpoints(
    folder: Path, held_out: HeldOut, driver: str, progress: Callable[[int, int, str], None]
) -> dict[str, Any]:
    """Assess every checkpoint of a training, write `assessment.json`, and choose one.

    Args:
        folder: folder of the training.
        held_out: frames and photographs that training did not see.
        driver: name of the frozen network whose steering is compared.
        progress: called after each checkpoint.

    Returns:
        Content of the file: numbers of the untranslated images and of each checkpoint, and the one chosen.

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
    write_whole(folder / ASSESSMENT, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    return document


def ship(folder: Path, assessment: dict[str, Any], card: dict[str, Any], out: Path) -> list[Path]:
    """Write the chosen generator with its card and its ONNX file.

    Args:
        folder: folder of the training.
        assessment: of `assess_checkpoints`.
        card: of the training.
        out: folder to write to, created if missing.

    Returns:
        Files written.

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
    source = folder / EPOCHS / f"{chosen}.safetensors"
    generator: StoredGenerator = load_generator(source)
    out.mkdir(parents=True, exist_ok=True)
    stem = label_of(generator.simulator)
    document = card | {"checkpoint": chosen, "sha256": generator.sha256, "assessment": assessment}
    contents = {
        f"{stem}.safetensors": source.read_bytes(),
        f"{stem}.onnx": generator_to_onnx(generator),
        f"{stem}.json": (json.dumps(document, indent=1, allow_nan=False) + "\n").encode(),
    }
    for name, content in contents.items():
        write_whole(out / name, content)
    return [out / name for name in contents]


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}
