# SPDX-License-Identifier: Apache-2.0
"""Drives the study of when two siblings are better than one, part by part, in the order of the plan.

`nice -n 19 python -m benchmarks.when_to_merge.drive FOLDER` from the root of the repository, as often as needed: parts
that have a table are skipped, and a part that was stopped goes on from FOLDER. It says how many are driven, never how
they ended.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from contextlib import closing, nullcontext
from pathlib import Path

import pyarrow.parquet as pq
from benchmarks.replication.drive import TABLES as CAMPAIGN_TABLES
from benchmarks.replication.stored import write_table
from benchmarks.when_to_merge import plan
from benchmarks.when_to_merge.plan import PARTS, SIBLINGS, Part

from ds_base.folder_files import locked
from ds_orchestrator.campaign.config import CampaignConfig, read_config
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.folder import CampaignData, prepare_folder, read_campaign, record_provenance, store_of
from ds_orchestrator.campaign.runner import Campaign
from ds_orchestrator.engines.drive_tests import Callbacks, drive_tests
from ds_orchestrator.engines.start import running_engine
from ds_orchestrator.store.model import Execution, Origin, Test
from ds_road import road_from_json
from ds_sim.conditions.text import parse_conditions
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario

SAY_EVERY = 20
"""Drives between two lines of progress."""


class Counter(Listener):
    """Says how many tests of a part are driven, and how long the others and those of later parts will take."""

    def __init__(self, part: Part) -> None:
        self._part, self._after = part, sum(one.expected for one in PARTS[PARTS.index(part) + 1 :])
        self._done = self._fresh = 0
        self._began = time.monotonic()

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """Count a drive, whatever its outcome."""
        self._done += 1
        self._fresh += fresh
        if self._done % SAY_EVERY == 0 and self._fresh:
            pace, left = (time.monotonic() - self._began) / self._fresh, self._part.expected - self._done
            times = (
                f"{pace:.2f} s each, {pace * left / 60:.0f} min left, {pace * (left + self._after) / 3600:.1f} h in all"
            )
            print(f"{time.strftime('%H:%M:%S')} {self._part.name}: {self._done} of {self._part.expected}, {times}")


def config_of(part: Part, siblings: Sequence[str], twin: str | None = None) -> CampaignConfig:
    """The campaign to which a part's drives belong, with one run on each sibling."""
    config = read_config(plan.CONFIGS[part.block == "C"])
    changes = {
        "engine": "local",
        "workers": 1,
        "record": "none",
        "driver": f"{plan.DRIVERS[part.network]}@{plan.BACKEND}",
    }
    one_run = config.search.model_copy(update={"runs": 1})
    return config.model_copy(update={**changes, "search": one_run, "siblings": list(siblings), "twin": twin})


def tests_of(part: Part, tables: Path) -> list[Test]:
    """Tests that a part drives: drawn from the campaign's first run, or from the searches of this study."""
    files = [CAMPAIGN_TABLES / f"{part.network}.parquet"]
    if part.block == "C" or part.network in plan.SHIPPED:
        searching = SIBLINGS if part.block == "C" else plan.ORIGINS
        files = [tables / f"{part._replace(where=one, searches=True).name}.parquet" for one in searching]
    tests: dict[str, Test] = {}
    for row in (row for file in files for row in pq.read_table(file, filters=[("run", "==", 0)]).to_pylist()):
        conditions = parse_conditions(plan.HAZE if part.where == "haze" else row["conditions"])
        scenario = Scenario(road_from_json(json.loads(row["road"])), conditions, seed=row["seed"])
        origin = Origin(row["sibling"], row["run"], row["number"])
        tests.setdefault(row["test_id"], Test(row["test_id"], scenario, origin))
    drawn = plan.drawn({test.test_id: test.sibling for test in tests.values()})
    return [test for test in tests.values() if test.test_id in drawn and test.sibling != part.where]


def search(part: Part, folder: Path) -> CampaignData:
    """Run a search on one sibling, as a campaign of all of them does: a run's seed depends on its sibling alone."""
    config = config_of(part, [part.where])
    prepare_folder(folder)
    with locked(folder), closing(store_of(folder, config)) as store:
        record_provenance(store, config.drive_settings(), folder)
        with running_engine(config.drive_settings(), logs=folder / "logs") as engine:
            Campaign(config, folder, store, engine, Counter(part)).run()
        return read_campaign(store)


def drive(part: Part, tests: Sequence[Test], folder: Path) -> CampaignData:
    """Drive given tests."""
    simulator = SimulatorName(plan.SIMULATORS.get(part.where, part.where))
    settings = config_of(part, [simulator]).drive_settings()
    for _ in range(plan.PASSES):
        progress = Callbacks(listen=lambda: nullcontext(Counter(part)))
        found = drive_tests(settings, {simulator: tests}, folder, progress)
        if not found.errors:
            break
    for (test_id, _), error in found.errors.items():
        print(f"{part.name}: {test_id} has no verdict: {error}")
    origins = sorted({test.sibling for test in tests} | ({simulator} & set(SIBLINGS)))
    config = config_of(part, origins, None if simulator in origins else simulator)
    executions = tuple(found.executions.values())
    return CampaignData(config=config, tests=tuple(tests), executions=executions, gates=found.gates)


def main() -> None:
    """Drive every part that has no table yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="drives, one folder per part")
    parser.add_argument("--tables", type=Path, default=plan.TABLES, help="where the tables of whole parts are kept")
    arguments = parser.parse_args()
    plan.check_weights()
    arguments.tables.mkdir(parents=True, exist_ok=True)
    for part in PARTS:
        table, folder = arguments.tables / f"{part.name}.parquet", arguments.folder / part.name
        if not table.exists():
            data = search(part, folder) if part.searches else drive(part, tests_of(part, arguments.tables), folder)
            write_table(data, table)
            print(f"{part.name}: whole, {len(data.verdicts)} of {part.expected} with a verdict")


if __name__ == "__main__":
    main()
