# SPDX-License-Identifier: Apache-2.0
"""Hybrid training: one network for all simulators, all equally represented (paper 3.2.2, 4.2.2)."""

from __future__ import annotations

import os

from ds_base.errors import InputError

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # large pages make training on a CPU up to twice as fast

import ctypes
import hashlib
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ds_base.bounded_file import open_regular
from ds_base.folder_files import enter_folder, whole_file, write_json
from ds_base.progress import Progress
from ds_driver.data.dataset import (
    DatasetError,
    Sample,
    balance,
    check_equal,
    copy_generators,
    crops_of,
    decode,
    read_samples,
    translated_by,
)
from ds_driver.networks.backends import has_bfloat16
from ds_driver.networks.images import Crop, prepare
from ds_driver.networks.torch_networks import disable_dropout, make_network, module_of, save_weights
from ds_driver.networks.weights import architecture_in, generators_in, load_weights, path_of_weights, weights_sha256

CHECKPOINT = "checkpoint.pt"
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
"""Options of mallopt(3)."""
MAX_SHIFT = (50, 5)
"""Largest shift in columns and rows (maxitwo)."""
STEERING_PER_COLUMN = 0.002
"""Steering added per column of shift: the lane moves right, so the car must steer right (maxitwo)."""


class TrainingError(InputError):
    """Training is not possible with these options on this machine."""


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """Settings of a training.

    Attributes:
        network: name of the architecture.
        seed: of weights, split, order and augmentation.
        epochs: at most; `SCHEDULES` has those of the paper.
        patience: epochs without a lower validation loss after which training stops.
        batch_size: images per batch (paper 4.2.2: 128).
        learning_rate: of Adam (paper 4.2.2: 1e-4).
        validation: share of the roads held out (paper 3.2.2: 20%).
        images_per_simulator: at most; None for all.
        without_dropout: epochs at the end that train without dropout, so that a network drives as it was trained.
        weights_at: steps (batches, over all epochs) after which `<network>_<step>.safetensors` is written, too.
        threads: of PyTorch.
        device: `cpu`, `cuda`, or `auto`, which uses a GPU if there is one.
        start: shipped network or weights file whose weights training begins with; random ones if "".
    """

    network: str = "dave2"
    seed: int = 1
    epochs: int = 12
    patience: int = 10
    batch_size: int = 128
    learning_rate: float = 1e-4
    validation: float = 0.2
    images_per_simulator: int | None = None
    without_dropout: int = 0
    weights_at: tuple[int, ...] = ()
    threads: int = 2
    device: str = "auto"
    start: str = ""


SCHEDULES: dict[str, dict[str, TrainingPlan]] = {
    "laptop": {
        "dave2": TrainingPlan(network="dave2", epochs=2),
        "chauffeur": TrainingPlan(network="chauffeur", epochs=4),
        "epoch": TrainingPlan(network="epoch", epochs=4, without_dropout=1),
    },
    "paper": {
        "dave2": TrainingPlan(network="dave2", epochs=50),
        "chauffeur": TrainingPlan(network="chauffeur", epochs=500, patience=20),
        "epoch": TrainingPlan(network="epoch", epochs=500, patience=20),
    },
}
"""Name -> network -> plan; `paper` (4.2.2, plain images) needs a GPU; `laptop` is chosen, see the model cards."""


@dataclass(frozen=True, kw_only=True)
class Epoch:
    """Losses (mean squared errors) of one epoch."""

    epoch: int
    training_loss: float
    validation_loss: float
    seconds: float


