# SPDX-License-Identifier: Apache-2.0
"""Drives the paper's campaign: six networks, five runs on each sibling, every test on the other and on the twin.

`nice -n 19 python -m benchmarks.replication.drive FOLDER` from the root of the repository, as often as needed: it goes
on from FOLDER. Outcomes become the tables in `docs/data/replication`. `--backend openvino` is for processors without
bfloat16.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

from benchmarks.replication.stored import write_table

from ds_cli.progress import ScreenListener
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig, read_config
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_studies.whole_campaign import run_campaign

NETWORKS = ("dave2", "chauffeur", "epoch", "dave2_real", "chauffeur_real", "epoch_real")
STEPS = {"dave2": 283, "chauffeur": 283, "epoch": 565, "dave2_real": 400, "chauffeur_real": 565}
"""Batches after which a checkpoint was taken; `epoch_real` is the end of its training."""
WEIGHTS = Path("benchmarks/replication/networks")
TABLES = Path("docs/data/replication")
BACKEND = "openvino-bf16"
"""As `paper.yaml`: the same verdicts as single precision (docs/speed.md) in 0.7 of its processor time."""


def title_of(network: str) -> str:
    """Name of a network on pages and in pictures, where a shipped one has the same name: with its batches."""
    return f"{network}_{STEPS[network]}" if network in STEPS else network


def config_of(network: str, backend: str, workers: int) -> CampaignConfig:
    """The paper's campaign for one network, without bags."""
    paper = read_config(Path("src/ds_bringup/config/paper.yaml"))
    driver = DriverName.parse(f"{WEIGHTS / network}.safetensors@{backend}")
    return paper.model_copy(update={"driver": driver, "engine": "local", "workers": workers, "record": "none"})


def main() -> None:
    """Drive every network, in the paper's order."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="campaign folders, one per network")
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=NETWORKS)
    parser.add_argument("--backend", default=BACKEND)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    for network in arguments.networks:
        folder = arguments.folder / network
        outcome = run_campaign(config_of(network, arguments.backend, arguments.workers), folder, ScreenListener())
        if outcome.executions_in_error:
            print(f"{network}: {outcome.executions_in_error} executions ended in errors; the same command tries again")
        with closing(open_store(folder)) as store:
            write_table(read_campaign(store), TABLES / f"{network}.parquet")


if __name__ == "__main__":
    main()
