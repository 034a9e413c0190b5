"""Put a trained network into ds_driver, with a card that says what it was made of and how well it drives.

`python tools/ship_network.py --data DATA --training DIR [--network dave2] [--roads 25] [--seed 424242]` drives roads
that no training has seen on every simulator, then writes weights and card to `src/ds_driver/ds_driver/models`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from pathlib import Path

from ds_driver.assessment import success_rates, unseen_roads
from ds_driver.networks import count_parameters
from ds_driver.weights import SHIPPED, load_network
from ds_sim.registry import SIMULATORS


def main() -> None:
    """Assess, then copy weights and write the card."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--training", type=Path, required=True)
    parser.add_argument("--network", default="dave2")
    parser.add_argument("--roads", type=int, default=25)
    parser.add_argument("--seed", type=int, default=424242)
    arguments = parser.parse_args()
    weights = arguments.training / f"{arguments.network}.safetensors"
    manifest = json.loads((arguments.data / "manifest.json").read_text())
    training = json.loads((arguments.training / "training.json").read_text())
    roads = unseen_roads(arguments.roads, arguments.seed)
    trained_on = {path.name.rpartition("-")[0] for path in arguments.data.glob("*/*.parquet")}
    seen = [road.road_id for road in roads if road.road_id in trained_on]
    if seen:
        sys.exit(f"roads {', '.join(seen)} were trained on: choose another --seed")
    success = success_rates(
        str(weights), list(SIMULATORS), roads, arguments.seed, lambda done, total, line: print(f"{done}/{total} {line}")
    )
    history = training["history"]
    best = min(history, key=lambda epoch: epoch["validation_loss"])
    plan, collection = training["plan"], manifest["plan"]
    card = {
        "network": arguments.network,
        "parameters": count_parameters(load_network(str(weights))),
        "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "data": {
            "collection": collection,
            "images_per_simulator_collected": manifest["images"],
            "images_per_simulator_used": plan["images_per_simulator"] or min(manifest["images"].values()),
            "steering_bins": manifest["steering_bins"],
            "steering_histogram": manifest["steering"],
        },
        "seeds": {"collection": collection["seed"], "training": plan["seed"], "assessment": arguments.seed},
        "commands": [
            f"./ds collect --out data --roads {collection['roads']} --every {collection['every']}"
            f" --seed {collection['seed']}",
            f"./ds train --data data --out training --epochs {plan['epochs']} --seed {plan['seed']}"
            f" --learning-rate {plan['learning_rate']:g}"
            + (f" --images {plan['images_per_simulator']}" if plan["images_per_simulator"] else ""),
            f"python tools/ship_network.py --data data --training training --seed {arguments.seed}",
        ],
        "training": plan,
        "loss": {
            "mean_squared_error": "of steering in [-1, 1]",
            "best_epoch": best["epoch"],
            "training": best["training_loss"],
            "validation": best["validation_loss"],
            "history": history,
        },
        "roads": {"count": arguments.roads, "max_angle": 270, "note": "random roads not seen in training"},
        "success": success,
        "versions": manifest["versions"],
    }
    SHIPPED.mkdir(exist_ok=True)
    shutil.copyfile(weights, SHIPPED / weights.name)
    (SHIPPED / f"{arguments.network}.json").write_text(json.dumps(card, indent=1) + "\n")
    print(json.dumps(success))


if __name__ == "__main__":
    main()
