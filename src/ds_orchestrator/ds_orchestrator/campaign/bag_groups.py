"""Groups a campaign's bags by map cell or by search run, to be packed together."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ds_bags.layout import BagError
from ds_orchestrator.store.store import Store

By = Literal["cell", "run"]


def groups_of(campaign: Path, by: By) -> dict[str, list[Path]]:
    """Name of a pack -> the campaign's bags that belong in it, as far as they are there.

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
    return dict(sorted(groups.items()))
