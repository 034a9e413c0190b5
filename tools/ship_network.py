# SPDX-License-Identifier: Apache-2.0
"""Ships a trained network with ds_driver, with a card on its training data and performance.

`python tools/ship_network.py --data DATA --offline DATA2 --training DIR [--network dave2] [--name NAME] [--roads 25]
[--seed 424242] [--eight-bit] [--backend onnx]` drives roads not seen in training on every simulator in both directions,
compares the network with the autopilot on another data set, then writes weights and card to
`src/ds_driver/ds_driver/models`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file

from ds_analysis.paper.open_loop import OpenLoopAnswers, predict
from ds_base.bounded_file import sha256_of
from ds_base.folder_files import whole_file
from ds_cli.output import ScreenProgress
from ds_driver.data.collection import roads_both_ways
from ds_driver.data.dataset import road_ids
from ds_driver.networks.backends import BACKENDS
from ds_driver.networks.description import file_of, read_description
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.weights import GENERATORS, SCALE, SHIPPED, generators_in, load_weights, shipped_sets
from ds_driver.sim2real.image_translation import open_set
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks
from ds_road import Road
from ds_sim.registry import STANDARD, label_of
from ds_sim.simulator import Outcome
from ds_studies.same_roads import drive_same_roads

LARGEST_INTEGER = 127
"""Largest stored integer; the range is symmetric (Jacob et al. 2018, for weights)."""
SMALLEST_LAYER = 1_000_000
"""Fewest weights of a layer that is stored in 8 bits; chosen: smaller ones save less than 1 MB."""


def main() -> None:
    """Assess the network, copy its files and write the card."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--offline", type=Path, required=True)
    parser.add_argument("--training", type=Path, required=True)
    parser.add_argument("--network", default="dave2")
    parser.add_argument("--name", help="name to ship it under; that of the architecture if omitted")
    parser.add_argument("--roads", type=int, default=25)
    parser.add_argument("--seed", type=int, default=424242)
    parser.add_argument("--eight-bit", action="store_true", help="store, and assess, large layers in 8 bits")
    parser.add_argument("--backend", default="onnx", choices=BACKENDS, help="what computes the network when assessed")
    arguments = parser.parse_args()
    manifest = json.loads((arguments.data / "manifest.json").read_text())
    described = arguments.training / f"{arguments.network}.yaml"  # as `examples/networks_of_today.py` writes it
    files, driver, card = (_described if described.exists() else _trained)(arguments, manifest)
    roads = roads_both_ways(arguments.roads, arguments.seed)
    overlap = sorted(road_ids(arguments.data) & ({road.road_id for road in roads} | road_ids(arguments.offline)))
    if overlap:
        sys.exit(f"roads {', '.join(overlap)} were trained on: choose another --seed, or another offline set")
    card |= {
        "sha256": hashlib.sha256(files[0].read_bytes()).hexdigest(),
        "offline": _offline(predict(arguments.offline, DriverName(driver), ScreenProgress())),
        "roads": {"count": arguments.roads, "max_angle": 270, "note": "random roads not seen in training, both ways"},
        "success": _success_rates(driver, roads, arguments.seed),
        "versions": manifest["versions"],
    }
    SHIPPED.mkdir(exist_ok=True)
    for file in files:
        shutil.copyfile(file, SHIPPED / f"{card['network']}{file.suffix}")
    (SHIPPED / f"{card['network']}.json").write_text(json.dumps(card, indent=1) + "\n")
    print(json.dumps({"success": card["success"], **card["offline"]}))


Shipped = tuple[list[Path], str, dict[str, Any]]
"""Files of a network, the one with its weights first; the driver to assess; and what its card says of its training."""


def _trained(arguments: argparse.Namespace, manifest: dict[str, Any]) -> Shipped:
    """Weights of `ds train`."""
    weights = arguments.training / f"{arguments.network}.safetensors"
    if arguments.eight_bit:
        compress(weights, weights)
    offline = json.loads((arguments.offline / "manifest.json").read_text())
    training = json.loads((arguments.training / "training.json").read_text())
    generators = generators_in(str(weights))
    shipped_set = shipped_set_of(generators) if generators else None
    if generators and shipped_set is None:
        sys.exit(f"the generators of {weights} are not shipped: put them into {SHIPPED / GENERATORS}/NAME first")
    history = training["history"]
    best = min(history, key=lambda epoch: epoch["validation_loss"])
    plan, collection = training["plan"], manifest["plan"]
    card = {
        "network": arguments.name or arguments.network,
        "architecture": arguments.network,
        "parameters": load_weights(str(weights)).architecture.parameters,
        "data": {
            "collection": collection,
            "images_per_simulator_collected": manifest["images"],
            "images_per_simulator_used": plan["images_per_simulator"] or min(manifest["images"].values()),
            "steering_bins": manifest["steering_bins"],
            "steering_histogram": manifest["steering"],
        },
        "seeds": {
            "collection": collection["seed"],
            "training": plan["seed"],
            "offline": offline["plan"]["seed"],
            "assessment": arguments.seed,
        },
        "sim2real": {"set": shipped_set, "generators": generators} if generators else None,
        "commands": [
            f"./ds collect --out {'plain' if generators else 'data'} --roads {collection['roads']}"
            f" --every {collection['every']} --seed {collection['seed']}",
            *([f"./ds sim2real translate plain --generator {shipped_set} --out data"] if generators else []),
            f"./ds collect --out offline --roads {offline['plan']['roads']} --seed {offline['plan']['seed']}",
            f"./ds train --data data --out training --network {arguments.network} --epochs {plan['epochs']}"
            f" --seed {plan['seed']} --learning-rate {plan['learning_rate']:g} --threads {plan['threads']}"
            + (f" --images {plan['images_per_simulator']}" if plan["images_per_simulator"] else ""),
            f"python tools/ship_network.py --data data --offline offline --training training --network"
            f" {arguments.network}{f' --name {arguments.name}' if arguments.name else ''} --roads {arguments.roads}"
            f" --seed {arguments.seed}{' --eight-bit' if arguments.eight_bit else ''}"
            + (f" --backend {arguments.backend}" if arguments.backend != "onnx" else ""),
        ],
        "training": plan,
        "seconds": round(sum(epoch["seconds"] for epoch in history)),
        "loss": {
            "mean_squared_error": "of steering in [-1, 1]",
            "best_epoch": best["epoch"],
            "training": best["training_loss"],
            "validation": best["validation_loss"],
            "history": history,
        },
    }
    return [weights], f"{weights}@{arguments.backend}", card


