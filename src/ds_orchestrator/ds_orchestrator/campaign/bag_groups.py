"""Groups a campaign's bags by map cell or by search run for packing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

from ds_bags.layout import BagError
from ds_orchestrator.campaign.folder import config_of, open_store
from ds_orchestrator.maps.campaign_maps import cells_of
from ds_orchestrator.store.model import Execution

By = Literal["cell", "run"]
NO_CELL = "no_cell"
"""Pack of tests without a cell: a feature needs a run on their own sibling, which is missing."""


def missing_bags(campaign: Path, executions: Sequence[Execution]) -> list[str]:
    """List recorded bags that no longer exist, relative to the campaign folder."""
    named = (execution.bag for execution in executions if execution.bag)
    return sorted(bag for bag in named if not (campaign / bag / "metadata.yaml").is_file())


def missing_line(missing: Sequence[str]) -> str:
    """Describe missing bags in one line."""
    return f"{len(missing)} recorded bag{'s are' if len(missing) != 1 else ' is'} missing, {missing[0]} the first"


def groups_of(campaign: Path, by: By, *, say: Callable[[str], None] = lambda line: None) -> dict[str, list[Path]]:
    """Group the bags in a campaign folder.

    Args:
        campaign: campaign folder.
        by: `cell` for the cells of the campaign's own feature map, `run` for the runs of its searches.
        say: called with one line if bags are missing.

    Returns:
        Name of a pack, such as `cell_3_17` (bins of the features in the configuration's order) or `bullet-0`, -> bags.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds no campaign.
        BagError: the campaign has no bags.
    """
    with closing(open_store(campaign)) as store:
        config, tests, executions, gates = config_of(store), store.tests(), store.executions(), store.gates()
    cells = cells_of(
        tests, executions, features=config.features, maxitwo_compatible=config.maxitwo_compatible, gates=gates
    )
    groups: dict[str, list[Path]] = {}
    missing = missing_bags(campaign, executions)
    for execution in sorted(executions, key=lambda e: e.bag):
        folder = campaign / execution.bag
        if not execution.bag or not (folder / "metadata.yaml").is_file():
            continue
        if by == "run":
            name = execution.test_id.rpartition("-")[0]
        else:
            cell = cells.get(execution.test_id)
            name = NO_CELL if cell is None else "_".join(("cell", *map(str, cell)))
        groups.setdefault(name, []).append(folder)
    if not groups:
        raise BagError(f"{campaign} has no bags: they are packed already, or its configuration has `record: none`")
    if missing:
        say(f"{missing_line(missing)}: left out")
    return dict(sorted(groups.items()))
