# SPDX-License-Identifier: Apache-2.0
"""`ds compare`: what a network does better or worse than another, and where."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_cli.campaign.compare_results import (
    FailOn,
    Junit,
    Markdown,
    MaxFailures,
    check_writable,
    criteria_of,
    unmet_by,
    write_comparison,
)
from ds_cli.options import (
    Backend,
    Cluster,
    EngineName,
    JsonFlag,
    Sort,
    Trust,
    Workers,
    driver_named,
    label_of_driver,
    several,
    simulators_of,
    with_engine_without_ros,
)
from ds_cli.output import Result, end, of_networks, stopped_in

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Comparison, Origin
    from ds_analysis.comparison.paired_drives import Network
    from ds_studies.comparison.compare import GivenTests

ROADS, SEED = 40, 40
"""Random roads of two networks, and their seed; chosen: those of `ds siblings compare`."""
SIMULATORS = "bullet,softbody,donkey"
"""Simulators of two networks: those of a campaign by default."""

TWIN = "donkey"
"""Simulator that acts as the twin of two networks' random roads, if it is among others."""

app = typer.Typer()


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
        ds_analysis.comparison.paired_drives.ComparisonError: the campaigns do not compare.
        ds_orchestrator.store.sqlite_file.StoreError: a folder holds no campaign.
    """
    from ds_orchestrator.campaign.folder import open_store, read_campaign
    from ds_studies.comparison.compare import network_of_campaign, tests_of_campaign, tests_of_campaigns
    from ds_studies.whole_campaign import check_trust

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
            candidate=network_named(second, tests.settings.simulators),
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
    from ds_driver.data.collection import unseen_roads
    from ds_studies.comparison.compare import random_tests

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
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.control.autopilot import AUTOPILOT
    from ds_driver.networks.network_driver import driver_sha256
    from ds_orchestrator.engines.preflight import check_driver

    check_driver(driver, simulators)
    return Network(driver=driver, sha256="" if driver == AUTOPILOT else driver_sha256(driver))


@app.command("compare")
def campaign_compare_command(
    first: Annotated[str, typer.Argument(metavar="A", help="Reference: a campaign or study, or a network.")],
    second: Annotated[
        str | None, typer.Argument(metavar="B", help="Candidate: a campaign folder, or a network.")
    ] = None,
    driver: Annotated[
        str | None, typer.Option(help="Candidate, a network; the same as B. Several, by commas, come in one table.")
    ] = None,
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
    stop_early: Annotated[
        bool, typer.Option("--stop-early", help="For two networks: end as soon as the answer is sure.")
    ] = False,
    fail_on: FailOn = None,
    max_failures: MaxFailures = None,
    junit: Junit = None,
    markdown: Markdown = None,
    workers: Workers = None,
    engine: EngineName = None,
    cluster: Cluster = None,
    sort: Sort = None,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """Compare two networks on the same tests: what got worse, what got better?

    A and B are two campaigns of one configuration, a campaign and a network, or two networks, which drive random roads;
    or two studies of imported outcomes, where nothing is driven.
    Tests that one of them has not driven are driven first, without ROS unless --engine says otherwise. Writes
    comparison.html, comparison.md and comparison.json under --out.
    """
    from ds_analysis.comparison.paired_drives import ComparisonError
    from ds_analysis.comparison.tables import networks_table
    from ds_analysis.outcomes.pairs import compare_studies
    from ds_analysis.outcomes.study import is_study
    from ds_base.folder_files import make_folder
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_studies.comparison.compare import compare, compare_until_sure

    if (second is None) == (driver is None):
        raise ComparisonError("expected one candidate, as in `ds compare A B` or `ds compare A --driver B`")
    candidates = several(second or str(driver)) or [second or str(driver)]
    criteria = criteria_of(fail_on, max_failures, has_reference=True)
    check_writable(junit, markdown)
    if len(candidates) > 1 and (junit or markdown):
        raise ComparisonError("--junit and --markdown are for one candidate: compare them one at a time")

    def written(found: Comparison, label: str) -> tuple[Comparison, Result]:
        make_folder(page := out / label if label else out)
        return found, write_comparison(found, page, unmet_by(criteria, found), junit=junit, markdown=markdown)

    def compared(candidate: str, label: str) -> tuple[Comparison, Result]:
        if is_study(Path(first)) and is_study(Path(candidate)):
            return written(compare_studies(Path(first), Path(candidate)), label)
        if not is_campaign(candidate):
            candidate = driver_named(candidate, backend, "cpu")
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
        make_folder(out)
        make_folder(out / label if label else out)
        sets = [
            replace(tests, settings=with_engine_without_ros(tests.settings, workers, engine, cluster))
            for tests in plan.sets
        ]
        with stopped_in(out):
            callbacks = Callbacks(listen=ScreenListener)
            if stop_early:
                if is_campaign(first):
                    raise ComparisonError("--stop-early is for two networks, which drive random roads")
                found = compare_until_sure(
                    sets[0],
                    plan.reference,
                    plan.candidate,
                    source=plan.source,
                    out=out,
                    label=label,
                    callbacks=callbacks,
                )
            else:
                found = compare(
                    sets, plan.reference, plan.candidate, origin=plan.origin, source=plan.source, out=out, label=label,
                    callbacks=callbacks,
                )  # fmt: skip
        return written(found, label)

    if len(candidates) == 1:
        end(compared(candidates[0], "")[1], as_json)
        return
    comparisons = [compared(name, label_of_driver(name)) for name in candidates]
    table = networks_table([found for found, _ in comparisons])
    end(of_networks(table, [one for _, one in comparisons], out, sort), as_json)
