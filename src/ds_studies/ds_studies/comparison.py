# SPDX-License-Identifier: Apache-2.0
"""Drives what two networks lack on the same tests, and compares them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from ds_analysis.comparison.analysis import Comparison, Origin, compare_networks, is_sure
from ds_analysis.comparison.paired_drives import ComparedTest, ComparisonError, DriveOutcome, Network, PairedDrive
from ds_base.installation import ds_command
from ds_base.progress import logger_of
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.campaign.config import SearchConfig
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.folder import DRIVER_SHA256, CampaignData
from ds_orchestrator.engines.drive_tests import Callbacks, DriveResults, Key, drive_tests
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, cell_of, feature_of
from ds_orchestrator.store.model import Execution, Test
from ds_road import Road
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario

LOG = logger_of(__name__)

Drives = Mapping[Key, Execution]
BATCH = 5
"""Random roads after which a comparison looks whether its answer is sure; chosen: starting workers takes seconds."""
SAME = ("siblings", "twin", "lane", "conditions", "gates", "maxitwo_compatible", "features", "migration", "search")
"""Keys of the configuration in which two compared campaigns must agree, so that each network is searched alike."""


@dataclass(frozen=True, kw_only=True)
class GivenTests:
    """Tests with what is known of them.

    Attributes:
        name: name of the set, safe within a file name.
        settings: how they are driven; the driver is replaced.
        work: simulator -> tests to compare there.
        reference: known drives of the reference; `candidate` likewise.
        unsearched: tests that no network's outcome led to.
        prefix: of the tests' names where a comparison has two sets.
    """

    name: str
    settings: DriveSettings
    features: Sequence[str]
    work: Mapping[SimulatorName, Sequence[Test]]
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
    return Network(driver=data.driver, sha256=data.notes.get(DRIVER_SHA256, ""))


def tests_of_campaign(folder: Path, data: CampaignData) -> GivenTests:
    """Tests of a campaign, each scenario once, where its network has a verdict; `ComparisonError` if there is none."""
    data = data.distinct
    executions = {(one.test_id, one.simulator): one for one in data.verdicts}
    if not executions:
        raise ComparisonError(
            f"{folder} has no drive with a verdict: run `{ds_command('campaign', 'resume', folder)}` first"
        )
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
    """Tests of two campaigns, each with its folder, of one configuration; those that both have are driven already.

    Raises:
        ComparisonError: the campaigns have different simulators, conditions or searches, or one has no drives.
    """
    (first_folder, first), (second_folder, second) = reference, candidate
    for key in SAME:
        there, here = (_shown(getattr(data.config, key)) for data in (first, second))
        if there != here:
            raise ComparisonError(
                f"{first_folder} and {second_folder} differ in {key} ({there} and {here}): compare campaigns of one "
                f"configuration, or `{ds_command('compare', first_folder, '--driver', str(second.config.driver))}`"
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


def random_tests(
    roads: Sequence[Road], seed: int, *, siblings: Sequence[SimulatorName], twin: SimulatorName | None
) -> GivenTests:
    """Random roads, each driven on every simulator, the first with this seed, which increases by one per road."""
    tests = [Test(f"random-0-{i:04d}", Scenario(road, seed=seed + i)) for i, road in enumerate(roads)]
    settings = DriveSettings(siblings=tuple(siblings), twin=twin, driver=DriverName(""))
    return GivenTests(
        name="tests",
        settings=settings,
        features=DEFAULT_FEATURES,
        work=dict.fromkeys(settings.simulators, tests),
        cells={test.test_id: cell for test in tests if (cell := cell_of(test.road)) is not None},
        unsearched=frozenset(test.test_id for test in tests),
    )


def _by_content(work: Mapping[SimulatorName, Sequence[Test]]) -> dict[tuple[Scenario, str], Key]:
    """Scenario and simulator, on which a drive depends -> test and simulator."""
    return {(test.scenario, name): (test.test_id, name) for name, tests in work.items() for test in tests}


def _shown(value: object) -> str:
    if isinstance(value, SearchConfig):
        return ", ".join(f"{key} {one}" for key, one in value.model_dump().items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


Role = Literal["reference", "candidate"]


def compare(
    sets: Sequence[GivenTests],
    reference: Network,
    candidate: Network,
    *,
    origin: Origin,
    source: str,
    out: Path,
    callbacks: Callbacks,
    recheck: bool = True,
    sequential: bool = False,
) -> Comparison:
    """Compare two networks on tests of one configuration apart from the driver; drives that are not known are driven.

    A comparison that was stopped goes on in its folder. With `recheck`, one known test is driven again on each
    simulator, as drives have to repeat here; for `sequential` see `compare_until_sure`, for the rest `Comparison`.

    Raises:
        ComparisonError: a known drive does not come out the same again.
    """
    pairs: list[PairedDrive] = []
    left_out: list[tuple[str, SimulatorName, str]] = []
    excluded = 0
    checked: set[Role] = set()
    for tests in sets:
        sides: dict[Role, DriveResults] = {}
        roles: tuple[tuple[Role, Network, Drives], ...] = (
            ("reference", reference, tests.reference),
            ("candidate", candidate, tests.candidate),
        )
        for role, network, drives in roles:
            if recheck and drives and role not in checked:
                checked.add(role)
                _recheck(tests, role, network, drives, out, callbacks)
            folder = out / "drives" / f"{role}_on_{tests.name}"
            sides[role] = _complete(tests, role, network, drives, folder, callbacks)
        known_excluded = {key for key, gate in tests.gates.items() if not gate.is_valid}
        excluded += len(known_excluded | sides["reference"].excluded | sides["candidate"].excluded)
        paired, missing = _paired(tests, sides)
        pairs += paired
        left_out += missing
    settings = sets[0].settings
    return compare_networks(
        pairs,
        reference=reference,
        candidate=candidate,
        origin=origin,
        source=source,
        simulators=settings.simulators,
        features=[feature_of(name) for name in sets[0].features],
        twin=settings.twin,
        excluded=excluded,
        left_out=left_out,
        sequential=sequential,
    )


def compare_until_sure(
    tests: GivenTests, reference: Network, candidate: Network, *, source: str, out: Path, callbacks: Callbacks
) -> Comparison:
    """`compare` on `random_tests`, some more at a time, until the answer is sure or no road is left."""
    roads = max(map(len, tests.work.values()))
    for last in [*range(BATCH, roads, BATCH), roads]:
        some = replace(tests, work={name: of[:last] for name, of in tests.work.items()})
        comparison = compare(
            [some], reference, candidate, origin="random", source=source, out=out, callbacks=callbacks, sequential=True
        )
        if is_sure(comparison) or last == roads:
            break
    left = 2 * len(tests.work) * (roads - last)
    ends = f"ended after {last} of them, which saved {left} drives" if left else "not sure before their end"
    return replace(comparison, source=f"{source}; {ends}; p and intervals hold for such an end")


def _complete(
    tests: GivenTests, role: Role, network: Network, drives: Drives, folder: Path, callbacks: Callbacks
) -> DriveResults:
    """Known drives, and those that are driven now."""
    missing = {name: [test for test in of if (test.test_id, name) not in drives] for name, of in tests.work.items()}
    missing = {name: of for name, of in missing.items() if of}
    if not missing:
        return DriveResults(executions=drives)
    if network.sha256 and (reason := _cannot_drive(network)):
        raise ComparisonError(
            f"{network.driver} has to drive {sum(map(len, missing.values()))} tests, but {reason}: restore it, or "
            "compare its campaign with a network, as in `ds compare A --driver B`"
        )
    settings = replace(tests.settings, driver=network.driver)
    LOG.info("%s %s: %d drives", role, network.driver, sum(map(len, missing.values())))
    results = drive_tests(settings, missing, folder, callbacks, gates=tests.gates)
    return DriveResults(executions={**drives, **results.executions}, gates=results.gates, errors=results.errors)


def _recheck(tests: GivenTests, role: Role, network: Network, drives: Drives, out: Path, callbacks: Callbacks) -> None:
    """Drive the shortest known test of each simulator again: its outcome counts only if it is repeatable here.

    The known outcomes of a network whose files have changed or are gone are taken as they are.
    """
    settings = replace(tests.settings, driver=network.driver)
    work: dict[SimulatorName, list[Test]] = {}
    for name, of in tests.work.items():
        driven = [test for test in of if (test.test_id, name) in drives]
        if driven:
            work[name] = [min(driven, key=lambda test: (drives[test.test_id, name].steps, test.test_id))]
    if reason := _cannot_drive(network):
        LOG.warning("%s %s: its known outcomes were not checked: %s", role, network.driver, reason)
        return
    LOG.info("%s %s: drives one known test on each simulator again, to check that it repeats", role, network.driver)
    results = drive_tests(settings, work, out / "drives" / f"{role}_again_{tests.name}", callbacks, gates=tests.gates)
    for key, execution in results.executions.items():
        if execution.trajectory_sha256 != drives[key].trajectory_sha256:
            raise ComparisonError(
                f"{network.driver} drives test {key[0]} on {key[1]} differently than before: the simulators' code or "
                "this machine has changed, so old and new outcomes do not compare; --again drives the reference again"
            )


def _cannot_drive(network: Network) -> str:
    """Why a network cannot be driven as it was; "" if it can."""
    from ds_driver.networks.network_driver import driver_sha256

    if network.driver.is_node:
        return "it is a ROS node that you start"
    try:
        return "" if driver_sha256(network.driver) == network.sha256 else "its files have changed since"
    except (DriverError, ValueError, OSError) as error:
        return " ".join(str(error).split())


def _paired(
    tests: GivenTests, sides: Mapping[Role, DriveResults]
) -> tuple[list[PairedDrive], list[tuple[str, SimulatorName, str]]]:
    """Pairs with a verdict of both, and pairs that lack one by an error."""
    pairs, left_out = [], []
    for name, of in tests.work.items():
        for test in of:
            key: Key = (test.test_id, name)
            compared = ComparedTest(
                name=tests.prefix + test.test_id,
                scenario=test.scenario,
                cell=tests.cells.get(test.test_id),
                unsearched=test.test_id in tests.unsearched,
            )
            both: dict[Role, Execution] = {
                role: side.executions[key] for role, side in sides.items() if key in side.executions
            }
            errors = [f"{role}: {side.errors[key]}" for role, side in sides.items() if key in side.errors]
            if len(both) == len(sides):
                reference, candidate = (DriveOutcome.of(both[role]) for role in ("reference", "candidate"))
                pairs.append(PairedDrive(test=compared, simulator=name, reference=reference, candidate=candidate))
            elif errors:
                left_out.append((compared.name, name, "; ".join(errors)))
    return pairs, left_out
