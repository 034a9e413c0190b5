"""What `ds campaign compare` compares on which tests: campaigns, networks, or one of each."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Origin
    from ds_analysis.comparison.drives import Network
    from ds_studies.comparison.compared_tests import GivenTests

TWIN = "donkey"
"""Simulator that acts as the twin of two networks' random roads, if it is among others."""


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
        ds_analysis.comparison.drives.ComparisonError: the campaigns do not compare.
        ds_orchestrator.store.sqlite_file.StoreError: a folder holds no campaign.
    """
    from ds_orchestrator.campaign.campaign_data import read_campaign
    from ds_orchestrator.campaign.folder import open_store
    from ds_studies.comparison.compared_tests import network_of_campaign, tests_of_campaign, tests_of_campaigns
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
    from ds_driver.closed_loop.success_rate import unseen_roads
    from ds_studies.comparison.compared_tests import random_tests

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
    from ds_analysis.comparison.drives import Network
    from ds_driver.closed_loop.drive_request import AUTOPILOT
    from ds_driver.networks.network_driver import driver_sha256
    from ds_orchestrator.engines.preflight import check_driver

    check_driver(driver, simulators)
    return Network(driver=driver, sha256="" if driver == AUTOPILOT else driver_sha256(driver))
