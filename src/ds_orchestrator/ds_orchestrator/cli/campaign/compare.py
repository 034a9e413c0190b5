"""`ds campaign compare`: whether another network is better, where, and whether anything is worse."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from ds_orchestrator.cli.campaign.pass_options import (
    FailOn,
    Junit,
    Markdown,
    MaxFailures,
    check_writable,
    criteria_of,
    unmet_by,
    write_reports,
)
from ds_orchestrator.cli.options import Backend, JsonFlag, Trust, driver_named, simulators_of
from ds_orchestrator.cli.output import Interrupted, Result, end, say

if TYPE_CHECKING:
    from ds_orchestrator.comparison.analysis import Comparison, Origin
    from ds_orchestrator.comparison.criteria import Criteria
    from ds_orchestrator.comparison.drives import Network
    from ds_orchestrator.comparison.test_sets import GivenTests
    from ds_orchestrator.engines.cluster import ClusterOptions

ROADS, SEED = 40, 40
"""Random roads of two networks, and their seed; chosen: those of `ds siblings compare`."""
SIMULATORS = "bullet,softbody,donkey"
"""Simulators of two networks: those of a campaign by default."""
TWIN = "donkey"
WORKERS = 1

campaign_app = typer.Typer()


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is compared on what.

    Attributes:
        sets: tests.
        reference: the network that is known.
        candidate: the network that may replace it.
        origin: how the tests were chosen.
        source: where they come from, in words.
    """

    sets: Sequence[GivenTests]
    reference: Network
    candidate: Network
    origin: Origin
    source: str


def is_campaign(text: str) -> bool:
    """Whether an argument is a folder, and so a campaign; otherwise it names a network."""
    return Path(text).is_dir()


def plan_of_campaigns(first: Path, second: str, trust: list[str] | None) -> Plan:
    """Compare a campaign's network with another campaign's, or with a network.

    Raises:
        ds_orchestrator.comparison.drives.ComparisonError: the campaigns do not compare.
        ds_orchestrator.store.sqlite_file.StoreError: a folder holds no campaign.
    """
    from ds_orchestrator.campaign.campaign_data import read_campaign
    from ds_orchestrator.campaign.folder import open_store
    from ds_orchestrator.comparison.test_sets import network_of_campaign, tests_of_campaign, tests_of_campaigns
    from ds_orchestrator.run import check_trust

    folders = [first, *([Path(second)] if is_campaign(second) else [])]
    found = []
    for folder in folders:
        with closing(open_store(folder)) as store:
            found.append(read_campaign(store))
        check_trust(found[-1].config, trust or [])
    is_random = found[0].config.search.method == "random"
    reference = network_of_campaign(found[0])
    if len(found) == 1:
        tests = tests_of_campaign(first, found[0])
        return Plan(
            sets=[tests],
            reference=reference,
            candidate=network_named(second, tests.config.simulators),
            origin="random" if is_random else "reference",
            source=f"The tests of the campaign {first}, {tests.pairs} drives of each network",
        )
    sets = tests_of_campaigns((first, found[0]), (Path(second), found[1]))
    pairs = sum(tests.pairs for tests in sets)
    return Plan(
        sets=sets,
        reference=reference,
        candidate=network_of_campaign(found[1]),
        origin="random" if is_random else "both",
        source=f"The tests of the campaigns {first} (r-...) and {second} (c-...), {pairs} drives of each network",
    )


def plan_of_networks(first: str, second: str, simulators: list[str], roads: int, seed: int) -> Plan:
    """Compare two networks on random roads."""
    from ds_driver.closed_loop.success_rate import unseen_roads
    from ds_orchestrator.comparison.test_sets import random_tests

    twin = TWIN if TWIN in simulators and len(simulators) > 1 else None
    siblings = [name for name in simulators if name != twin]
    tests = random_tests(unseen_roads(roads, seed), seed, siblings=siblings, twin=twin)
    return Plan(
        sets=[tests],
        reference=network_named(first, simulators),
        candidate=network_named(second, simulators),
        origin="random",
        source=f"{roads} random roads of seed {seed} on {', '.join(simulators)}",
    )


def network_named(driver: str, simulators: Sequence[str]) -> Network:
    """A network with its digest, checked before anything starts."""
    from ds_driver.closed_loop.simulation import AUTOPILOT
    from ds_driver.networks.network_driver import driver_sha256
    from ds_orchestrator.comparison.drives import Network
    from ds_orchestrator.graph.process_specs import check_driver

    check_driver(driver, simulators)
    return Network(driver=driver, sha256="" if driver == AUTOPILOT else driver_sha256(driver))


