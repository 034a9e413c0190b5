"""Tests on which two networks are compared: those of a campaign, of two campaigns, or random roads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ds_analysis.comparison.drives import ComparisonError, Network
from ds_orchestrator.campaign.config import SearchConfig
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.folder import DRIVER_SHA256, CampaignData
from ds_orchestrator.engines.drive_tests import Key
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, cell_of
from ds_orchestrator.store.model import Execution, Test
from ds_road import Road
from ds_sim.conditions.text import format_conditions
from ds_sim.gates.gate import Gate

Drives = Mapping[Key, Execution]
SAME = ("siblings", "twin", "lane", "conditions", "gates", "maxitwo_compatible", "features", "migration", "search")
"""Keys of the configuration in which two compared campaigns must agree, so that each network is searched alike."""


@dataclass(frozen=True, kw_only=True)
class GivenTests:
    """Tests with what is known of them.

    Attributes:
        name: name of the set, safe within a file name.
        settings: how they are driven; the driver is replaced.
        features: axes of the cells.
        work: simulator -> tests to compare there.
        reference: known drives of the reference.
        candidate: known drives of the candidate.
        gates: what is known of the tests' validity.
        cells: test -> cell.
        unsearched: tests that no network's outcome led to.
        prefix: of the tests' names where a comparison has two sets.
    """

    name: str
    settings: DriveSettings
    features: Sequence[str]
    work: Mapping[str, Sequence[Test]]
    reference: Drives = field(default_factory=dict)
    candidate: Drives = field(default_factory=dict)
    gates: Mapping[Key, Gate] = field(default_factory=dict)
    cells: Mapping[str, Cell] = field(default_factory=dict)
    unsearched: frozenset[str] = frozenset()
    prefix: str = ""

    @property
    def pairs(self) -> int:
        """Number of tests on simulators."""
        return sum(len(tests) for tests in self.work.values())


def network_of_campaign(data: CampaignData) -> Network:
    """The network that a campaign tested."""
    return Network(driver=data.config.driver, sha256=data.notes.get(DRIVER_SHA256, ""))


def tests_of_campaign(folder: Path, data: CampaignData) -> GivenTests:
    """Tests of a campaign, on every simulator on which its network has a verdict.

    Raises:
        ComparisonError: there is none.
    """
    executions = {(one.test_id, one.simulator): one for one in data.verdicts}
    if not executions:
        raise ComparisonError(f"{folder} has no drive with a verdict: run `ds campaign resume {folder}` first")
    work = {name: [t for t in data.tests if (t.test_id, name) in executions] for name in data.config.simulators}
    is_random = data.config.search.method == "random"
    return GivenTests(
        name="tests",
        settings=replace(data.config.drive_settings(), record="none"),
        features=data.config.features,
        work=work,
        reference=executions,
        gates=data.gates,
        cells=data.cells,
        # The initial population is drawn before the search looks at any outcome.
        unsearched=frozenset(t.test_id for t in data.tests if is_random or t.number < data.config.search.population),
    )


def tests_of_campaigns(reference: tuple[Path, CampaignData], candidate: tuple[Path, CampaignData]) -> list[GivenTests]:
    """Tests of two campaigns of one configuration; those that both have are driven already.

    Args:
        reference: folder and contents of the reference's campaign.
        candidate: the same of the candidate's.

    Raises:
        ComparisonError: the campaigns have different simulators, conditions or searches, or one has no drives.
    """
    (first_folder, first), (second_folder, second) = reference, candidate
    for key in SAME:
        there, here = (_shown(getattr(data.config, key)) for data in (first, second))
        if there != here:
            raise ComparisonError(
                f"{first_folder} and {second_folder} differ in {key} ({there} and {here}): compare campaigns of one "
                f"configuration, or `ds campaign compare {first_folder} --driver {second.config.driver}`"
            )
    one, other = tests_of_campaign(*reference), tests_of_campaign(*candidate)
    first_keys, second_keys = _by_content(one.work), _by_content(other.work)
    shared = {first_keys[key]: second_keys[key] for key in first_keys.keys() & second_keys.keys()}
    repeated = set(shared.values())
    of_first = replace(
        one,
        name="tests_of_reference",
        prefix="r-",
        candidate={mine: other.reference[theirs] for mine, theirs in shared.items()},
    )
    of_second = replace(
        other,
        name="tests_of_candidate",
        prefix="c-",
        work={n: [t for t in tests if (t.test_id, n) not in repeated] for n, tests in other.work.items()},
        reference={},
        candidate=other.reference,
    )
    return [of_first, of_second] if of_second.pairs else [replace(of_first, prefix="")]


def random_tests(roads: Sequence[Road], seed: int, *, siblings: Sequence[str], twin: str | None) -> GivenTests:
    """Random roads, each driven on every simulator.

    Args:
        roads: the roads.
        seed: of the run on the first road; it increases by one per road.
        siblings: names of the simulators but the twin.
        twin: name of the twin, or None.
    """
    tests = [
        Test(test_id=f"random-0-{i:04d}", sibling=siblings[0], run=0, number=i, road=road, seed=seed + i)
        for i, road in enumerate(roads)
    ]
    settings = DriveSettings(siblings=tuple(siblings), twin=twin, driver="")
    return GivenTests(
        name="tests",
        settings=settings,
        features=DEFAULT_FEATURES,
        work=dict.fromkeys(settings.simulators, tests),
        cells={test.test_id: cell for test in tests if (cell := cell_of(test.road)) is not None},
        unsearched=frozenset(test.test_id for test in tests),
    )


def _by_content(work: Mapping[str, Sequence[Test]]) -> dict[tuple[str, ...], Key]:
    """What a drive depends on -> test and simulator."""
    return {
        (test.road.road_id, test.road.lane, str(test.seed), format_conditions(test.conditions), name): (
            test.test_id,
            name,
        )
        for name, tests in work.items()
        for test in tests
    }


def _shown(value: object) -> str:
    if isinstance(value, SearchConfig):
        return ", ".join(f"{key} {one}" for key, one in value.model_dump().items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
