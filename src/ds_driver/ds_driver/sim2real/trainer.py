# SPDX-License-Identifier: Apache-2.0
"""Trains CycleGAN between a simulator's images and photographs (Zhu et al. 2017; paper 3.2.2, 4.1.2)."""

from __future__ import annotations

import os

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # large pages make training on a CPU faster

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ds_base.folder_files import enter_folder, write_whole
from ds_base.progress import Progress
from ds_driver.sim2real.generator import Sim2RealError, save_generator
from ds_driver.sim2real.networks import Discriminator, Generator, ImagePool, to_batch, to_images
from ds_driver.sim2real.preparation import Domains
from ds_driver.sim2real.settings import Sim2RealSettings
from ds_driver.training import device_of, load_checkpoint, save_checkpoint
from ds_sim.camera.encodings import png

EPOCHS = "epochs"
"""Folder of the stored generators and sheets."""
GAP = 4
"""White pixels between pictures of a sheet."""
REPORTS = 10
LOSSES = ("adversarial", "cycle", "identity", "discriminator")


class CycleGan:
    """Two generators, two discriminators, their optimisers and pools."""

    def __init__(self, settings: Sim2RealSettings, device: torch.device) -> None:
        torch.manual_seed(settings.seed)
        self.to_real, self.to_simulated = Generator(settings.shape), Generator(settings.shape)
        judge = settings.discriminator_filters, settings.discriminator_depth
        self.judges_real, self.judges_simulated = Discriminator(*judge), Discriminator(*judge)
        self.networks = (self.to_real, self.to_simulated, self.judges_real, self.judges_simulated)
        for network in self.networks:
            network.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._judges = [*self.judges_real.parameters(), *self.judges_simulated.parameters()]
        generators = [*self.to_real.parameters(), *self.to_simulated.parameters()]
        options: dict[str, Any] = {"lr": settings.learning_rate, "betas": (0.5, 0.999)}
        self.optimizers = (torch.optim.Adam(generators, **options), torch.optim.Adam(self._judges, **options))
        self.pools = (ImagePool(settings.pool), ImagePool(settings.pool))
        self._settings, self._device = settings, device

    def set_learning_rate(self, share: float) -> None:
        """Set it to a share of the settings' one."""
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = self._settings.learning_rate * share

    def step(self, simulated: Tensor, real: Tensor, rng: np.random.Generator) -> Tensor:
        """Learn from one batch of each domain, in -1 to 1; return the losses named in `LOSSES`."""
        settings = self._settings
        self._freeze_judges(True)
        with torch.autocast(self._device.type, dtype=torch.bfloat16):
            fake_real, fake_simulated = self.to_real(simulated), self.to_simulated(real)
            again_simulated, again_real = self.to_simulated(fake_real), self.to_real(fake_simulated)
            same_simulated, same_real = self.to_simulated(simulated), self.to_real(real)
            verdicts = self.judges_real(fake_real), self.judges_simulated(fake_simulated)
        adversarial = _least_squares(verdicts[0], 1.0) + _least_squares(verdicts[1], 1.0)
        cycle = _distance(again_simulated, simulated) + _distance(again_real, real)
        identity = _distance(same_simulated, simulated) + _distance(same_real, real)
        loss = adversarial + settings.cycle * (cycle + settings.identity * identity)
        self.optimizers[0].zero_grad(set_to_none=True)
        loss.backward()
        self.optimizers[0].step()

        self._freeze_judges(False)
        earlier_real = self.pools[0].query(fake_real.detach(), rng)
        earlier_simulated = self.pools[1].query(fake_simulated.detach(), rng)
        with torch.autocast(self._device.type, dtype=torch.bfloat16):
            answers = [
                (self.judges_real(real), self.judges_real(earlier_real)),
                (self.judges_simulated(simulated), self.judges_simulated(earlier_simulated)),
            ]
        losses = [_least_squares(true, 1.0) + _least_squares(false, 0.0) for true, false in answers]
        judged = 0.5 * (losses[0] + losses[1])
        self.optimizers[1].zero_grad(set_to_none=True)
        judged.backward()
        self.optimizers[1].step()
        return torch.stack((adversarial, cycle, identity, judged)).detach()

    def _freeze_judges(self, frozen: bool) -> None:
        for parameter in self._judges:
            parameter.requires_grad_(not frozen)


