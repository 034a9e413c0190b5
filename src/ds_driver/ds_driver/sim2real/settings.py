# SPDX-License-Identifier: Apache-2.0
"""Settings of a sim2real training, and its presets."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ds_driver.sim2real.generator import GeneratorShape

ROAD_SEED = 20_150_715
"""Seed of the simulated roads; chosen: no other verb has it as its default."""
HELD_OUT = 0.2
"""Share of roads and photographs, the last ones, that training never sees."""
FEWEST = 20
"""Fewest photographs; chosen: a fifth is held out, and lines are measured on the others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sim2RealSettings:
    """Settings of a training.

    Attributes:
        shape: of both generators.
        discriminator_filters: channels of the discriminators' first layer (paper: 64).
        discriminator_depth: see `ds_driver.sim2real.networks.Discriminator` (paper: 3).
        epochs: in the second half of them the learning rate falls linearly to 0.
        steps: of one image of each domain per epoch; None for the larger domain's number of images.
        keep_every: epochs between two stored checkpoints.
        roads: random roads, each driven both ways.
        every: keep every n-th simulated frame.
        images: simulated ones at most.
        photographs: at most.
        longest: steps per drive at most; None for whole roads.
        seed: of weights, order and roads' drives.
        learning_rate: of Adam (Zhu et al. 2017: 2e-4).
        cycle: weight of the cycle loss (Zhu et al. 2017: 10).
        identity: weight of the identity loss, as a share of the cycle loss (Zhu et al. 2017: 0.5).
        pool: earlier translations shown to the discriminators (Zhu et al. 2017: 50).
        device: `auto`, `cpu` or `cuda`.
    """

    shape: GeneratorShape
    discriminator_filters: int
    epochs: int
    discriminator_depth: int = 3
    steps: int | None = None
    keep_every: int = 1
    roads: int = 15
    every: int = 5
    images: int = 2_500
    photographs: int = 5_000
    longest: int | None = None
    seed: int = 1
    road_seed: int = ROAD_SEED
    learning_rate: float = 2e-4
    cycle: float = 10.0
    identity: float = 0.5
    pool: int = 50
    threads: int = 2
    device: str = "auto"


_LAPTOP = Sim2RealSettings(
    shape=GeneratorShape(filters=16, blocks=6, rows=80, columns=160),
    discriminator_filters=32,
    discriminator_depth=2,
    epochs=6,
    steps=1_000,
)
PRESETS = {
    "laptop": _LAPTOP,
    "fast": replace(_LAPTOP, shape=GeneratorShape(filters=8, blocks=6, rows=80, columns=160)),
    "paper": Sim2RealSettings(
        shape=GeneratorShape(filters=64, blocks=9, rows=160, columns=320),
        discriminator_filters=64,
        epochs=60,
        keep_every=5,
        roads=25,
        every=3,
        images=5_000,
    ),
}
"""All: 5,000 photographs (paper 4.1.2).
`paper`: as many simulated images, 60 epochs, a checkpoint every 5 (4.1.2), for a GPU.
`laptop`: half an hour of one core; in two trainings of 10,000 steps the distance to photographs did not fall after the
fourth thousand. Its patches of 34 pixels are 0.43 of its image's rows, as the paper's 70 are of its 160: larger ones
judge where lines are, and bend them.
`fast`: half of the filters, a third of the time a frame."""
