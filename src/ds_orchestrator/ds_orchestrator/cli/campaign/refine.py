"""`ds campaign refine`: spends drives on the siblings where the prediction is disputed."""

from __future__ import annotations

import shlex
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from ds_orchestrator.cli.campaign.engine_options import (
    EngineName,
    Listen,
    Scheduler,
    TlsCa,
    TlsCert,
    TlsKey,
    Unencrypted,
    Workers,
    cluster_of,
    with_engine,
)
from ds_orchestrator.cli.campaign.run import stored_config
from ds_orchestrator.cli.options import Folder, JsonFlag, Trust
from ds_orchestrator.cli.output import Interrupted, Result, duration, end, say

if TYPE_CHECKING:
    from ds_orchestrator.campaign.config import CampaignConfig
    from ds_orchestrator.engines.cluster import ClusterOptions
    from ds_orchestrator.evaluation.table import Table
    from ds_orchestrator.refinement.refine import Assessment

campaign_app = typer.Typer()


def refine_campaign(
    folder: Path, config: CampaignConfig, budget: int, *, tolerated: float, cluster: ClusterOptions, trusted: list[str]
) -> Result:
    """Drive new tests of the disputed cells on the siblings, and write the report again.

    Raises:
        ds_orchestrator.refinement.refine.RefinementError: the budget is impossible.
        ds_orchestrator.prediction.outcome_table.OutcomeTableError: the campaign has too few tests.
        Interrupted: the user stopped it; finished drives are kept.
    """
    from ds_orchestrator.campaign.campaign_data import read_campaign
    from ds_orchestrator.campaign.folder import locked, open_store, refuse_foreign_files
    from ds_orchestrator.campaign.provenance import record_provenance
    from ds_orchestrator.campaign.runner import Stopped
    from ds_orchestrator.cli.progress import ScreenListener
    from ds_orchestrator.comparison.given_tests import Engine
    from ds_orchestrator.refinement.refine import check_budget, refine
    from ds_orchestrator.run import rebuild_report

    check_budget(config, budget)
    refuse_foreign_files(folder)
    with locked(folder):
        with closing(open_store(folder)) as store:
            data = read_campaign(store)
            record_provenance(store, config, folder)
        _hint_unfinished(folder, data)
        say(f"{len(data.tests)} tests on {', '.join(config.siblings)}: fitting the population of simulators")
        try:
            found = refine(
                folder, data, config, budget, Engine(listen=ScreenListener, cluster=cluster, say=say),
                tolerated=tolerated,
            )  # fmt: skip
        except (KeyboardInterrupt, Stopped):
            again = f"ds campaign refine {shlex.quote(str(folder))} --budget N"
            raise Interrupted(f"finished drives are kept; `{again}` goes on with those it began") from None
        report = folder / "report.html"
        if found.spent and report.exists():
            rebuild_report(folder, say=say, trusted=trusted)
    document = found.document()
    table = _cell_table(config, document["cells"])

    def show() -> None:
        table.show(Console())
        print(found.sentence)
        print(found.stopped)
        if report.exists():
            print(report)

    return Result(document=document, show=show, error=found.in_error > 0)


def plan_refinement(folder: Path, config: CampaignConfig, budget: int, *, tolerated: float) -> Result:
    """Say what a refinement would do; nothing is driven or written.

    Raises:
        ds_orchestrator.refinement.refine.RefinementError: the budget is impossible.
        ds_orchestrator.prediction.outcome_table.OutcomeTableError: the campaign has too few tests.
    """
    from ds_orchestrator.campaign.campaign_data import read_campaign
    from ds_orchestrator.campaign.folder import open_store
    from ds_orchestrator.refinement.refine import assess, begun_work, cell_rows, check_budget

    check_budget(config, budget)
    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    _hint_unfinished(folder, data)
    now = assess(folder, data, tolerated=tolerated)
    each = len(config.siblings)
    needed = [now.evidence[one.cell].tests_needed for one in now.targets]
    wanted = None if None in needed else sum(n for n in needed if n is not None) * each
    begun = sum(map(len, begun_work(now.data, budget).values()))
    document: dict[str, Any] = {
        "budget": budget,
        "drives_a_test": each,
        "drives_begun": begun,
        "drives_needed": wanted,
        "seconds": _seconds(now, budget if wanted is None else min(budget, wanted + begun)),
        "cells": cell_rows(now, now),
    }
    table = _cell_table(config, document["cells"])

    def show() -> None:
        table.show(Console())
        print(
            f"{now.verdicts.counts['disputed']} disputed cells, {len(now.targets)} of them not settled on the siblings"
        )
        if not now.targets:
            print("nothing to drive: only drives on the car tell more")
            return
        many = "more drives than can be said" if wanted is None else f"about {wanted} drives, {each} a test,"
        fits = "" if wanted is None or wanted > budget else ", which the budget allows"
        print(
            f"{many} would settle them if failures keep coming at the rates seen so far{fits}; the budget is {budget}"
        )
        if begun:
            print(f"{begun} drives of an earlier refinement come first")
        if document["seconds"] is not None:
            print(f"about {duration(document['seconds'])}, at the pace of the campaign's own drives")

    return Result(document=document, show=show)


