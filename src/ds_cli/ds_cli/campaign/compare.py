# SPDX-License-Identifier: Apache-2.0
"""`ds compare`: what a network does better or worse than another, and where."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_base.installation import ds_command
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
from ds_cli.output import end, of_networks, stopped_in
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Comparison, Origin
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.networks.driver_name import DriverName
    from ds_orchestrator.campaign.engine import DriveSettings
    from ds_orchestrator.campaign.folder import CampaignData
    from ds_studies.comparison.compare import GivenTests

ROADS, SEED = 40, 40
"""Random roads of two networks, and their seed; chosen: those of `ds siblings compare`."""
SIMULATORS = "bullet,softbody,donkey"
"""Simulators of two networks: those of a campaign by default."""

TWIN = SimulatorName("donkey")
"""Simulator that acts as the twin of two networks' random roads, if it is among others."""

app = typer.Typer()


@dataclass(frozen=True, kw_only=True)
class Driving:
    """How a comparison drives what is missing.

    Attributes:
        out: folder for the drives; a comparison that was stopped there is resumed.
        label: of the candidate, where several share the folder; else "".
        with_engine: chooses engine and workers.
    """

    out: Path
    label: str
    with_engine: Callable[[DriveSettings], DriveSettings]

    def compare(
        self, sets: Sequence[GivenTests], networks: tuple[Network, Network], origin: Origin, source: str
    ) -> Comparison:
        """Compare reference and candidate on all tests."""
        from ds_studies.comparison.compare import compare

        comparison: Comparison = self._drive(
            compare, [self._prepared(tests) for tests in sets], *networks, origin=origin, source=source
        )
        return comparison

    def compare_until_sure(self, tests: GivenTests, networks: tuple[Network, Network], source: str) -> Comparison:
        """Compare reference and candidate until the answer is sure."""
        from ds_studies.comparison.compare import compare_until_sure

        comparison: Comparison = self._drive(compare_until_sure, self._prepared(tests), *networks, source=source)
        return comparison

    def _prepared(self, tests: GivenTests) -> GivenTests:
        return replace(tests, settings=self.with_engine(tests.settings))

    def _drive(self, act: Callable[..., Comparison], *arguments: object, **options: object) -> Comparison:
        from ds_base.folder_files import make_folder
        from ds_cli.progress import ScreenListener
        from ds_orchestrator.engines.drive_tests import Callbacks

        make_folder(self.out)
        make_folder(self.out / self.label)
        with stopped_in(self.out):
            callbacks = Callbacks(listen=ScreenListener)
            return act(*arguments, out=self.out, label=self.label, callbacks=callbacks, **options)


@dataclass(frozen=True)
class Studies:
    """Two studies of imported outcomes; nothing is driven."""

    reference: Path
    candidate: Path

    def compare(self, driving: Driving) -> Comparison:
        """Compare the two drivers."""
        from ds_analysis.outcomes.pairs import compare_studies

        return compare_studies(self.reference, self.candidate)


@dataclass(frozen=True)
class CampaignAndNetwork:
    """A campaign, and a network that drives its tests."""

    campaign: Path
    network: DriverName
    again: bool
    trust: Sequence[str]

    def compare(self, driving: Driving) -> Comparison:
        """Drive the campaign's tests with the network, and compare it with the campaign's."""
        from ds_studies.comparison.compare import network_of_campaign, tests_of_campaign

        data = _trusted(self.campaign, self.trust)
        tests = tests_of_campaign(self.campaign, data)
        networks = network_of_campaign(data), network_named(self.network, tests.settings.simulators)
        source = f"The tests of the campaign {self.campaign}, {tests.pairs} drives of each network"
        return driving.compare(
            [replace(tests, reference={}) if self.again else tests], networks, _origin(data, "reference"), source
        )


@dataclass(frozen=True)
class TwoCampaigns:
    """Two campaigns of one configuration, each of whose networks drives the other's tests, too."""

    reference: Path
    candidate: Path
    again: bool
    trust: Sequence[str]

    def compare(self, driving: Driving) -> Comparison:
        """Compare the networks of the campaigns on the tests of both."""
        from ds_studies.comparison.compare import network_of_campaign, tests_of_campaigns

        first, second = (_trusted(folder, self.trust) for folder in (self.reference, self.candidate))
        sets = tests_of_campaigns((self.reference, first), (self.candidate, second))
        pairs = sum(tests.pairs for tests in sets)
        if self.again:
            sets = [replace(tests, reference={}) for tests in sets]
        networks = network_of_campaign(first), network_of_campaign(second)
        source = (
            f"The tests of the campaigns {self.reference} (r-...) and {self.candidate} (c-...), {pairs} drives of each"
        )
        return driving.compare(sets, networks, _origin(first, "both"), f"{source} network")


