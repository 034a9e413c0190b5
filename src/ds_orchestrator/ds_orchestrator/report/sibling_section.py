"""Section of the report on what each sibling adds: sentences, tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.evaluation.table import Table
from ds_orchestrator.report.data_address import data_address
from ds_orchestrator.siblings.analysis import analyse, analysis_tables
from ds_orchestrator.siblings.outcomes import outcomes_of_campaign
from ds_orchestrator.siblings.pictures import draw_failures, draw_matrix


@dataclass(frozen=True, kw_only=True)
class SiblingSection:
    """What each sibling adds, for a page.

    Attributes:
        roads: number of roads with a verdict on every simulator.
        sentences: one line for each sibling.
        tables: baseline, residual correlations, information.
        pictures: title and `data:` address of each picture.
    """

    roads: int
    sentences: Sequence[str]
    tables: Sequence[Table]
    pictures: Sequence[tuple[str, str]]


def sibling_section(data: CampaignData) -> SiblingSection | None:
    """Analyse the tests of a campaign that were driven on every simulator; None without any, or with one simulator."""
    outcomes = outcomes_of_campaign(data)
    if len(outcomes.simulators) < 2 or not outcomes.roads:
        return None
    config = data.config
    found = analyse(outcomes, [config.twin] if config.twin else config.siblings)
    return SiblingSection(
        roads=len(outcomes.roads),
        sentences=found.sentences,
        tables=analysis_tables(found),
        pictures=[
            (f"Largest lateral position over {found.feature}", data_address(draw_failures(outcomes, found.feature))),
            ("Who fails where", data_address(draw_matrix(outcomes, found.feature))),
        ],
    )