def _hint_unfinished(folder: Path, data: Any) -> None:
    from ds_orchestrator.campaign.status import is_driven

    if not is_driven(data):
        say(f"the campaign is not finished: `ds campaign resume {shlex.quote(str(folder))}` first adds its own tests")


def _seconds(now: Assessment, drives: int) -> float | None:
    """Wall-clock time of drives at the pace of the campaign's; None if that is not known."""
    from ds_orchestrator.campaign.folder import STAGES
    from ds_orchestrator.campaign.refined_data import is_refined
    from ds_orchestrator.campaign.stage_timer import seconds_of

    took = sum(value for name, value in seconds_of(now.data.notes).items() if name not in STAGES)
    own = sum(not is_refined(one.test_id) for one in now.data.executions)
    return took / own * drives if took and own else None


def _cell_table(config: CampaignConfig, cells: list[dict[str, Any]]) -> Table:
    from ds_orchestrator.evaluation.table import Column, Table
    from ds_orchestrator.search.features import feature_of

    axes = [feature_of(name) for name in config.features]
    return Table(
        name="refined_cells",
        title="Disputed cells",
        columns=[
            *(Column(name) for name in config.features), Column("before"), Column("now"),
            Column("failure rate", "number"), Column("90 %", "number"),
            *(Column(f"{name}, failures/tests") for name in config.siblings), Column("on the siblings"),
            Column("tests needed", "count"), Column("new tests", "count"),
        ],
        rows=[
            (
                *(axis.label(bin_) for axis, bin_ in zip(axes, one["cell"], strict=True)), one["before"],
                one["verdict"], one["rate"], one["interval"],
                *(f"{f}/{n}" for f, n in zip(one["siblings"]["failures"], one["siblings"]["tests"], strict=True)),
                one["siblings"]["agreement"], one["siblings"]["tests_needed"], one["new_tests"],
            )
            for one in cells
        ],
        notes=[
            "tests needed: on every sibling, until the failure rate on each is above or below the tolerated one with "
            "95 %, if failures keep coming at the rates seen so far"
        ],
    )  # fmt: skip


@campaign_app.command("refine")
def campaign_refine_command(
    folder: Folder,
    budget: Annotated[int, typer.Option(min=1, help="Drives on the siblings at most.")],
    tolerated: Annotated[
        float, typer.Option(min=0.001, max=0.999, help="Failure rate up to which a cell counts as safe.")
    ] = 0.1,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say which cells need how many tests; nothing is driven.")
    ] = False,
    workers: Workers = None,
    engine: EngineName = None,
    scheduler: Scheduler = None,
    listen: Listen = "127.0.0.1",
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    unencrypted: Unencrypted = False,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """Drive new tests in the cells that `ds predict` calls disputed, on all siblings, until these are settled there.

    New tests are mutants of a cell's own, the most uncertain cells come first, and a cell is left alone as soon as its
    failure rate on every sibling is above or below the tolerated one with 95 %. Kept in DIR/refinement: `ds predict`,
    `ds real`, `ds maps --refined` and the report's first map use them, the paper's maps and tables do not. Stopped, the
    same command goes on with the drives that it began.
    """
    cluster = cluster_of(scheduler, listen, tls_ca, tls_cert, tls_key, unencrypted)
    config = with_engine(stored_config(folder, trust), workers, engine)
    if dry_run:
        end(plan_refinement(folder, config, budget, tolerated=tolerated), as_json)
        return
    end(refine_campaign(folder, config, budget, tolerated=tolerated, cluster=cluster, trusted=trust or []), as_json)
