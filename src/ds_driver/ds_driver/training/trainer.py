"""Hybrid training: one network for all simulators, each equally represented (paper 3.2.2, 4.2.2)."""

from __future__ import annotations

import os

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # large pages: training on a CPU runs up to twice as fast

import ctypes
import hashlib
import json
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ds_driver.data.crops import crops_of
from ds_driver.data.dataset import DatasetError, Sample, balance, check_equal, decode, read_samples
from ds_driver.networks.architectures import make_network
from ds_driver.networks.preprocessing import Crop, prepare
from ds_driver.networks.weights import save_weights
from ds_driver.training.augmentation import augment

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
"""Options of mallopt(3)."""
Report = Callable[[str], None]


class TrainingError(ValueError):
    """A training that cannot be done here."""


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """How to train.

    Attributes:
        network: architecture.
        seed: of the weights, the split, the order and the augmentation.
        epochs: at most; `SCHEDULES` has the paper's.
        patience: epochs without a better validation loss before stopping.
        batch_size: images (paper 4.2.2: 128).
        learning_rate: of Adam (paper 4.2.2: 1e-4).
        validation: share of the roads held out (paper 3.2.2: 20 %).
        images_per_simulator: at most, None for all.
        threads: of the mathematics.
        device: `cpu`, `cuda`, or `auto`, which takes a GPU where there is one.
    """

    network: str = "dave2"
    seed: int = 1
    epochs: int = 12
    patience: int = 10
    batch_size: int = 128
    learning_rate: float = 1e-4
    validation: float = 0.2
    images_per_simulator: int | None = None
    threads: int = 2
    device: str = "auto"


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long to train a network; attributes as in `TrainingPlan`."""

    epochs: int
    patience: int


SCHEDULES: dict[str, dict[str, Schedule]] = {
    "laptop": {
        "dave2": Schedule(epochs=2, patience=10),
        "chauffeur": Schedule(epochs=4, patience=10),
        "epoch": Schedule(epochs=4, patience=10),
    },
    "paper": {
        "dave2": Schedule(epochs=50, patience=10),
        "chauffeur": Schedule(epochs=500, patience=20),
        "epoch": Schedule(epochs=500, patience=20),
    },
}
"""Name -> network -> schedule; `paper` (4.2.2, for plain images) wants a GPU, `laptop` is chosen: see the cards."""


@dataclass(frozen=True, kw_only=True)
class Epoch:
    """Mean squared errors of one pass over the data."""

    epoch: int
    training_loss: float
    validation_loss: float
    seconds: float


def train(
    data: Path,
    out: Path,
    plan: TrainingPlan,
    report: Report,
    crops: dict[str, Crop] | None = None,
    *,
    trusted: Collection[str] = (),
) -> list[Epoch]:
    """Train a network; stopped at any time it goes on after the last whole epoch.

    Args:
        data: folder of a data set.
        out: folder for `<network>.safetensors` (the best epoch), the checkpoint, and `training.json` at the end.
        plan: how to train.
        report: takes a line now and then.
        crops: rows cut off per simulator; those of `ds_driver.data.crops` if left out.
        trusted: simulators of the user's own that the data set may name.

    Raises:
        DatasetError: the data set cannot be used.
        ds_sim.registry.UnknownSimulatorError: a part of it comes from a simulator that is not known here.
    """
    device = device_of(plan.device)
    _keep_freed_memory()
    torch.set_num_threads(plan.threads)
    # On a GPU cuDNN may else choose another algorithm, and other bytes, each time.
    torch.backends.cudnn.deterministic = True
    out.mkdir(parents=True, exist_ok=True)
    samples = read_samples(data)
    check_equal(samples)
    training, validation = split(samples, plan)
    del samples  # those left out need not stay in memory
    crops = crops or crops_of(data, {s.simulator for s in training}, trusted=trusted)
    if len(training) < plan.batch_size:
        raise DatasetError(
            f"{len(training)} images to train on, expected at least one batch of {plan.batch_size}: collect more"
        )
    identity = _identity(plan, training + validation, crops)
    torch.manual_seed(plan.seed)
    network = make_network(plan.network).to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.Adam(network.parameters(), lr=plan.learning_rate)
    history = _resume(out / "checkpoint.pt", network, optimizer, identity)
    report(f"{len(training)} images to train on, {len(validation)} to validate, {len(history)} epochs done before")
    while len(history) < plan.epochs and not _stalled(history, plan.patience):
        number = len(history) + 1
        started = time.monotonic()
        torch.manual_seed(plan.seed * 1000 + number)
        training_loss = _train_epoch(network, optimizer, training, crops, plan, number, report)
        validation_loss = _validate(network, validation, crops, plan)
        history.append(
            Epoch(
                epoch=number,
                training_loss=training_loss,
                validation_loss=validation_loss,
                seconds=round(time.monotonic() - started, 1),
            )
        )
        left = (plan.epochs - number) * history[-1].seconds / 60
        report(f"epoch {number}: training {training_loss:.5f}, validation {validation_loss:.5f}, {left:.0f} min left")
        if validation_loss == min(e.validation_loss for e in history):
            save_weights(network, out / f"{plan.network}.safetensors", architecture=plan.network)
        _save(out / "checkpoint.pt", network, optimizer, identity, history)
    record = {"plan": asdict(plan), "history": [asdict(e) for e in history]}
    (out / "training.json").write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    return history


def _keep_freed_memory() -> None:
    """Tell glibc not to hand memory back between batches: 14 to 35 % more images a second on a CPU."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 2**28)):
            mallopt(option, value)


