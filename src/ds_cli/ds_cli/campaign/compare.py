"""`ds campaign compare`: whether another network is better, where, and whether anything is worse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_cli.campaign.compare_plan import Plan, is_campaign, plan_of_campaigns, plan_of_networks
from ds_cli.campaign.compare_results import write_comparison
from ds_cli.campaign.engine_options import (
    EngineName,
    Listen,
    Scheduler,
    TlsCa,
    TlsCert,
    TlsKey,
    Unencrypted,
    Workers,
    cluster_of,
    with_engine_without_ros,
)
from ds_cli.campaign.pass_options import (
    FailOn,
    Junit,
    Markdown,
    MaxFailures,
    check_writable,
    criteria_of,
    unmet_by,
)
from ds_cli.options import Backend, JsonFlag, Trust, driver_named, simulators_of
from ds_cli.output import Interrupted, Result, end, say

if TYPE_CHECKING:
    from ds_analysis.comparison.criteria import Criteria
    from ds_orchestrator.engines.cluster import ClusterOptions

ROADS, SEED = 40, 40
"""Random roads of two networks, and their seed; chosen: those of `ds siblings compare`."""
SIMULATORS = "bullet,softbody,donkey"
"""Simulators of two networks: those of a campaign by default."""

campaign_app = typer.Typer()


def run_comparison(
    plan: Plan,
    out: Path,
    criteria: Criteria,
    *,
    engine: str | None,
    workers: int | None,
    cluster: ClusterOptions,
    junit: Path | None,
    markdown: Path | None,
) -> Result:
    """Drive what is missing, compare, and write every result.

    Args:
        plan: what is compared on what.
        out: folder for drives and results, created if missing.
        criteria: pass criteria.
        engine: name of the engine.
        workers: graphs or processes that drive at the same time.
        cluster: cluster of the engine `dask`.
        junit: JUnit XML to write, or None.
        markdown: summary to write elsewhere, too, or None.

    Raises:
        Interrupted: the user stopped it; finished drives are kept.
    """
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.campaign.executor import Stopped
    from ds_orchestrator.engines.drive_tests import Progress
    from ds_orchestrator.store.folder_files import make_folder
    from ds_studies.comparison.compare import compare

    check_writable(junit, markdown)
    make_folder(out)
    sets = [
        replace(tests, settings=with_engine_without_ros(tests.settings, workers, engine, cluster))
        for tests in plan.sets
    ]
    try:
        found = compare(
            sets, plan.reference, plan.candidate, origin=plan.origin, source=plan.source, out=out,
            progress=Progress(listen=ScreenListener, say=say),
        )  # fmt: skip
    except (KeyboardInterrupt, Stopped):
        raise Interrupted(f"finished drives are in {out}: the same command goes on") from None
    unmet = unmet_by(criteria, found)
    return write_comparison(found, out, unmet, junit=junit, markdown=markdown)


@campaign_app.command("compare")
def campaign_compare_command(
    first: Annotated[str, typer.Argument(metavar="A", help="Reference: a campaign folder, or a network.")],
    second: Annotated[
        str | None, typer.Argument(metavar="B", help="Candidate: a campaign folder, or a network.")
    ] = None,
    driver: Annotated[str | None, typer.Option(help="Candidate, a network; the same as B.")] = None,
    backend: Backend = "auto",
    out: Annotated[
        Path, typer.Option(help="Folder for drives and results; a comparison that was stopped there goes on.")
    ] = Path("comparison"),
    roads: Annotated[
        int | None, typer.Option(min=1, max=10_000, help=f"For two networks: random roads; {ROADS} if left out.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**32 - 1, help=f"For two networks: seed; {SEED} if left out.")
    ] = None,
    sims: Annotated[
        str | None, typer.Option(help=f"For two networks: simulators, by commas; {SIMULATORS} if left out.")
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Drive the reference again, too, instead of reading its outcomes.")
    ] = False,
    fail_on: FailOn = None,
    max_failures: MaxFailures = None,
    junit: Junit = None,
    markdown: Markdown = None,
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
    """Compare two networks on the same tests: is one better, where, and is anything worse?

    A and B are two campaigns of one configuration, a campaign and a network, or two networks, which drive random roads.
    What one of them has not driven is driven, without ROS unless --engine says otherwise. Writes comparison.html,
    comparison.md and comparison.json under --out.
    """
    from ds_analysis.comparison.drives import ComparisonError

    if (second is None) == (driver is None):
        raise ComparisonError(
            "expected one candidate, as in `ds campaign compare A B` or `ds campaign compare A --driver B`"
        )
    candidate = second or str(driver)
    if not is_campaign(candidate):
        candidate = driver_named(candidate, backend, "cpu")
    criteria = criteria_of(fail_on, max_failures, has_reference=True)
    if is_campaign(first):
        for name, value in (("--roads", roads), ("--seed", seed), ("--sims", sims)):
            if value is not None:
                raise ComparisonError(f"{name} is for two networks: {first} has its own tests")
        plan = plan_of_campaigns(Path(first), candidate, trust)
        if again:
            plan = replace(plan, sets=[replace(tests, reference={}) for tests in plan.sets])
    elif is_campaign(candidate):
        raise ComparisonError(f"{first} is no campaign folder: give the campaign first, then the network")
    else:
        names = simulators_of(sims or SIMULATORS)
        plan = plan_of_networks(first, candidate, names, roads or ROADS, SEED if seed is None else seed)
    result = run_comparison(
        plan, out, criteria, engine=engine, workers=workers,
        cluster=cluster_of(scheduler, listen, tls_ca, tls_cert, tls_key, unencrypted), junit=junit,
        markdown=markdown,
    )  # fmt: skip
    end(result, as_json)
