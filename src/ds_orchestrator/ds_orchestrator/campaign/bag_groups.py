"""Groups a campaign's bags by map cell or by search run, to be packed together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from ds_bags.layout import BagError
from ds_orchestrator.store.store import Execution, Store

By = Literal["cell", "run"]


def missing_bags(campaign: Path, executions: Sequence[Execution]) -> list[str]:
    """Bags that were recorded and are no longer there, relative to the campaign folder."""
    named = (execution.bag for execution in executions if execution.bag)
    return sorted(bag for bag in named if not (campaign / bag / "metadata.yaml").is_file())


def missing_line(missing: Sequence[str]) -> str:
    """One line on missing bags."""
    return f"{len(missing)} recorded bag{'s are' if len(missing) != 1 else ' is'} missing, {missing[0]} the first"


def groups_of(campaign: Path, by: By, *, say: Callable[[str], None] = lambda line: None) -> dict[str, list[Path]]:
    """Name of a pack -> the bags of the campaign that belong in it, as far as they are there.

    Args:
        campaign: campaign folder.
        by: one pack per map cell, or per search run.
        say: called with one line if bags are missing.

    Raises:
        ds_orchestrator.store.store.StoreError: no campaign.
        BagError: a campaign without bags.
    """
    store = Store(campaign / "campaign.sqlite")
    try:
        tests = {test.test_id: test for test in store.tests()}
        executions = store.executions()
    finally:
        store.close()
    groups: dict[str, list[Path]] = {}
    missing = missing_bags(campaign, executions)
    for execution in sorted(executions, key=lambda e: e.bag):
        folder = campaign / execution.bag
        if execution.bag and (folder / "metadata.yaml").is_file():
            test = tests[execution.test_id]
            name = f"cell_{test.road.turns_count}_{test.road.curvature_bin}"
            if by == "run":
                name = execution.test_id.rpartition("-")[0]
            groups.setdefault(name, []).append(folder)
    if not groups:
        raise BagError(f"{campaign} has no bags: they are packed already, or its configuration has `record: none`")
    if missing:
        say(f"{missing_line(missing)}: left out")
    return dict(sorted(groups.items()))
