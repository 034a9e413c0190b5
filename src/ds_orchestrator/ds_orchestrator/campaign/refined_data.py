"""Tests that `ds campaign refine` added to a campaign; kept apart, so that the paper's tables stay the paper's."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.store.store import Store

FOLDER = "refinement"
"""Folder of the added tests within a campaign's."""
DRIVES_FILE = "drives.sqlite"
"""Store of drives of given tests; not a campaign's file, as no search can resume from it."""
PREFIX = "refine-0-"
"""Ids of added tests are this and their number."""
MOST_TESTS = 10_000
"""Numbers of added tests; chosen: as many as a search's population may have."""


def refined_config(config: CampaignConfig) -> CampaignConfig:
    """The configuration under which added tests are driven: on the siblings alone."""
    search = config.search.model_copy(update={"population": MOST_TESTS})
    return config.model_copy(update={"search": search, "twin": None})


def is_refined(test_id: str) -> bool:
    """Whether a test was added by a refinement."""
    return test_id.startswith(PREFIX)


def with_refinement(folder: Path, data: CampaignData) -> CampaignData:
    """Add the tests of a campaign's refinement, driven or not; the campaign as it is without any.

    Drives of the campaign come first: where both know a test on a simulator, its own count.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the refinement's file is damaged, or of another campaign.
    """
    path = folder / FOLDER / DRIVES_FILE
    if not path.exists():
        return data
    config = refined_config(data.config)
    with closing(Store(path)) as store:
        store.check(config.siblings, config.siblings, runs=config.search.runs, budget=config.settings.budget)
        tests, executions, gates, errors = store.tests(), store.executions(), store.gates(), store.errors()
    known = {test.test_id for test in data.tests}
    driven = {(one.test_id, one.simulator) for one in data.executions}
    return replace(
        data,
        tests=(*data.tests, *(test for test in tests if test.test_id not in known)),
        executions=(*data.executions, *(one for one in executions if (one.test_id, one.simulator) not in driven)),
        gates={**gates, **data.gates},
        errors=(*data.errors, *errors),
    )
