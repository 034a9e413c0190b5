# SPDX-License-Identifier: Apache-2.0
"""Trains a network of today on data of `ds collect`, and exports it with its description, as you would your own.

    python examples/networks_of_today.py recurrent --data data --out trained      # trained/recurrent.onnx and .yaml
    ./ds check trained/recurrent.yaml

Kinds: `convolutional` (one image; what the others are compared with), `residual` (He et al. 2016), `transformer`
(Dosovitskiy et al. 2021), `stacked` (three images, 0.1 s apart), and `recurrent` (a GRU over the drive, Cho et al.
2014). All see 80 x 160 pixels and answer the steering. It needs PyTorch and no GPU.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor, nn

from ds_driver import read_samples
from ds_driver.data.dataset import Sample, crops_of, decode
from ds_driver.networks.backends import has_bfloat16
from ds_driver.networks.images import Crop
from ds_driver.training import augment

SIZE = (80, 160)
"""Rows and columns."""
STACK, STRIDE = 3, 2
"""Images that `stacked` sees, and frames from one to the next."""
WINDOW, UNSCORED = 24, 8
"""Frames by which `recurrent` is trained, and how many of them only fill its state."""
STATE = 64


def encoder(channels: int) -> nn.Sequential:
    """Nvidia's Dave-2 for 80 x 160 pixels, down to 64 features."""
    sizes = ((channels, 24, 5, 2), (24, 36, 5, 2), (36, 48, 5, 2), (48, 64, 3, 1), (64, 64, 3, 1))
    layers = [layer for a, b, kernel, stride in sizes for layer in (nn.Conv2d(a, b, kernel, stride), nn.ELU())]
    return nn.Sequential(*layers, nn.Flatten(), nn.Dropout(0.2), nn.Linear(64 * 3 * 13, STATE), nn.ELU())


class Convolutional(nn.Module):
    """One image, or a stack of them."""

    def __init__(self, frames: int = 1) -> None:
        super().__init__()
        self.layers = nn.Sequential(encoder(3 * frames), nn.Linear(STATE, 1))

    def forward(self, image: Tensor) -> Tensor:
        """(n, 3 * frames, 80, 160) in 0 to 1 -> (n, 1)."""
        steering: Tensor = self.layers(image)
        return steering


class Block(nn.Module):
    """Two convolutions around a shortcut; halves the image."""

    def __init__(self, a: int, b: int) -> None:
        super().__init__()
        self.way = nn.Sequential(
            nn.Conv2d(a, b, 3, 2, 1, bias=False),
            nn.BatchNorm2d(b),
            nn.ReLU(),
            nn.Conv2d(b, b, 3, 1, 1, bias=False),
            nn.BatchNorm2d(b),
        )
        self.shortcut = nn.Sequential(nn.Conv2d(a, b, 1, 2, bias=False), nn.BatchNorm2d(b))

    def forward(self, x: Tensor) -> Tensor:
        """See `nn.Module`."""
        return torch.relu(self.way(x) + self.shortcut(x))


def residual() -> nn.Module:
    """Eight convolutions with shortcuts; the last ones keep where things are, as a lane's place is the answer."""
    return nn.Sequential(
        nn.Conv2d(3, 16, 5, 2, 2, bias=False), nn.BatchNorm2d(16), nn.ReLU(),
        Block(16, 32), Block(32, 64), Block(64, 128),
        nn.Conv2d(128, 16, 1), nn.ReLU(), nn.Flatten(), nn.Dropout(0.2), nn.Linear(16 * 5 * 10, 64), nn.ReLU(),
        nn.Linear(64, 1),
    )  # fmt: skip