def train(
    data: Path | Sequence[Path],
    out: Path,
    plan: TrainingPlan,
    progress: Progress,
    *,
    trusted: Collection[str] = (),
) -> list[Epoch]:
    """Train a network, or resume after the last complete epoch; return the losses of all epochs.

    Several folders are one data set, as new drives beside those that a network was trained on. The folder `out`,
    created if missing, gets `<network>.safetensors` (best epoch), the checkpoint, and at the end `training.json`; and
    for a translated data set its generators in `sim2real`, where the network looks for them. The data set may name
    `trusted` simulators outside the project.

    Raises:
        DatasetError: the data set cannot be used.
        TrainingError: the folder holds another training, or the device is not available.
        ds_sim.registry.UnknownSimulatorError: part of the data set comes from an unknown simulator.
    """
    device = device_of(plan.device)
    # Let glibc keep freed memory between batches: 14 to 35% more images per second on a CPU.
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 2**28)):
            mallopt(option, value)
    torch.set_num_threads(plan.threads)
    # Otherwise cuDNN may choose another algorithm each time, with results that differ in the last bits.
    torch.backends.cudnn.deterministic = True
    enter_folder(out)
    folders = [data] if isinstance(data, Path) else list(data)
    samples = [sample for folder in folders for sample in read_samples(folder)]
    check_equal(samples)
    training, validation = split(samples, plan)
    del samples  # frees those that are not used
    names = {s.simulator for s in training}
    present = {folder: {path.parent.name for path in folder.glob("*/*.parquet")} & names for folder in folders}
    generators = _same("generators", [translated_by(*one) for one in present.items()])
    for folder, some in present.items():
        copy_generators(folder, {name: generators[name] for name in some if name in generators}, out / "sim2real")
    crops = _same("crops", [crops_of(*one, trusted=trusted) for one in present.items()])
    if len(training) < plan.batch_size:
        raise DatasetError(
            f"{len(training)} images for training, expected at least one batch of {plan.batch_size}: collect more"
        )
    identity = _identity(plan, training + validation, crops)
    torch.manual_seed(plan.seed)
    fresh = _continued(plan, generators) if plan.start else make_network(plan.network)
    network = fresh.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.Adam(network.parameters(), lr=plan.learning_rate)
    history: list[Epoch] = []
    if state := load_checkpoint(out, identity):
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        history = [Epoch(**entry) for entry in state["history"]]

    def save(name: str) -> None:
        save_weights(network, out / f"{name}.safetensors", architecture=plan.network, generators=generators)

    batches = len(training) // plan.batch_size
    progress.start(batches * plan.epochs)
    counts = f"{len(training)} images for training, {len(validation)} for validation"
    progress.advance(batches * len(history), f"{counts}, {len(history)} epochs completed before")
    while len(history) < plan.epochs and not _stalled(history, plan.patience):
        number = len(history) + 1
        started = time.monotonic()
        torch.manual_seed(plan.seed * 1000 + number)
        training_loss = _train_epoch(network, optimizer, training, crops, plan, number, progress, save)
        validation_loss = _validate(network, validation, crops, plan)
        seconds = round(time.monotonic() - started, 1)
        history.append(
            Epoch(epoch=number, training_loss=training_loss, validation_loss=validation_loss, seconds=seconds)
        )
        progress.describe(f"epoch {number}: training {training_loss:.5f}, validation {validation_loss:.5f}")
        if validation_loss == min(e.validation_loss for e in history):
            save(plan.network)
        state = {"network": network.state_dict(), "optimizer": optimizer.state_dict(), "identity": identity}
        save_checkpoint(out, state | {"history": [asdict(e) for e in history]})
    write_json(out / "training.json", {"plan": asdict(plan), "history": [asdict(e) for e in history]})
    return history


def _continued(plan: TrainingPlan, generators: Mapping[str, str]) -> nn.Module:
    if architecture_in(path_of_weights(plan.start)) != plan.network:
        raise TrainingError(f"{plan.start} is no {plan.network}: leave out --network, or choose another --from")
    trained_with = generators_in(plan.start)
    if trained_with != generators:
        kinds = ["translated" if digests else "plain" for digests in (trained_with, generators)]
        raise TrainingError(
            f"{plan.start} sees {kinds[0]} images, and the data set has {kinds[1]} ones, or of other generators: "
            "expected the same, see docs/sim2real.md"
        )
    return module_of(load_weights(plan.start))