def run_comparison(
    plan: Plan,
    out: Path,
    criteria: Criteria,
    *,
    engine: str | None,
    workers: int | None,
    cluster: ClusterOptions,
    recheck: bool,
    junit: Path | None,
    markdown: Path | None,
    again: str,
) -> Result:
    """Drive what is missing, compare, and write every result.

    Args:
        plan: what is compared on what.
        out: folder for drives and results, created if missing.
        criteria: pass criteria.
        engine: name of the engine.
        workers: graphs or processes that drive at the same time.
        cluster: cluster of the engine `dask`.
        recheck: drive known tests of each network again, to find out whether they repeat.
        junit: JUnit XML to write, or None.
        markdown: summary to write elsewhere, too, or None.
        again: command that goes on, for a user who stops it.

    Raises:
        Interrupted: the user stopped it; finished drives are kept.
    """
    from ds_orchestrator.campaign.runner import Stopped
    from ds_orchestrator.cli.progress import ScreenListener
    from ds_orchestrator.comparison.compare import compare
    from ds_orchestrator.comparison.given_tests import Engine

    check_writable(junit, markdown)
    out.mkdir(parents=True, exist_ok=True)
    sets = [
        replace(tests, config=with_engine(tests.config, workers or WORKERS, engine or "local")) for tests in plan.sets
    ]
    try:
        found = compare(
            sets, plan.reference, plan.candidate, origin=plan.origin, source=plan.source, out=out,
            engine=Engine(listen=ScreenListener, cluster=cluster, say=say), recheck=recheck,
        )  # fmt: skip
    except (KeyboardInterrupt, Stopped):
        raise Interrupted(f"finished drives are in {out}: `{again}` goes on") from None
    unmet = unmet_by(criteria, found)
    return write_comparison(found, out, unmet, junit=junit, markdown=markdown)


def write_comparison(
    found: Comparison, out: Path, unmet: Sequence[str], *, junit: Path | None, markdown: Path | None
) -> Result:
    """Write comparison.json, .md and .html, tables and the roads of tests that newly fail."""
    from ds_orchestrator.comparison.markdown import markdown_of
    from ds_orchestrator.comparison.summary import answer_of, cautions_of, sentences_of
    from ds_orchestrator.comparison.tables import (
        MOST_ROWS,
        cell_table,
        command_of,
        document_of,
        drive_table,
        simulator_table,
    )
    from ds_orchestrator.evaluation.table import write_tables
    from ds_orchestrator.report.comparison_page import write_comparison_page

    road_files = write_roads(found, out / "worse")
    document = {**document_of(found, road_files), "unmet": list(unmet), "page": str(out / "comparison.html")}
    (out / "comparison.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", "utf-8")
    (out / "comparison.md").write_text(markdown_of(found, road_files, unmet), "utf-8")
    write_tables([simulator_table(found), cell_table(found), drive_table(found)], out / "tables")
    write_comparison_page(found, out / "comparison.html", road_files, unmet)
    write_reports(found, road_files, unmet, junit=junit, markdown=markdown)

    def show() -> None:
        from ds_orchestrator.cli.campaign.difference_grid import difference_grids

        console = Console()
        simulator_table(found).show(console)
        grids, cells = difference_grids(found), cell_table(found, most=MOST_ROWS)
        for heading, grid in grids:
            print(heading)
            console.print(grid)
        if grids:
            print(cells.notes[0])
        elif cells.rows:
            cells.show(console)
        worse = drive_table(found, most=MOST_ROWS)
        if worse.rows:
            worse.show(console)
        for drive in found.newly_failing[:MOST_ROWS]:
            print(command_of(drive, found.candidate.driver, road_files[drive.test.name]))
        for line in (*sentences_of(found), *cautions_of(found)):
            print(line)
        print(answer_of(found))
        print(out / "comparison.html")

    return Result(document=document, show=show, error=bool(found.left_out), unmet=unmet)


def write_roads(found: Comparison, folder: Path) -> dict[str, str]:
    """Write a road file for every test that newly fails, as `ds drive --road` takes it; test -> file."""
    from ds_road import road_to_json
    from ds_sim.conditions.text import format_conditions

    files = {}
    for drive in found.newly_failing:
        test = drive.test
        folder.mkdir(exist_ok=True)
        path = folder / f"{test.name}.json"
        road = road_to_json(test.road)
        entry = {**(road if isinstance(road, dict) else {"control_points": road}), "seed": test.seed}
        entry |= {} if test.conditions.is_default else {"conditions": format_conditions(test.conditions)}
        path.write_text(json.dumps([entry], allow_nan=False) + "\n", "utf-8")
        files[test.name] = str(path)
    return files


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
    from ds_orchestrator.comparison.drives import ComparisonError

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
        cluster=cluster_of(scheduler, listen, tls_ca, tls_cert, tls_key, unencrypted), recheck=True, junit=junit,
        markdown=markdown, again="the same command",
    )  # fmt: skip
    end(result, as_json)
