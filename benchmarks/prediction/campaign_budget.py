"""What a few drives on a car are worth after a campaign: each simulator in turn is the twin that was never driven.

`python -m benchmarks.prediction.campaign_budget CAMPAIGN... --out budget` takes the outcomes of whole campaigns, whose
tests the search made hard, and drives nothing. Every simulator of a campaign, the twin among them, is predicted from
the others after 0, 2, 4, 8 and 16 drives, by the rules and scores of `benchmarks.prediction.real_budget`, and tests
without a verdict on one of the simulators are left out. Intervals are 95 % of 2,000 resamples of twins and of families
of mutants at the same time.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

from benchmarks.prediction.budget_scores import BUDGETS, Case, Scored, score, tables_of
from rich.console import Console

from ds_analysis.common.outcome_table import table_of_campaign
from ds_analysis.common.table import write_tables
from ds_cli.output import countdown, say
from ds_orchestrator.campaign.folder import open_store, read_campaign


def cases_of(folder: Path) -> list[Case]:
    """Make a case of every simulator of a campaign.

    Raises:
        CampaignError: the folder holds no campaign.
        OutcomeTableError: no test has a verdict yet.
    """
    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    whole = table_of_campaign(data).as_population()
    table = whole.select(whole.on_siblings)
    return [
        Case(
            network=f"{data.config.driver}, {folder.name}",
            group="in turn",
            name=name,
            outside="",
            table=table.with_twin(name),
            clusters=tuple(f"{folder.name}: {family}" for family in table.families),
        )
        for name in table.simulators
    ]


def main() -> None:
    """Score every campaign, then all of them together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaigns", type=Path, nargs="+", help="folders of campaigns with a twin")
    parser.add_argument("--out", type=Path, required=True, help="folder of the tables")
    arguments = parser.parse_args()
    cases = [case for folder in arguments.campaigns for case in cases_of(folder)]
    small = [case.name for case in cases if len(case.table) < max(BUDGETS)]
    if small:
        parser.error(f"too few tests for {max(BUDGETS)} drives: {', '.join(small)}")
    progress = countdown()
    scored: list[Scored] = []
    for case in cases:
        scored.append(score(case))
        progress(len(scored), len(cases), f"{case.network}: {case.name}, {len(case.table)} tests")
    groups = {one.case.network: [other for other in scored if other.case.network == one.case.network] for one in scored}
    if len(groups) > 1:
        groups["all campaigns"] = scored
    for name, of in groups.items():
        say(name)
        tables = tables_of(of)  # the last ones are those of all campaigns
        for table in tables:
            table.show(Console(width=180))
    write_tables(tables, arguments.out)


if __name__ == "__main__":
    main()
