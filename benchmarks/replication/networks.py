# SPDX-License-Identifier: Apache-2.0
"""Chooses the networks of the paper's campaign: as good as the paper's, not better.

`python -m benchmarks.replication.networks TRAINING --name dave2` drives every checkpoint of a training over the 50
drives of Table 1 on the twin, and keeps the one whose success is nearest to the paper's, with a card, in `networks`.

The rule, fixed before any drive of the campaign: `ds train` with the shipped recipe, seed 1, writes its weights at
`STEPS`; the shipped weights of the same recipe are its end. Of these, the one whose share of completed drives is
nearest to the paper's; of several, the one that was trained for longest. Nothing else of a checkpoint is looked at.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from pathlib import Path

from ds_driver.data.collection import roads_both_ways
from ds_driver.networks.weights import SHIPPED, compress
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks
from ds_sim.simulator import Outcome
from ds_studies.same_roads import drive_same_roads

NETWORKS = Path(__file__).parent / "networks"
STEPS = (71, 100, 141, 200, 283, 400, 565)
"""Batches of 128 images; chosen: half an octave apart, in the first epoch of every network."""
SUCCESS = {
    "dave2": 0.84, "chauffeur": 0.72, "epoch": 0.52, "dave2_real": 0.96, "chauffeur_real": 0.92, "epoch_real": 0.96,
}  # fmt: skip
"""Paper, Table 1: share of 50 drives that a network completes on the twin."""
BACKEND = "openvino-bf16"
"""As `paper.yaml`: the same verdicts as single precision (docs/speed.md) in 0.7 of its processor time."""
ROADS, SEED = 25, 424242
"""As on the cards of the shipped networks."""


def success_of(weights: Path, folder: Path, backend: str, workers: int) -> float:
    """Share of the roads, both ways, that a network completes on the twin; drives of a stopped call are kept."""
    roads = roads_both_ways(ROADS, SEED)
    settings = DriveSettings(siblings=("donkey",), driver=f"{weights}@{backend}", gates="none", workers=workers)
    completed = 0
    for way, driven in (("forward", roads), ("reverse", [road.reversed() for road in roads])):
        found = drive_same_roads(settings, driven, SEED, folder / way, Callbacks())["donkey"]
        if not all(one.outcome.is_verdict for one in found):
            sys.exit(f"{weights}: a drive ended in an error: fix it and try again")
        completed += sum(one.outcome is Outcome.COMPLETED for one in found)
    return completed / (2 * len(roads))


def main() -> None:
    """Assess every checkpoint, and keep the nearest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("training", type=Path)
    parser.add_argument("--name", choices=SUCCESS, required=True)
    parser.add_argument("--out", type=Path, default=NETWORKS)
    parser.add_argument("--backend", default=BACKEND)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    name, architecture = arguments.name, arguments.name.removesuffix("_real")
    found: dict[str, float] = {}
    files = {str(step): arguments.training / f"{architecture}_{step}.safetensors" for step in STEPS}
    files["end"] = SHIPPED / f"{name}.safetensors"
    for step, file in files.items():
        if architecture == "epoch" and step != "end":  # as it is stored: 105 MB otherwise
            file = files[step] = file.with_name(f"{architecture}_{step}_8.safetensors")
            if not file.exists():
                compress(arguments.training / f"{architecture}_{step}.safetensors", file)
        there = arguments.training / "assessed" / step
        found[step] = success_of(file.resolve(), there, arguments.backend, arguments.workers)
        print(f"{name}: {found[step]:.2f} after {step} steps, {SUCCESS[name]} in the paper", flush=True)
    chosen = min(reversed(files), key=lambda step: abs(found[step] - SUCCESS[name]))
    arguments.out.mkdir(exist_ok=True)
    weights = shutil.copyfile(files[chosen], arguments.out / f"{name}.safetensors")
    card = {
        "network": name,
        "architecture": architecture,
        "rule": "of one training's checkpoints, the one whose success on the twin is nearest to the paper's (Table 1)",
        "step": chosen,
        "success_on_the_twin": found[chosen],
        "paper": SUCCESS[name],
        "success_by_step": found,
        "backend": arguments.backend,
        "drives": {"roads": ROADS, "ways": 2, "seed": SEED},
        "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
    }
    (arguments.out / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


if __name__ == "__main__":
    main()