def schedule_of(name: str, network: str) -> Schedule:
    """The schedule of a name for a network.

    Raises:
        TrainingError: there is no such schedule.
        ds_driver.networks.architectures.UnknownNetworkError: there is no such network.
    """
    if name not in SCHEDULES:
        raise TrainingError(f"unknown schedule {name!r}: expected {' or '.join(SCHEDULES)}")
    if network not in SCHEDULES[name]:
        make_network(network)
    return SCHEDULES[name][network]


def device_of(name: str) -> torch.device:
    """The device of a name.

    Raises:
        TrainingError: a GPU is asked for and there is none, or the name is no device's.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise TrainingError(f"unknown device {name!r}: expected auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("no GPU that PyTorch can use is here: leave out --device cuda, or install PyTorch for CUDA")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def split(samples: list[Sample], plan: TrainingPlan) -> tuple[list[Sample], list[Sample]]:
    """Training and validation samples: equal shares of every simulator, and no road in both."""
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
            raise DatasetError(f"{', '.join(sorted(absent))} has too few roads for a split: collect more roads on it")
        share = plan.validation if held else 1.0 - plan.validation
        parts.append(balance(part, rng, limit=round(limit * share) if limit else None))
    return parts[0], parts[1]


def _train_epoch(
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    samples: list[Sample],
    crops: dict[str, Crop],
    plan: TrainingPlan,
    number: int,
    report: Report,
) -> float:
    network.train()
    device = next(network.parameters()).device
    rng = np.random.default_rng([plan.seed, number])
    order = rng.permutation(len(samples))
    batches = [order[i : i + plan.batch_size] for i in range(0, len(order) - plan.batch_size + 1, plan.batch_size)]
    losses = []
    started = time.monotonic()
    for index, (images, labels) in enumerate(_loaded(samples, batches, crops, (plan.seed, number)), start=1):
        optimizer.zero_grad(set_to_none=True)
        with torch.autocast(device.type, dtype=torch.bfloat16):
            predicted = network(images.to(device, torch.bfloat16))
        loss = nn.functional.mse_loss(predicted.float()[:, 0], labels.to(device))
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if index % 50 == 0:
            speed = index * plan.batch_size / (time.monotonic() - started)
            report(f"epoch {number}: {index}/{len(batches)} batches, loss {np.mean(losses[-50:]):.5f}, {speed:.0f}/s")
    return float(np.mean(losses))


@torch.inference_mode()
def _validate(network: nn.Module, samples: list[Sample], crops: dict[str, Crop], plan: TrainingPlan) -> float:
    network.eval()
    device = next(network.parameters()).device
    batches = [np.arange(i, min(i + plan.batch_size, len(samples))) for i in range(0, len(samples), plan.batch_size)]
    total = 0.0
    for images, labels in _loaded(samples, batches, crops, None):
        with torch.autocast(device.type, dtype=torch.bfloat16):
            predicted = network(images.to(device, torch.bfloat16))
        total += float(nn.functional.mse_loss(predicted.float()[:, 0], labels.to(device), reduction="sum"))
    return total / len(samples)


def _loaded(
    samples: list[Sample], batches: list[np.ndarray], crops: dict[str, Crop], seed: tuple[int, int] | None
) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of images and labels, the next one decoded while one is in use; augmented if there is a seed."""

    def load(index: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng([*seed, index]) if seed else None
        chosen = [samples[i] for i in batches[index]]
        images, labels = [], []
        for sample in chosen:
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
    if not history:
        return False
    best = min(history, key=lambda e: e.validation_loss)
    return len(history) - best.epoch >= patience


def _save(
    path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, identity: dict[str, object], history: list[Epoch]
) -> None:
    partial = path.with_suffix(".partial")
    state = {
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "identity": identity,
        "history": [asdict(e) for e in history],
    }
    torch.save(state, partial)
    partial.replace(path)


def _resume(
    path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, identity: dict[str, object]
) -> list[Epoch]:
    """Take up a checkpoint of the same plan; read as plain tensors, never as code."""
    if not path.exists():
        return []
    try:
        state = torch.load(path, weights_only=True)
        known = state["identity"]
    except Exception as error:  # torch raises whatever its reader stumbles over
        raise DatasetError(f"{path} cannot be read ({type(error).__name__}): delete it and train again") from None
    if known != identity:
        raise DatasetError(
            f"{path.parent} holds a training with another plan or other data: choose another folder or delete it"
        )
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    return [Epoch(**entry) for entry in state["history"]]


def _identity(plan: TrainingPlan, samples: list[Sample], crops: dict[str, Crop]) -> dict[str, object]:
    """What must be equal for a training to go on; more epochs or threads are welcome."""
    digest = hashlib.sha256()
    for sample in samples:
        digest.update(f"{sample.simulator} {sample.road_id} {sample.steering} {len(sample.jpeg)} ".encode())
    for simulator, crop in sorted(crops.items()):
        digest.update(f"{simulator} {crop.top} {crop.bottom} ".encode())
    fixed = {k: v for k, v in asdict(plan).items() if k not in ("epochs", "threads", "patience", "device")}
    return {**fixed, "data": digest.hexdigest()}
