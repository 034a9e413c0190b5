# SPDX-License-Identifier: Apache-2.0
"""Drives the paper's campaign: six networks, five runs on each sibling, every test on the other and on the twin.

`nice -n 19 python -m benchmarks.replication.drive FOLDER` from the root of the repository, at any time and as often as
needed: it resumes from the tables in `docs/data/replication`, where outcomes are kept as they grow, or from FOLDER.
`--backend openvino` goes on where the processor has no bfloat16; the network's card then says from which execution on.
"""

from __future__ import annotations

import argparse
import shutil
import threading
import time
from contextlib import closing
from pathlib import Path

from benchmarks.replication.networks import BACKEND
from benchmarks.replication.stored import restore

from ds_analysis.common.parquet import write_tables
from ds_orchestrator.campaign.config import CampaignConfig, read_config
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_studies.whole_campaign import run_campaign

NETWORKS = ("dave2", "chauffeur", "epoch", "dave2_real", "chauffeur_real", "epoch_real")
WEIGHTS = Path("benchmarks/replication/networks")
TABLES = Path("docs/data/replication")
KEEP_EVERY = 200
"""Executions between two tables; chosen: some minutes."""


def config_of(network: str, backend: str, workers: int) -> CampaignConfig:
    """The paper's campaign for one network, without bags."""
    paper = read_config(Path("src/ds_bringup/config/paper.yaml"))
    driver = f"{WEIGHTS / network}.safetensors@{backend}"
    return paper.model_copy(update={"driver": driver, "engine": "local", "workers": workers, "record": "none"})


class Keeper(Listener):
    """Writes the table of a campaign's executions as it grows."""

    def __init__(self, network: str, folder: Path) -> None:
        self._network = network
        self._folder = folder
        self._fresh = 0
        self._lock = threading.Lock()
        self._began = time.monotonic()

    def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
        """Count an execution."""
        with self._lock:
            self._fresh += fresh
            if fresh and self._fresh % KEEP_EVERY == 0:
                self.keep()

    def keep(self) -> None:
        """Write the table."""
        with closing(open_store(self._folder)) as store:
            data = read_campaign(store)
        (written,) = write_tables(data, self._folder / "tables")
        TABLES.mkdir(parents=True, exist_ok=True)
        partial = TABLES / f".{self._network}.part"
        shutil.copyfile(written, partial)
        partial.replace(TABLES / f"{self._network}.parquet")
        pace = (time.monotonic() - self._began) / max(self._fresh, 1)
        print(f"{self._network}: {len(data.executions)} executions, {pace:.2f} s each", flush=True)


def main() -> None:
    """Drive every network whose weights were chosen, in the paper's order."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="campaign folders, one per network")
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=NETWORKS)
    parser.add_argument("--backend", default=BACKEND)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    for network in arguments.networks:
        folder, table = arguments.folder / network, TABLES / f"{network}.parquet"
        if not (WEIGHTS / f"{network}.safetensors").exists():
            print(f"{network}: no weights in {WEIGHTS} yet")
            continue
        if table.exists() and not (folder / "campaign.sqlite").exists():
            restore(table, folder, backend=arguments.backend)
        keeper = Keeper(network, folder)
        config = config_of(network, arguments.backend, arguments.workers)
        outcome = run_campaign(config, folder, keeper)
        if outcome.executions_in_error:
            print(f"{network}: {outcome.executions_in_error} executions ended in errors; the same command tries again")
        keeper.keep()


if __name__ == "__main__":
    main()
