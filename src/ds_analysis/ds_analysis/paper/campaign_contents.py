# SPDX-License-Identifier: Apache-2.0
"""Maps of a campaign, and tests by which no network can be judged; imports no statistics, which take half a second."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from ds_base.table import Column, Table, styled
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.campaign_maps import build_maps
from ds_orchestrator.maps.feature_map import FeatureMap, MapId
from ds_sim.conditions.text import format_conditions
from ds_sim.gates.gate import GateState
from ds_sim.registry import SimulatorName


def maps_of(data: CampaignData, *, features: Sequence[str] | None = None) -> dict[MapId, FeatureMap]:
    """Build every map of a campaign, finished or not, over its features or over others."""
    config = data.config
    plan = config.map_plan(data.given_up)
    if features is not None:
        plan = replace(plan, features=tuple(features))
    return build_maps(config.siblings, config.twin, data.tests, data.executions, plan, gates=data.gates)


IN_WORDS = {
    GateState.NOT_APPLICABLE: "not applicable",
    GateState.INFEASIBLE: "infeasible",
    GateState.OUT_OF_ODD: "out of the operational design domain",
    GateState.OUT_OF_SIGHT: "out of what the recording shows",
}
"""States of excluded tests, in words."""


def exclusion_counts(data: CampaignData) -> dict[SimulatorName, dict[str, int]]:
    """Count excluded tests by simulator and state; simulators without any are left out."""
    gates = Counter((simulator, gate.state) for (_, simulator), gate in data.excluded.items())
    counts = {name: {state.value: gates[name, state] for state in IN_WORDS} for name in data.config.simulators}
    return {name: {state: n for state, n in of.items() if n} for name, of in counts.items() if any(of.values())}


def exclusion_lines(data: CampaignData) -> list[str]:
    """Describe excluded tests, one line for each simulator that has any."""
    judged = Counter(simulator for _, simulator in data.gates)
    return [
        f"{name}: {sum(counts.values())} of {judged[name]} gated tests enter no map: "
        + ", ".join(f"{n} {IN_WORDS[GateState(state)]}" for state, n in counts.items())
        for name, counts in exclusion_counts(data).items()
    ]


def excluded_table(data: CampaignData) -> Table:
    """Tabulate excluded tests, one row per test and simulator."""
    conditions = {test.test_id: format_conditions(test.conditions) for test in data.tests}
    return Table(
        name="excluded_tests",
        title="Tests by which no network can be judged",
        columns=[
            *styled("text", "test", "simulator", "state", "why"),
            *styled("number", "line contrast at the start", "share of road with invisible lines"),
            Column("conditions"),
        ],
        rows=[
            (
                test_id,
                simulator,
                IN_WORDS[gate.state],
                gate.message,
                None if gate.outcome is None else gate.visible_contrast,
                None if gate.outcome is None else gate.hidden_share,
                conditions.get(test_id, ""),
            )
            for (test_id, simulator), gate in data.excluded.items()
        ],
    )
