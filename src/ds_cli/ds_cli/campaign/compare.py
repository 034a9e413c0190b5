# SPDX-License-Identifier: Apache-2.0
"""`ds compare`: what a network does better or worse than another, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.campaign.compare_results import check_writable, criteria_of, write_comparison
from ds_cli.campaign.run import SIMULATORS
from ds_cli.output import end, stopped_in
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Origin
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.networks.driver_name import DriverName
    from ds_orchestrator.campaign.folder import CampaignData
    from ds_studies.comparison.compare import GivenTests

ROADS, SEED = 40, 40
"""Random roads of two networks, and their seed; chosen: those of `ds siblings compare`."""
TWIN = SimulatorName("donkey")
"""Simulator that acts as the twin of two networks' random roads, if it is among others."""

app = typer.Typer()


Task = tuple[list["GivenTests"], tuple["Network", "Network"], "Origin", str]
"""Tests, reference and candidate, how the tests were chosen, and where they come from, in words."""


def _of_campaign_and_network(campaign: Path, network: DriverName, trust: Sequence[str]) -> Task:
    """The tests of a campaign, to be driven with a network."""
    from ds_studies.comparison.compare import network_of_campaign, tests_of_campaign

    data = _trusted(campaign, trust)
    tests = tests_of_campaign(campaign, data)
    networks = network_of_campaign(data), network_named(network, tests.settings.simulators)
    source = f"The tests of the campaign {campaign}, {tests.pairs} drives of each network"
    return [tests], networks, _origin(data, "reference"), source


def _of_campaigns(reference: Path, candidate: Path, trust: Sequence[str]) -> Task:
    """The tests of two campaigns of one configuration, each of whose networks drives the other's tests, too."""
    from ds_studies.comparison.compare import network_of_campaign, tests_of_campaigns

    first, second = (_trusted(folder, trust) for folder in (reference, candidate))
    sets = tests_of_campaigns((reference, first), (candidate, second))
    pairs = sum(tests.pairs for tests in sets)
    source = f"The tests of the campaigns {reference} (r-...) and {candidate} (c-...), {pairs} drives of each network"
    return sets, (network_of_campaign(first), network_of_campaign(second)), _origin(first, "both"), source


def _of_networks(
    reference: DriverName, candidate: DriverName, simulators: Sequence[SimulatorName], roads: int, seed: int
) -> Task:
    """Random roads for two networks."""
    from ds_driver.data.collection import unseen_roads
    from ds_studies.comparison.compare import random_tests

    twin = TWIN if TWIN in simulators and len(simulators) > 1 else None
    siblings = [name for name in simulators if name != twin]
    tests = random_tests(unseen_roads(roads, seed), seed, siblings=siblings, twin=twin)
    networks = network_named(reference, simulators), network_named(candidate, simulators)
    return [tests], networks, "random", f"{roads} random roads of seed {seed} on {', '.join(simulators)}"


def is_campaign(text: str) -> bool:
    """Whether an argument is a folder, and so a campaign; otherwise it names a network."""
    return Path(text).is_dir()


def _trusted(folder: Path, trust: Sequence[str]) -> CampaignData:
    """Read a campaign; the code that it names is shipped or trusted."""
    from ds_orchestrator.campaign.folder import read_folder
    from ds_studies.whole_campaign import check_trust

    data = read_folder(folder)
    check_trust(data.config, trust)
    return data


def _origin(data: CampaignData, searched: Origin) -> Origin:
    return "random" if data.config.search.method == "random" else searched


def network_named(driver: DriverName, simulators: Sequence[SimulatorName]) -> Network:
    """A network with its digest, checked before anything starts."""
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.networks.network_driver import driver_sha256
    from ds_orchestrator.engines.start import check_driver

    check_driver(driver, simulators)
    return Network(driver=driver, sha256=driver_sha256(driver))


@app.command("compare")
def campaign_compare_command(
    first: Annotated[str, typer.Argument(metavar="A", help="Reference: a campaign or study, or a network.")],
    second: Annotated[
        str | None, typer.Argument(metavar="B", help="Candidate: a campaign folder, or a network.")
    ] = None,
    driver: Annotated[str | None, typer.Option(help="Candidate, a network; the same as B.")] = None,
    backend: options.Backend = "auto",
    out: Annotated[
        Path, typer.Option(help="Folder for drives and results; a comparison that was stopped there is resumed.")
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
    fail_on: options.FailOn = None,
    max_failures: options.MaxFailures = None,
    junit: options.Junit = None,
    markdown: options.Markdown = None,
    workers: options.Workers = None,
    engine: options.EngineName = None,
    cluster: options.Cluster = None,
    trust: options.Trust = None,
    as_json: options.JsonFlag = False,
) -> None:
    """Compare two networks on the same tests: what got worse, what got better?

    A and B are two networks, which drive random roads; a campaign and a network, which drives the tests of the
    campaign; two campaigns of one configuration; or two studies of imported outcomes. Drives that are missing come
    first, without ROS unless --engine says otherwise. Writes comparison.html, comparison.md and comparison.json under
    --out.

    Example: ds compare old.yaml new.yaml --out comparison
    """
    from ds_analysis.common.outcome_table import is_study
    from ds_analysis.comparison.paired_drives import ComparisonError
    from ds_analysis.outcomes.pairs import compare_studies
    from ds_base.folder_files import make_folder
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_studies.comparison.compare import compare, compare_until_sure

    if (second is None) == (driver is None):
        raise ComparisonError("expected one candidate, as in `ds compare A B` or `ds compare A --driver B`")
    candidate = second or str(driver)
    criteria = criteria_of(fail_on, max_failures, has_reference=True)
    check_writable(junit, markdown)
    only_networks = {
        "--roads": roads is not None,
        "--seed": seed is not None,
        "--sims": sims,
        "--stop-early": stop_early,
    }
    of_networks_alone = [name for name, is_set in only_networks.items() if is_set]

    def task() -> Task:
        if is_campaign(first) and of_networks_alone:
            raise ComparisonError(f"{of_networks_alone[0]} is for two networks: {first} has its own tests")
        if is_campaign(first) and is_campaign(candidate):
            return _of_campaigns(Path(first), Path(candidate), trust or [])
        if is_campaign(candidate):
            raise ComparisonError(f"{first} is no campaign folder: give the campaign first, then the network")
        network = options.driver_named(candidate, backend)
        if is_campaign(first):
            return _of_campaign_and_network(Path(first), network, trust or [])
        names = options.simulators_of(sims or SIMULATORS, default=sims is None)
        return _of_networks(options.driver_named(first), network, names, roads or ROADS, SEED if seed is None else seed)

    if is_study(Path(first)) and is_study(Path(candidate)):
        comparison = compare_studies(Path(first), Path(candidate))
        make_folder(out)
    else:
        sets, networks, origin, source = task()
        for k, tests in enumerate(sets):
            settings = options.with_engine_without_ros(tests.settings, workers, engine, cluster)
            sets[k] = replace(tests, settings=settings, reference={} if again else tests.reference)
        make_folder(out)
        callbacks = Callbacks(listen=ScreenListener)
        with stopped_in(out):
            if stop_early:
                comparison = compare_until_sure(sets[0], *networks, source=source, out=out, callbacks=callbacks)
            else:
                comparison = compare(sets, *networks, origin=origin, source=source, out=out, callbacks=callbacks)
    following = ds_command("report" if is_campaign(candidate) else "test", candidate)
    end(write_comparison(comparison, out, criteria, following, junit=junit, markdown=markdown), as_json)