def _same(what: str, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Join what is known of the simulators of several data sets, if they agree."""
    joined: dict[str, Any] = {}
    for name, value in (item for part in parts for item in part.items()):
        if joined.setdefault(name, value) != value:
            raise DatasetError(f"the data sets have different {what} of {name}: expected the same")
    return joined


def schedule_of(name: str, network: str) -> TrainingPlan:
    """Look up the plan of a schedule for a network; a TrainingError or an UnknownNetworkError if there is none."""
    if name not in SCHEDULES:
        raise TrainingError(f"unknown schedule {name!r}: expected {' or '.join(SCHEDULES)}")
    if network not in SCHEDULES[name]:
        make_network(network)
    return SCHEDULES[name][network]


def device_of(name: str) -> torch.device:
    """Choose the device for `auto`, `cpu` or `cuda`; a TrainingError for another name, or if there is no GPU."""
    if name not in ("auto", "cpu", "cuda"):
        raise TrainingError(f"unknown device {name!r}: expected auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("PyTorch finds no usable GPU: leave out --device cuda, or install PyTorch for CUDA")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def split(samples: list[Sample], plan: TrainingPlan) -> tuple[list[Sample], list[Sample]]:
    """Split samples into training and validation: equal numbers of every simulator, and no road in both."""
    rng = np.random.default_rng(plan.seed)
    roads = sorted({sample.road_id for sample in samples})
    held_out = set(rng.permutation(roads)[: max(1, round(plan.validation * len(roads)))].tolist())
    if len(held_out) == len(roads):
        raise DatasetError("all samples come from one road: collect at least two roads")
    limit = plan.images_per_simulator
    parts = []
    for held in (False, True):
        part = [sample for sample in samples if (sample.road_id in held_out) is held]
        absent = {s.simulator for s in samples} - {s.simulator for s in part}
        if absent:
            raise DatasetError(f"{', '.join(sorted(absent))} has too few roads for a split: collect more roads there")
        share = plan.validation if held else 1.0 - plan.validation
        parts.append(balance(part, rng, limit=round(limit * share) if limit else None))
    return parts[0], parts[1]


def _losses(network: nn.Module, batches: Iterable[tuple[Tensor, Tensor]], reduction: str = "mean") -> Iterator[Tensor]:
    """Compute the squared error of each batch of images and labels."""
    device = next(network.parameters()).device
    # On a processor that only emulates bfloat16, single precision is ten times faster.
    precision = torch.bfloat16 if device.type != "cpu" or has_bfloat16() else torch.float32
    for images, labels in batches:
        with torch.autocast(device.type, dtype=precision, enabled=precision is not torch.float32):
            predicted = network(images.to(device, precision))
        yield nn.functional.mse_loss(predicted.float()[:, 0], labels.to(device), reduction=reduction)


def _train_epoch(
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    samples: list[Sample],
    crops: dict[str, Crop],
    plan: TrainingPlan,
    number: int,
    progress: Progress,
    save: Callable[[str], None],
) -> float:
    """Train for one epoch, and save the weights under a name after the steps of the plan; return the mean loss."""
    network.train()
    if number > plan.epochs - plan.without_dropout:
        disable_dropout(network)
    rng = np.random.default_rng([plan.seed, number])
    order = rng.permutation(len(samples))
    batches = [order[i : i + plan.batch_size] for i in range(0, len(order) - plan.batch_size + 1, plan.batch_size)]
    losses = []
    started = time.monotonic()
    loaded = _load_batches(samples, batches, crops, (plan.seed, number))
    for index, loss in enumerate(_losses(network, loaded), start=1):
        loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
        step = (number - 1) * len(batches) + index
        if step in plan.weights_at:
            save(f"{plan.network}_{step}")
        speed = index * plan.batch_size / (time.monotonic() - started)
        line = f"batches; epoch {number}: loss {np.mean(losses[-50:]):.5f}, {speed:.0f} images a second"
        progress.advance(line="" if index % 50 else line)
    return float(np.mean(losses))


@torch.inference_mode()
def _validate(network: nn.Module, samples: list[Sample], crops: dict[str, Crop], plan: TrainingPlan) -> float:
    network.eval()
    batches = [np.arange(i, min(i + plan.batch_size, len(samples))) for i in range(0, len(samples), plan.batch_size)]
    total = 0.0
    for loss in _losses(network, _load_batches(samples, batches, crops, None), reduction="sum"):
        total += float(loss)  # not `sum`, which compensates from Python 3.12 on
    return total / len(samples)


def _load_batches(
    samples: list[Sample], batches: list[np.ndarray], crops: dict[str, Crop], seed: tuple[int, int] | None
) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of images and labels; decodes the next one while one is in use, and augments them if there is a seed."""

    def load(index: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng([*seed, index]) if seed else None
        images, labels = [], []
        for sample in (samples[i] for i in batches[index]):
            image, steering = decode(sample.jpeg), sample.steering
            if rng:
                image, steering = augment(image, steering, rng)
            images.append(prepare(image, crops[sample.simulator]))
            labels.append(steering)
        return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2), torch.tensor(labels, dtype=torch.float32)

    with ThreadPoolExecutor(1) as pool:
        pending = pool.submit(load, 0)
        for index in range(len(batches)):
            batch = pending.result()
            if index + 1 < len(batches):
                pending = pool.submit(load, index + 1)
            yield batch


def _stalled(history: list[Epoch], patience: int) -> bool:
    best = min(history, key=lambda e: e.validation_loss, default=None)
    return best is not None and len(history) - best.epoch >= patience


def load_checkpoint(folder: Path, identity: object) -> dict[str, Any]:
    """Load a checkpoint as tensors, never code; empty if none; a TrainingError if damaged, or of another identity."""
    path = folder / CHECKPOINT
    if not path.exists():
        return {}
    try:
        with open_regular(path) as content:
            state: dict[str, Any] = torch.load(content, weights_only=True, map_location="cpu")
        recorded = state["identity"]
    except Exception as error:  # torch.load may raise anything on a damaged file
        raise TrainingError(f"{path} cannot be read ({type(error).__name__}): delete it and train again") from None
    if recorded != identity:
        raise TrainingError(f"{folder} holds a training with other settings or images: choose another --out")
    return state


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint, with the identity of its training, for `load_checkpoint`."""
    with whole_file(folder / CHECKPOINT) as partial:
        torch.save(state, partial)


def _identity(plan: TrainingPlan, samples: list[Sample], crops: dict[str, Crop]) -> dict[str, object]:
    """What must match for a training to be resumed; epochs, patience, `weights_at`, threads and device may change."""
    digest = hashlib.sha256()
    for sample in samples:
        digest.update(f"{sample.simulator} {sample.road_id} {sample.steering} {len(sample.jpeg)} ".encode())
    for simulator, crop in sorted(crops.items()):
        digest.update(f"{simulator} {crop.top} {crop.bottom} ".encode())
    free = ("epochs", "threads", "patience", "device", "weights_at", "start")
    settings = {k: v for k, v in asdict(plan).items() if k not in free}
    if plan.start:
        settings["start"] = weights_sha256(plan.start)
    return {**settings, "data": digest.hexdigest()}


def augment(image: NDArray[np.uint8], steering: float, rng: np.random.Generator) -> tuple[NDArray[np.uint8], float]:
    """Augment one image of two, (160, 320, 3) uint8 RGB before cropping, and its label in [-1, 1]."""
    if rng.random() < 0.5:
        return image, steering
    if rng.random() < 0.5:
        image, steering = np.ascontiguousarray(image[:, ::-1]), -steering
    if rng.random() < 0.5:
        columns, rows = (int(rng.integers(-limit, limit + 1)) for limit in MAX_SHIFT)
        move = np.array([[1, 0, columns], [0, 1, rows]], np.float32)  # filled with black (maxitwo)
        image = cv2.warpAffine(image, move, (image.shape[1], image.shape[0]), flags=cv2.INTER_NEAREST)
        steering = min(max(steering + STEERING_PER_COLUMN * columns, -1.0), 1.0)
    if rng.random() < 0.5:
        image = _shadow(image, rng)
    if rng.random() < 0.5:
        image = cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.8, 1.2)))
    return image, steering


def _shadow(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Darken one side of a random line to 0.2 to 0.5 of its brightness (maxitwo)."""
    rows, columns = image.shape[:2]
    top, bottom = rng.integers(0, columns, 2)
    side = 0 if rng.random() < 0.5 else columns
    mask = np.zeros((rows, columns), np.uint8)
    cv2.fillPoly(mask, [np.array([[top, 0], [bottom, rows], [side, rows], [side, 0]], np.int32)], 255)
    dark = cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.2, 0.5)))
    return np.where(mask[:, :, None] > 0, dark, image)