class Attention(nn.Module):
    """One layer of a vision transformer, normalised before each part."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.first, self.second = nn.LayerNorm(width), nn.LayerNorm(width)
        self.ask, self.mix = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.think = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, x: Tensor) -> Tensor:
        """(n, patches, width) -> the same."""
        n, patches, width = x.shape
        parts = self.ask(self.first(x)).reshape(n, patches, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        mixed = nn.functional.scaled_dot_product_attention(parts[0], parts[1], parts[2])
        x = x + self.mix(mixed.transpose(1, 2).reshape(n, patches, width))
        return x + self.think(self.second(x))


class Transformer(nn.Module):
    """A small vision transformer: 128 patches of 10 x 10 pixels."""

    def __init__(self, width: int = 96, depth: int = 4, heads: int = 4) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, width, 10, 10)
        self.places = nn.Parameter(torch.randn(1, SIZE[0] * SIZE[1] // 100, width) * 0.02)
        self.layers = nn.Sequential(*(Attention(width, heads) for _ in range(depth)), nn.LayerNorm(width))
        self.steer = nn.Linear(width, 1)

    def forward(self, image: Tensor) -> Tensor:
        """(n, 3, 80, 160) in 0 to 1 -> (n, 1)."""
        x = self.patches(image).flatten(2).transpose(1, 2) + self.places
        steering: Tensor = self.steer(self.layers(x).mean(1))
        return steering


class Recurrent(nn.Module):
    """The encoder, and a GRU that carries its state from frame to frame."""

    def __init__(self) -> None:
        super().__init__()
        self.see, self.cell, self.steer = encoder(3), nn.GRUCell(STATE, STATE), nn.Linear(STATE, 1)

    def forward(self, image: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """One frame: image and state -> steering and the next state."""
        state = self.cell(self.see(image), state)
        return self.steer(state), state

    def over(self, windows: Tensor) -> Tensor:
        """(n, frames, 3, 80, 160) -> (n, frames)."""
        n, frames = windows.shape[:2]
        features = self.see(windows.flatten(0, 1)).reshape(n, frames, STATE)
        state, answers = torch.zeros(n, STATE), []
        for k in range(frames):
            state = self.cell(features[:, k], state)
            answers.append(self.steer(state)[:, 0])
        return torch.stack(answers, 1)


MAKE = {
    "convolutional": Convolutional,
    "residual": residual,
    "transformer": Transformer,
    "stacked": lambda: Convolutional(STACK),
    "recurrent": Recurrent,
}


@dataclass(frozen=True)
class Plan:
    """Settings of a training.

    Attributes:
        kind: key of `MAKE`.
        epochs: times that each image is seen.
        batch: images in a batch; of `recurrent`, in all of its windows.
        rate: highest learning rate of Adam; it rises for a twentieth of the steps, and falls to 0 as a cosine.
        seed: of weights, order and augmentation.
        threads: of PyTorch.
    """

    kind: str
    epochs: int = 3
    batch: int = 192
    rate: float = 1e-3
    seed: int = 1
    threads: int = 1


@dataclass(frozen=True)
class Images:
    """Images, (n, 160, 320, 3) encoded, with their labels, and frames of the same drive that precede each."""

    samples: list[Sample]
    crops: dict[str, Crop]
    since: NDArray[np.int64]

    def window(self, index: int, back: list[int], seed: list[int] | None) -> tuple[NDArray[np.uint8], list[float]]:
        """Return frames so many frames back, (frames, 3, 80, 160), augmented alike, and the label of each."""
        pixels, labels = [], []
        for step in back:
            sample = self.samples[index - min(step, int(self.since[index]))]
            image, label = decode(sample.jpeg), sample.steering
            if seed is not None:  # the same draws for every frame of a window
                image, label = augment(image, label, np.random.default_rng(seed))
            pixels.append(cropped(image, self.crops[sample.simulator]).transpose(2, 0, 1))
            labels.append(label)
        return np.stack(pixels), labels


def cropped(image: NDArray[np.uint8], crop: Crop) -> NDArray[np.uint8]:
    """Prepare an image as its description says: `crop: simulator`, `size: [80, 160]`, RGB."""
    return cv2.resize(image[crop.top : len(image) - crop.bottom], SIZE[::-1], interpolation=cv2.INTER_LINEAR)


def load(data: Path) -> tuple[Images, list[int], list[int]]:
    """Read a data set; return it, and which images are for training and for validation: no road is in both."""
    samples = read_samples(data)
    since = np.zeros(len(samples), np.int64)
    for k in range(1, len(samples)):
        same = (samples[k].simulator, samples[k].drive) == (samples[k - 1].simulator, samples[k - 1].drive)
        since[k] = since[k - 1] + 1 if same else 0
    roads = sorted({one.road_id for one in samples})
    held_out = set(np.random.default_rng(1).permutation(roads)[: max(1, len(roads) // 5)].tolist())
    parts: dict[bool, dict[str, list[int]]] = {False: defaultdict(list), True: defaultdict(list)}
    for k, one in enumerate(samples):
        parts[one.road_id in held_out][one.simulator].append(k)
    even = [[k for group in part.values() for k in group[: min(map(len, part.values()))]] for part in parts.values()]
    return Images(samples, crops_of(data, {one.simulator for one in samples}), since), even[0], even[1]


def batch_of(images: Images, chosen: NDArray[np.int64], kind: str, seed: list[int] | None) -> tuple[Tensor, Tensor]:
    """Return inputs of a network and the labels of its answers."""
    frames, stride = {"stacked": (STACK, STRIDE), "recurrent": (WINDOW, 1)}.get(kind, (1, 1))
    back = [k * stride for k in reversed(range(frames))]
    windows = [images.window(int(k), back, None if seed is None else [*seed, int(k)]) for k in chosen]
    pixels = torch.from_numpy(np.stack([one for one, _ in windows])).float() / 255.0
    labels = torch.tensor([one for _, one in windows], dtype=torch.float32)
    return (pixels, labels[:, UNSCORED:]) if kind == "recurrent" else (pixels.flatten(1, 2), labels[:, -1:])


def answers(network: nn.Module, pixels: Tensor) -> Tensor:
    """Return answers (n, answers) with labels."""
    steering: Tensor = network.over(pixels)[:, UNSCORED:] if isinstance(network, Recurrent) else network(pixels)
    return steering


def train(images: Images, training: list[int], validation: list[int], plan: Plan, out: Path) -> nn.Module:
    """Train."""
    torch.manual_seed(plan.seed)
    network = MAKE[plan.kind]()
    window = WINDOW if plan.kind == "recurrent" else 1
    size = plan.batch // window
    steps = len(training) // window // size
    optimizer = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, plan.rate, total_steps=steps * plan.epochs, pct_start=0.05
    )
    history = []
    for epoch in range(plan.epochs):
        order = np.random.default_rng([plan.seed, epoch]).permutation(training)
        torch.manual_seed(plan.seed * 1000 + epoch)
        losses, began = [], time.monotonic()
        network.train()
        for step in range(steps):
            chosen = order[step * size : (step + 1) * size]
            pixels, labels = batch_of(images, chosen, plan.kind, [plan.seed, epoch])
            # Attention gains nothing from it.
            with torch.autocast("cpu", torch.bfloat16, enabled=has_bfloat16() and plan.kind != "transformer"):
                steering = answers(network, pixels)
            loss = nn.functional.mse_loss(steering.float(), labels)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            losses.append(loss.item())
        network.eval()
        with torch.inference_mode():
            chosen = np.array(validation[WINDOW :: WINDOW if plan.kind == "recurrent" else 7])
            errors = [
                (answers(network, pixels) - labels).square().flatten()
                for part in np.array_split(chosen, max(1, len(chosen) // size))
                for pixels, labels in [batch_of(images, part, plan.kind, None)]
            ]
        row = {
            "epoch": epoch + 1,
            "training_loss": round(float(np.mean(losses)), 6),
            "validation_loss": round(float(torch.cat(errors).mean()), 6),
            "seconds": round(time.monotonic() - began, 1),
        }
        history.append(row)
        print(json.dumps(row), flush=True)
    about = {"plan": asdict(plan), "history": history, "images": len(training)}
    (out / f"{plan.kind}.training.json").write_text(json.dumps(about, indent=1) + "\n")
    return network.eval()


def export(network: nn.Module, kind: str, out: Path) -> None:
    """Write the network as ONNX, and its description beside it."""
    described: dict[str, Any] = {"file": f"{kind}.onnx"}
    described["input"] = {"size": list(SIZE), "crop": "simulator", "divide": 255.0}
    inputs, outputs = {"image": torch.zeros(1, 3, *SIZE)}, ["steering"]
    if kind == "stacked":
        described["input"] |= {"frames": STACK, "stride": STRIDE}
        inputs["image"] = torch.zeros(1, 3 * STACK, *SIZE)
    if kind == "recurrent":
        described["inputs"] = {"state": {"state": "next_state"}}
        inputs["state"] = torch.zeros(1, STATE)
        outputs.append("next_state")
    zeros, file = tuple(inputs.values()), str(out / f"{kind}.onnx")
    torch.onnx.export(network, zeros, file, input_names=[*inputs], output_names=outputs, opset_version=17, dynamo=False)
    (out / f"{kind}.yaml").write_text(yaml.safe_dump(described, sort_keys=False))


def main() -> None:
    """Train and export one kind."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=MAKE)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--epochs", type=int, default=Plan.epochs)
    arguments = parser.parse_args()
    plan = Plan(arguments.kind, arguments.epochs)
    torch.set_num_threads(plan.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    network = train(*load(arguments.data), plan, arguments.out)
    export(network, plan.kind, arguments.out)


if __name__ == "__main__":
    main()
