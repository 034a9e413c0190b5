# SPDX-License-Identifier: Apache-2.0
"""Drives the tests of each campaign's first run on `panda`, too, and keeps all outcomes as a campaign of three.

`nice -n 19 python -m benchmarks.replication.third_sibling FOLDER` from the root of the repository; it resumes from
FOLDER. `python -m benchmarks.replication.stored` makes a campaign of such a table, which `ds evaluate` reads.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from benchmarks.replication.drive import NETWORKS, TABLES
from benchmarks.replication.stored import read, write_table
from benchmarks.replication.tables import THIRD, THIRD_RUN, of_runs, third_table

from ds_cli.progress import ScreenListener
from ds_orchestrator.engines.drive_tests import Callbacks, drive_tests


def main() -> None:
    """Drive, and write a table beside each campaign's."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="drives, one folder per network")
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=NETWORKS[:3])
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    for network in arguments.networks:
        table = third_table(network)
        if table.exists():
            print(f"{network}: {table} is there; remove it to drive again")
            continue
        data = of_runs(read(TABLES / f"{network}.parquet"), {THIRD_RUN})
        here = data.config.model_copy(update={"engine": "local", "workers": arguments.workers})
        settings = replace(here.drive_settings(), siblings=(THIRD,), twin=None)
        progress = Callbacks(listen=ScreenListener)
        results = drive_tests(settings, {THIRD: data.tests}, arguments.folder / network, progress)
        config = here.model_copy(update={"siblings": [*here.siblings, THIRD]})
        driven = replace(data, config=config, executions=(*data.executions, *results.executions.values()))
        write_table(driven, table)
        print(f"{network}: {len(results.executions)} of {len(data.tests)} tests driven on {THIRD}")


if __name__ == "__main__":
    main()
