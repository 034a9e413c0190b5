# SPDX-License-Identifier: Apache-2.0
"""Time per stage over several sessions."""

from __future__ import annotations

from pathlib import Path

from ds_orchestrator.store.store import Store, seconds_of


def test_stages_add_up_over_sessions(tmp_path: Path) -> None:
    store = Store(tmp_path / "campaign.sqlite", config="{}")
    for stage, seconds in (("search", 2.5), ("twin", 7.5), ("search", 1.0)):
        store.add_seconds(stage, seconds)
    store.note("another fact", "3")
    assert seconds_of(store.notes()) == {"twin": 7.5, "search": 3.5}