@dataclass(frozen=True)
class TwoNetworks:
    """Two networks on random roads."""

    reference: DriverName
    candidate: DriverName
    simulators: Sequence[SimulatorName]
    roads: int
    seed: int
    stop_early: bool

    def compare(self, driving: Driving) -> Comparison:
        """Drive the roads with both networks."""
        from ds_driver.data.collection import unseen_roads
        from ds_studies.comparison.compare import random_tests

        twin = TWIN if TWIN in self.simulators and len(self.simulators) > 1 else None
        siblings = [name for name in self.simulators if name != twin]
        tests = random_tests(unseen_roads(self.roads, self.seed), self.seed, siblings=siblings, twin=twin)
        networks = network_named(self.reference, self.simulators), network_named(self.candidate, self.simulators)
        source = f"{self.roads} random roads of seed {self.seed} on {', '.join(self.simulators)}"
        if self.stop_early:
            return driving.compare_until_sure(tests, networks, source)
        return driving.compare([tests], networks, "random", source)


Mode = Studies | CampaignAndNetwork | TwoCampaigns | TwoNetworks


def is_campaign(text: str) -> bool:
    """Whether an argument is a folder, and so a campaign; otherwise it names a network."""
    return Path(text).is_dir()


def _trusted(folder: Path, trust: Sequence[str]) -> CampaignData:
    """Read a campaign; the code that it names is shipped or trusted."""
    from ds_orchestrator.campaign.folder import open_store, read_campaign
    from ds_studies.whole_campaign import check_trust

    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    check_trust(data.config, trust)
    return data


def _origin(data: CampaignData, searched: Origin) -> Origin:
    return "random" if data.config.search.method == "random" else searched


def network_named(driver: DriverName, simulators: Sequence[SimulatorName]) -> Network:
    """A network with its digest, checked before anything starts."""
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.networks.driver_name import AUTOPILOT
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

    A and B are two networks, which drive random roads; a campaign and a network, which drives the tests of the
    campaign; two campaigns of one configuration; or two studies of imported outcomes. Drives that are missing come
    first, without ROS unless --engine says otherwise. Writes comparison.html, comparison.md and comparison.json under
    --out.

    Example: ds compare old.yaml new.yaml --out comparison
    """
    from ds_analysis.common.outcome_table import is_study
    from ds_analysis.comparison.paired_drives import ComparisonError
    from ds_analysis.comparison.tables import networks_table
    from ds_base.folder_files import make_folder

    if (second is None) == (driver is None):
        raise ComparisonError("expected one candidate, as in `ds compare A B` or `ds compare A --driver B`")
    candidates = several(second or str(driver)) or [second or str(driver)]
    criteria = criteria_of(fail_on, max_failures, has_reference=True)
    check_writable(junit, markdown)
    if len(candidates) > 1 and (junit or markdown):
        raise ComparisonError("--junit and --markdown are for one candidate: compare them one at a time")
    options = {"--roads": roads is not None, "--seed": seed is not None, "--sims": sims, "--stop-early": stop_early}
    of_networks_alone = [name for name, is_set in options.items() if is_set]

    def mode_of(candidate: str) -> Mode:
        if is_study(Path(first)) and is_study(Path(candidate)):
            return Studies(Path(first), Path(candidate))
        if is_campaign(first) and of_networks_alone:
            raise ComparisonError(f"{of_networks_alone[0]} is for two networks: {first} has its own tests")
        if is_campaign(first) and is_campaign(candidate):
            return TwoCampaigns(Path(first), Path(candidate), again, trust or [])
        if is_campaign(candidate):
            raise ComparisonError(f"{first} is no campaign folder: give the campaign first, then the network")
        network = driver_named(candidate, backend)
        if is_campaign(first):
            return CampaignAndNetwork(Path(first), network, again, trust or [])
        names = simulators_of(sims or SIMULATORS, default=sims is None)
        return TwoNetworks(
            driver_named(first), network, names, roads or ROADS, SEED if seed is None else seed, stop_early
        )

    results, comparisons = [], []
    for candidate in candidates:
        label = label_of_driver(candidate) if len(candidates) > 1 else ""
        driving = Driving(
            out=out,
            label=label,
            with_engine=lambda settings: with_engine_without_ros(settings, workers, engine, cluster),
        )
        comparison = mode_of(candidate).compare(driving)
        make_folder(out / label)
        comparisons.append(comparison)
        following = ds_command("report" if is_campaign(candidate) else "test", candidate)
        unmet = unmet_by(criteria, comparison)
        results.append(write_comparison(comparison, out / label, unmet, following, junit=junit, markdown=markdown))
    single = len(candidates) == 1
    end(results[0] if single else of_networks(networks_table(comparisons), results, out, sort), as_json)