def compress(path: Path, out: Path) -> list[str]:
    """Store the large layers of a weights file in half precision in 8 bits; return their names. `out` may be `path`."""
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        tensors: dict[str, NDArray[Any]] = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    large = [k for k, v in tensors.items() if v.ndim == 2 and v.dtype != np.int8 and v.size >= SMALLEST_LAYER]
    for key in large:
        values = tensors[key].astype(np.float32)
        largest = np.abs(values).max(axis=1)
        scales = np.where(largest > 0, largest / LARGEST_INTEGER, 1.0).astype(np.float32)
        tensors[key] = np.rint(values / scales[:, None]).astype(np.int8)
        tensors[key + SCALE] = scales
    with whole_file(out) as partial:
        save_file(tensors, partial, metadata=metadata)
    return large


def shipped_set_of(digests: Mapping[str, str]) -> str | None:
    """Find the shipped set that holds generators, simulator -> SHA-256; None if none holds all."""
    by_label = {label_of(simulator): digest for simulator, digest in digests.items()}
    for name in shipped_sets():
        files = open_set(name).files
        if by_label.items() <= {label: sha256_of([file]) for label, file in files.items()}.items():
            return name
    return None


def _described(arguments: argparse.Namespace, manifest: dict[str, Any]) -> Shipped:
    """A network file with its description."""
    path = arguments.training / f"{arguments.network}.yaml"
    training = json.loads((arguments.training / f"{path.stem}.training.json").read_text())
    network, collection = file_of(path, read_description(path)), manifest["plan"]
    card = {
        "network": path.stem,
        "parameters": sum(int(np.prod(one.dims)) for one in onnx.load(network).graph.initializer),
        "data": {"collection": collection, "images": training["images"]},
        "seeds": {"collection": collection["seed"], "training": training["plan"]["seed"], "assessment": arguments.seed},
        "commands": [
            f"./ds collect --out data --roads {collection['roads']} --seed {collection['seed']}",
            f"python examples/networks_of_today.py {path.stem} --data data --out trained",
            f"python tools/ship_network.py --data data --offline offline --training trained --network {path.stem}",
        ],
        "training": training["plan"],
        "loss": {"mean_squared_error": "of steering in [-1, 1]", "history": training["history"]},
    }
    return [network, path], str(path), card


def _offline(by_simulator: Mapping[str, OpenLoopAnswers]) -> dict[str, dict[str, float]]:
    """What a card says of the answers to another data set, by simulator.

    The gain is the slope of the network's steering over the autopilot's, by least squares through the origin.
    """
    card: dict[str, dict[str, float]] = {"images": {}, "mean_squared_error": {}, "steering_gain": {}}
    for name, answers in by_simulator.items():
        gain = float((answers.answered * answers.recorded).sum() / (answers.recorded**2).sum())
        card["images"][name] = len(answers.errors)
        card["mean_squared_error"][name] = round(float(np.mean(answers.absolute_errors**2)), 6)
        card["steering_gain"][name] = round(gain, 3)
    return card


def _success_rates(driver: str, roads: list[Road], seed: int) -> dict[str, dict[str, float]]:
    """Share of the roads that a driver completes on each simulator, by direction (paper 4.2.2)."""
    settings = DriveSettings(siblings=STANDARD, driver=DriverName(driver), gates="none")
    rates: dict[str, dict[str, float]] = {name: {} for name in STANDARD}
    for way, driven in (("forward", roads), ("reverse", [road.reversed() for road in roads])):
        for name, ends in drive_same_roads(settings, driven, seed, None, Callbacks()).items():
            completed = [one.outcome is Outcome.COMPLETED for one in ends if one.outcome.is_verdict]
            if len(completed) < len(roads):
                sys.exit(f"{name}, {way}: {len(roads) - len(completed)} drives ended in errors: fix them and try again")
            rates[name][way] = sum(completed) / len(roads)
    return rates


if __name__ == "__main__":
    main()