def train(domains: Domains, settings: Sim2RealSettings, out: Path, progress: Progress) -> list[dict[str, float]]:
    """Train, or continue after the last whole epoch with the results of an undisturbed training; return mean losses.

    Writes `epochs/epoch_NNN.safetensors` and `.png` (simulated, translated, back; real, simulated, back).

    Raises:
        Sim2RealError: training diverged.
        ds_driver.training.TrainingError: the folder holds another training, or the device is not available.
    """
    device = device_of(settings.device)
    torch.set_num_threads(settings.threads)
    torch.backends.cudnn.deterministic = True
    gan = CycleGan(settings, device)
    identity = _identity(domains, settings)
    history = _resume(out, gan, identity, device)
    enter_folder(out / EPOCHS)
    steps = settings.steps or max(len(domains.simulated), len(domains.real))
    progress.start(settings.epochs * steps)
    progress.advance(len(history) * steps)
    while len(history) < settings.epochs:
        epoch = len(history) + 1
        gan.set_learning_rate(learning_rate_share(epoch, settings.epochs))
        rng = np.random.default_rng([settings.seed, epoch])
        simulated = _order(len(domains.simulated), steps, rng)
        pairs = domains.pairs.photographs
        real = pairs[simulated, rng.integers(pairs.shape[1], size=steps)]
        total = torch.zeros(len(LOSSES), device=device)
        for step in range(steps):
            there, back = (_batch(image, device) for image in domains.pair(simulated[step], real[step]))
            total += gan.step(there, back, rng)
            progress.advance()
            if (step + 1) % max(1, steps // REPORTS) == 0:
                values = _named(total / (step + 1))
                if not np.isfinite(list(values.values())).all():
                    again = "continue with another --seed in another --out"
                    raise Sim2RealError(f"training diverged in epoch {epoch}: {again}")
                losses = ", ".join(f"{name} {value:.3f}" for name, value in values.items())
                progress.describe(f"steps; epoch {epoch}/{settings.epochs}: {losses}")
        history.append(_named(total / steps))
        name = f"epoch_{epoch:03d}"
        write_whole(out / EPOCHS / f"{name}.png", png(_sheet(gan, domains, device)))
        if epoch % settings.keep_every == 0 or epoch == settings.epochs:
            tensors = {key: value.float().cpu().numpy() for key, value in gan.to_real.state_dict().items()}
            save_generator(
                out / EPOCHS / f"{name}.safetensors",
                tensors,
                simulator=domains.simulator,
                shape=settings.shape,
                window=domains.match.simulated,
                real_window=domains.match.real,
            )
        state = {
            "networks": [network.state_dict() for network in gan.networks],
            "optimizers": [optimizer.state_dict() for optimizer in gan.optimizers],
            "pools": [pool.state() for pool in gan.pools],
        }
        save_checkpoint(out, state | {"identity": identity, "history": history})
    return history


def learning_rate_share(epoch: int, epochs: int) -> float:
    """Return the share of the learning rate for an epoch, from 1: constant, then linear to 0 (Zhu et al. 2017)."""
    constant = epochs - epochs // 2
    return 1.0 - max(0, epoch - constant) / (epochs // 2 + 1)


def _order(count: int, steps: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw indices so that all come up equally often."""
    rounds = -(-steps // count)
    return np.concatenate([rng.permutation(count) for _ in range(rounds)])[:steps]


def _batch(image: NDArray[np.uint8], device: torch.device) -> Tensor:
    return to_batch(torch.from_numpy(image[None])).to(device)


def _least_squares(verdict: Tensor, target: float) -> Tensor:
    return (verdict.float() - target).square().mean()


def _distance(image: Tensor, other: Tensor) -> Tensor:
    return (image.float() - other).abs().mean()


def _named(losses: Tensor) -> dict[str, float]:
    return dict(zip(LOSSES, losses.cpu().tolist(), strict=True))


@torch.inference_mode()
def _sheet(gan: CycleGan, domains: Domains, device: torch.device) -> NDArray[np.uint8]:
    """Arrange held-out images with their translations, (rows, columns, 3) uint8 RGB: both domains side by side."""

    def row(image: NDArray[np.uint8], there: nn.Module, back: nn.Module) -> list[NDArray[np.uint8]]:
        translated = there(_batch(image, device))
        return [image, *(to_images(part)[0].cpu().numpy() for part in (translated, back(translated)))]

    left = [row(image, gan.to_real, gan.to_simulated) for image in domains.shown_simulated]
    right = [row(image, gan.to_simulated, gan.to_real) for image in domains.shown_real]
    rows = np.array([a + b for a, b in zip(left, right, strict=True)])
    framed = np.pad(rows, ((0, 0), (0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255)
    page = np.concatenate(np.concatenate(framed, axis=1), axis=1)
    return np.ascontiguousarray(page[:-GAP, :-GAP])


def _identity(domains: Domains, settings: Sim2RealSettings) -> str:
    """What must match for a training to be resumed; threads and device may change."""
    digest = hashlib.sha256()
    pairs = domains.pairs
    lanes = (pairs.photographs, pairs.simulated_lanes, pairs.photographed_lanes)
    for part in (domains.simulated, domains.real, *lanes):
        digest.update(np.ascontiguousarray(part).tobytes())
    plan = asdict(replace(settings, threads=1, device="auto"))
    windows = [str(domains.match.simulated), str(domains.match.real)]
    return json.dumps([domains.simulator, plan, windows, digest.hexdigest()], sort_keys=True)


def _resume(folder: Path, gan: CycleGan, identity: str, device: torch.device) -> list[dict[str, float]]:
    state = load_checkpoint(folder, identity)
    if not state:
        return []
    for network, tensors in zip(gan.networks, state["networks"], strict=True):
        network.load_state_dict(tensors)
    for optimizer, values in zip(gan.optimizers, state["optimizers"], strict=True):
        optimizer.load_state_dict(values)
    for pool, images in zip(gan.pools, state["pools"], strict=True):
        if len(images):
            pool.restore(images, device)
    return list(state["history"])
