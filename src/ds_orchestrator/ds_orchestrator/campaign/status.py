"""Progress of a campaign, stage by stage, and a list of the campaigns below a folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.folder import DRIVER_SHA256, STAGES, CampaignData, config_of, open_store
from ds_orchestrator.maps.campaign_maps import elites_of
from ds_orchestrator.store.folder_files import is_locked
from ds_orchestrator.store.model import Execution
from ds_orchestrator.store.sqlite_file import StoreError
from ds_sim.simulator import Outcome


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Progress of one stage.

    Attributes:
        name: `search bullet, run 0`, `migration: bullet to softbody`, `twin: bullet to donkey`, `maps`, ...
        done: executions with a verdict and excluded tests, or 1 for a result that is up to date.
        expected: total when the stage is done; None while it is not known.
        failures: number of executions in which the driver failed; None for a result.
        excluded: number of tests by which no network can be judged there; they are done.
    """

    name: str
    done: int
    expected: int | None
    failures: int | None = None
    excluded: int = 0

    @property
    def state(self) -> str:
        """`done`, `begun` or `to do`."""
        if self.expected is not None and self.done >= self.expected:
            return "done"
        return "begun" if self.done else "to do"


def stages_of(data: CampaignData) -> list[Stage]:
    """List every stage in the order in which they run."""
    config, tests, executions = data.config, data.tests, data.verdicts
    of_test = {test.test_id: test for test in tests}
    budget = config.settings.budget
    groups: dict[tuple[str, int, str], list[Execution]] = {}
    for execution in executions:
        test = of_test[execution.test_id]
        groups.setdefault((test.sibling, test.run, execution.simulator), []).append(execution)
    excluded: dict[tuple[str, int, str], int] = {}
    for test_id, simulator in data.excluded:
        key = (of_test[test_id].sibling, of_test[test_id].run, simulator)
        excluded[key] = excluded.get(key, 0) + 1
    stages = []
    for sibling in config.siblings:
        for run in range(config.search.runs):
            found = groups.get((sibling, run, sibling), [])
            stages.append(
                _stage(f"search {sibling}, run {run}", found, budget, excluded.get((sibling, run, sibling), 0))
            )
    searched = len(tests) == budget * config.search.runs * len(config.siblings)
    migrated = {test.test_id for test in tests}
    if config.elites_only:
        migrated = elites_of(tests, executions, data.cells, ignored=data.given_up)
        decided = {e.test_id for e in executions if of_test[e.test_id].sibling == e.simulator} | set(data.given_up)
        decided |= {test_id for test_id, simulator in data.excluded if of_test[test_id].sibling == simulator}
        searched = searched and set(of_test) <= decided
    for target in config.simulators:
        for origin in config.siblings:
            if origin != target:
                runs = range(config.search.runs)
                found = [e for run in runs for e in groups.get((origin, run, target), [])]
                role = "twin" if target == config.twin else "migration"
                expected = sum(of_test[test_id].sibling == origin for test_id in migrated) if searched else None
                left_out = sum(excluded.get((origin, run, target), 0) for run in runs)
                stages.append(_stage(f"{role}: {origin} to {target}", found, expected, left_out))
    count = data.result_count
    return [*stages, *(Stage(name=name, done=int(data.results.get(name) == count), expected=1) for name in STAGES)]


def is_driven(data: CampaignData) -> bool:
    """Check whether every driving stage is done, so that resuming the campaign needs no graph."""
    return all(stage.state == "done" for stage in stages_of(data) if stage.failures is not None)


def _stage(name: str, executions: Iterable[Execution], expected: int | None, excluded: int) -> Stage:
    found = list(executions)
    failures = sum(e.outcome.is_failure for e in found)
    return Stage(name=name, done=len(found) + excluded, expected=expected, failures=failures, excluded=excluded)


DEEPEST = 3
"""Levels of folders that are looked into; chosen: deep enough for a folder of campaigns, quick in a home folder."""


@dataclass(frozen=True, kw_only=True)
class CampaignRow:
    """One campaign of a list.

    Attributes:
        folder: campaign folder.
        driver: name of the driver; "" if the campaign cannot be read.
        sha256: digest of the driver's files, or "".
        changed: time of the last drive, ISO 8601, UTC.
        state: `done`, `running`, `stopped`, or why it cannot be read.
        drives: number of drives with a verdict.
        drives_at_most: their number at the end.
        failures: simulator -> failures and drives.
    """

    folder: Path
    driver: str = ""
    sha256: str = ""
    changed: str
    state: str
    drives: int = 0
    drives_at_most: int = 0
    failures: dict[str, tuple[int, int]] = field(default_factory=dict)


def campaigns_below(folder: Path) -> Iterator[CampaignRow]:
    """Find campaigns, by path; a damaged one is in the list, with the reason."""
    for path in sorted(_stores(folder, DEEPEST)):
        yield _row(path.parent)


def _stores(folder: Path, depth: int) -> Iterator[Path]:
    try:
        if (folder / "campaign.sqlite").is_file():
            yield folder / "campaign.sqlite"
            return
        inside = [entry for entry in folder.iterdir() if entry.is_dir() and not entry.is_symlink()] if depth else []
    except OSError:  # a folder of somebody else's
        return
    for entry in inside:
        if not entry.name.startswith("."):
            yield from _stores(entry, depth - 1)


def _row(folder: Path) -> CampaignRow:
    changed = max(path.lstat().st_mtime for path in folder.glob("campaign.sqlite*"))
    written = datetime.fromtimestamp(changed, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    try:
        with closing(open_store(folder)) as store:
            config, counts = config_of(store), store.outcome_counts()
            excluded = sum(not gate.is_valid for gate in store.gates().values())
            made, current = store.results().get("report"), store.count_results()
            sha256 = store.notes().get(DRIVER_SHA256, "")
    except (StoreError, ConfigError, OSError) as error:
        return CampaignRow(folder=folder, changed=written, state=str(error))
    tally = dict.fromkeys(config.simulators, (0, 0))
    for (simulator, outcome), number in counts.items():
        failures, drives = tally[simulator]
        tally[simulator] = failures + number * Outcome[outcome].is_failure, drives + number
    drives = sum(counts.values())
    complete = config.elites_only or drives + excluded >= config.executions_at_most
    state = "running" if is_locked(folder) else "done" if complete and made == current else "stopped"
    return CampaignRow(
        folder=folder,
        driver=config.driver,
        sha256=sha256,
        changed=written,
        state=state,
        drives=drives,
        drives_at_most=config.executions_at_most,
        failures=tally,
    )
