# SPDX-License-Identifier: Apache-2.0
"""Regression suites: the tests of a campaign that tell most, with its network's outcomes, in a file without code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from ds_analysis.comparison.analysis import Comparison, compare_networks
from ds_analysis.comparison.paired_drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_base.bounded_file import FileError, read_json
from ds_base.config_errors import Keys, problems
from ds_base.folder_files import write_whole
from ds_base.installation import ds_command
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import ConditionsText, ConfigError, DriverText, rebase_paths
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.folder import DRIVER_SHA256, CampaignData
from ds_orchestrator.engines.drive_tests import Callbacks, drive_tests
from ds_orchestrator.engines.fingerprint import code_sha256
from ds_orchestrator.search.features import DEFAULT_FEATURES, feature_of
from ds_orchestrator.store.model import Execution, Test
from ds_road import Road, Side
from ds_sim.conditions.model import DEFAULT
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

FORMAT = "digital-siblings-suite"
VERSION = 1
LARGEST_FILE = 16 * 2**20
"""Bytes of a suite; chosen: thousands of roads fit."""
MOST_TESTS = 2000
"""Tests of a suite; chosen: beyond, it is a campaign."""
Reason = Literal["failing", "boundary", "cell"]


class SuiteError(ConfigError):
    """A suite that cannot be made, read or run."""


class SuiteOutcome(Keys, strict=True):
    """Outcome of a test on a simulator, with the suite's network; fitness is the smallest lateral distance, m."""

    outcome: Literal["COMPLETED", "OUT_OF_BOUNDS", "STUCK", "TIMEOUT"]
    fitness: Annotated[float, Field(allow_inf_nan=False)]
    trajectory_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class SuiteTest(Keys, strict=True):
    """Test of a suite.

    Attributes:
        name: of the test in its campaign.
        control_points: of the road, m; for their digest see `road_sha256`.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,200}$")]
    why: Annotated[list[Reason], Field(min_length=1)]
    control_points: Annotated[list[list[float]], Field(min_length=4, max_length=1000)]
    road_sha256: str
    seed: Annotated[int, Field(ge=0, lt=2**32)]
    conditions: ConditionsText = DEFAULT
    cell: list[int] | None = None
    outcomes: Annotated[dict[SimulatorName, SuiteOutcome], Field(min_length=1)]


class Suite(Keys, strict=True):
    """Regression suite.

    Attributes:
        campaign: name of the campaign's folder.
        driver_sha256: digest of its files, or "".
        maxitwo_compatible: as in the campaign's configuration.
        code_sha256: digest of the simulators' code by which the outcomes came about.
    """

    format: Literal["digital-siblings-suite"] = "digital-siblings-suite"
    version: Literal[1] = 1
    campaign: str
    driver: DriverText
    driver_sha256: str = ""
    siblings: Annotated[list[SimulatorName], Field(min_length=1, max_length=20)]
    twin: SimulatorName | None = None
    lane: Side = "right"
    maxitwo_compatible: bool = False
    features: list[str] = list(DEFAULT_FEATURES)
    code_sha256: str = ""
    tests: Annotated[list[SuiteTest], Field(min_length=1, max_length=MOST_TESTS)]

    @model_validator(mode="after")
    def _consistent(self) -> Suite:
        names = [test.name for test in self.tests]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"tests: {twice[0]} is there twice, expected each name once")
        if not 2 <= len([feature_of(name) for name in self.features]) <= 3:
            raise ValueError(f"features: {len(self.features)} of them, expected two or three")
        for test in self.tests:
            if test.cell is not None and len(test.cell) != len(self.features):
                raise ValueError(f"test {test.name} has a cell of {len(test.cell)} bins, expected {len(self.features)}")
            if road_sha256(test.control_points) != test.road_sha256:
                raise ValueError(
                    f"the road of test {test.name} does not match its digest: it was changed after the suite was made; "
                    "restore the file"
                )
            unknown = sorted(set(test.outcomes) - set(self.simulators))
            if unknown:
                raise ValueError(f"test {test.name} has an outcome on {unknown[0]}, which is not among the simulators")
            validity = self.scenario_of(test).road.validity
            if not validity.valid:
                raise ValueError(f"the road of test {test.name} is not valid: {validity.reason}")
        return self

    @property
    def simulators(self) -> list[SimulatorName]:
        """Siblings, then the twin if there is one."""
        return [*self.siblings, *([self.twin] if self.twin else [])]

    def scenario_of(self, test: SuiteTest) -> Scenario:
        """The scenario of a test, in the suite's lane."""
        road = Road(test.control_points, maxitwo_compatible=self.maxitwo_compatible, lane=self.lane)
        return Scenario(road, test.conditions, seed=test.seed)


def road_sha256(control_points: list[list[float]]) -> str:
    """Digest of control points: SHA-256 over their JSON, every number as Python's shortest exact decimal."""
    points = [[float(value) for value in point] for point in control_points]
    return hashlib.sha256(json.dumps(points).encode()).hexdigest()


def write_suite(suite: Suite, path: Path) -> None:
    """Write a suite, one test a line, so that a diff shows what changed."""
    document = _moved(suite.model_dump(), Path(), path.parent)
    tests = document.pop("tests")
    head = json.dumps(document, indent=1, allow_nan=False).removesuffix("\n}")
    lines = ",\n".join("  " + json.dumps(test, allow_nan=False) for test in tests)
    write_whole(path, f'{head},\n "tests": [\n{lines}\n ]\n}}\n')


def read_suite(path: Path) -> Suite:
    """Read and check a suite; `SuiteError` if the file is no suite, of another version, changed, or unreadable."""
    try:
        raw: Any = read_json(path, LARGEST_FILE)
    except OSError as error:
        raise SuiteError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except FileError as error:
        raise SuiteError(f"{path}: {error}: expected a suite of `ds suite make`") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise SuiteError(f"{path}: no suite, expected a file of `ds suite make`")
    version = raw.get("version")
    if version != VERSION:
        age = "a newer" if isinstance(version, int) and version > VERSION else "another"
        raise SuiteError(
            f"{path}: made by {age} version of ds (suite version {version!s:.20}, expected {VERSION}): use that "
            "version, or make the suite again with `ds suite make`"
        )
    try:
        return Suite.model_validate(_moved(raw, path.parent, Path()))
    except ValidationError as error:
        raise SuiteError(f"{path}: {problems(error, Suite)}") from None
    except RecursionError:
        raise SuiteError(f"{path}: nested too deeply, expected a suite of `ds suite make`") from None


def _moved(raw: Any, start: Path, end: Path) -> Any:
    """A suite's document whose paths, relative to one folder, are made relative to another."""
    moved = rebase_paths(raw, start, end)
    for test in moved["tests"] if isinstance(moved.get("tests"), list) else ():
        if isinstance(test, dict) and isinstance(test.get("outcomes"), dict):
            outcomes = test["outcomes"].items()
            test["outcomes"] = {str(SimulatorName(name).moved(start, end)): one for name, one in outcomes}
    return moved


TESTS = 30
"""Tests of a suite; chosen: 90 drives on three simulators, five minutes at the 18 drives a minute of two cores."""


def select(data: CampaignData, *, most: int) -> dict[str, list[Reason]]:
    """Choose tests, in turns from three lists until there are enough; why each was chosen.

    - `failing`: fails on most simulators first, then the largest distance out of the lane.
    - `boundary`: smallest absolute margin to the lane's edge on any simulator, on either side of it.
    - `cell`: of every cell the test with the smallest margin; cells with the smallest one first.

    Only tests with a verdict on every simulator take part.
    """
    done = {(one.test_id, one.simulator): one for one in data.verdicts}
    names = data.config.simulators
    margins: dict[str, list[float]] = {}
    failures: dict[str, int] = {}
    for test in data.tests:
        runs = [done[key] for name in names if (key := (test.test_id, name)) in done]
        if len(runs) == len(names):
            margins[test.test_id] = [run.fitness for run in runs]
            failures[test.test_id] = sum(run.outcome.is_failure for run in runs)
    failing = sorted((i for i in margins if failures[i]), key=lambda i: (-failures[i], min(margins[i]), i))
    boundary = sorted(margins, key=lambda i: (min(map(abs, margins[i])), i))
    worst_first = sorted(margins, key=lambda i: (min(margins[i]), i))
    of_cell: dict[object, str] = {}
    for test_id in worst_first:
        if test_id in data.cells:
            of_cell.setdefault(data.cells[test_id], test_id)
    lists: dict[Reason, list[str]] = {"failing": failing, "boundary": boundary, "cell": list(of_cell.values())}
    return _in_turns(lists, most)


def _in_turns(lists: Mapping[Reason, Sequence[str]], most: int) -> dict[str, list[Reason]]:
    """Take from each list in turn the next test that is not chosen yet; a test that fails or is its cell's says so."""
    chosen: dict[str, list[Reason]] = {}
    rest = {reason: iter(tests) for reason, tests in lists.items()}
    while rest and len(chosen) < most:
        for reason in list(rest):
            test_id = next((i for i in rest[reason] if i not in chosen), None)
            if test_id is None:
                del rest[reason]
            elif len(chosen) < most:
                chosen[test_id] = [
                    name for name in lists if name == reason or (name != "boundary" and test_id in lists[name])
                ]
    return chosen


def suite_of(folder: Path, data: CampaignData, *, most: int = TESTS) -> Suite:
    """Make a suite of a campaign's tests that tell most; `SuiteError` if none has a verdict on every simulator."""
    chosen = select(data, most=min(most, MOST_TESTS))
    if not chosen:
        raise SuiteError(
            f"{folder} has no test with a verdict on every simulator: run "
            f"`{ds_command('campaign', 'resume', folder)}` first"
        )
    config = data.config
    done = {(one.test_id, one.simulator): one for one in data.verdicts}
    by_id, tests = {test.test_id: test for test in data.tests}, []
    for test_id, why in chosen.items():
        test, cell = by_id[test_id], data.cells.get(test_id)
        points = [[float(value) for value in point] for point in test.road.control_points]
        suite_test = SuiteTest(
            name=test_id,
            why=why,
            control_points=points,
            road_sha256=road_sha256(points),
            seed=test.seed,
            conditions=test.conditions,
            cell=None if cell is None else list(cell),
            outcomes={name: _expected(done[test_id, name]) for name in config.simulators},
        )
        tests.append(suite_test)
    return Suite(
        campaign=folder.resolve().name,
        driver=data.driver,
        driver_sha256=data.notes.get(DRIVER_SHA256, ""),
        siblings=list(config.siblings),
        twin=config.twin,
        lane=config.lane,
        maxitwo_compatible=config.maxitwo_compatible,
        features=list(config.features),
        code_sha256=code_sha256(),
        tests=tests,
    )


def settings_of_suite(suite: Suite, driver: DriverName) -> DriveSettings:
    """How a suite's tests are driven: without gates, as the suite's tests are known to be valid."""
    return DriveSettings(siblings=tuple(suite.siblings), twin=suite.twin, driver=driver, gates="none")


def run_suite(
    suite: Suite, settings: DriveSettings, candidate: Network, folder: Path, callbacks: Callbacks, *, source: str
) -> tuple[Comparison, dict[tuple[str, SimulatorName], Execution]]:
    """Drive a suite, and compare its outcomes with those of the suite; a run that was stopped goes on in its folder.

    The settings are those of `settings_of_suite`, with the engine; `source` says where the tests come from.

    Returns:
        The comparison, and every execution by test and simulator.
    """
    tests = {one.name: Test(f"suite-0-{number:04d}", suite.scenario_of(one)) for number, one in enumerate(suite.tests)}
    work = {name: [tests[one.name] for one in suite.tests if name in one.outcomes] for name in suite.simulators}
    results = drive_tests(settings, {name: of for name, of in work.items() if of}, folder, callbacks)
    pairs, left_out, executions = [], [], {}
    for one in suite.tests:
        test = tests[one.name]
        cell = None if one.cell is None else tuple(one.cell)
        compared = ComparedTest(name=one.name, scenario=test.scenario, cell=cell)
        for name, expected in one.outcomes.items():
            key = (test.test_id, name)
            if key in results.executions:
                execution = executions[one.name, name] = results.executions[key]
                before, now = _outcome(expected), DriveOutcome.of(execution)
                pairs.append(PairedDrive(test=compared, simulator=name, reference=before, candidate=now))
            elif key in results.errors:
                left_out.append((one.name, name, str(results.errors[key])))
    comparison = compare_networks(
        pairs,
        reference=Network(driver=suite.driver, sha256=suite.driver_sha256),
        candidate=candidate,
        origin="suite",
        source=source,
        simulators=suite.simulators,
        features=[feature_of(name) for name in suite.features],
        twin=suite.twin,
        excluded=len(results.excluded),
        left_out=left_out,
    )
    return comparison, executions


def with_outcomes(
    suite: Suite, candidate: Network, executions: dict[tuple[str, SimulatorName], Execution], code: str
) -> Suite:
    """The same tests with the outcomes of another network, to be expected from now on."""
    tests = []
    for test in suite.tests:
        driven = {
            name: _expected(executions[key]) for name in test.outcomes if (key := (test.name, name)) in executions
        }
        tests.append(test.model_copy(update={"outcomes": test.outcomes | driven}))
    now = {"driver": str(candidate.driver), "driver_sha256": candidate.sha256, "code_sha256": code, "tests": tests}
    return suite.model_copy(update=now)


def _outcome(expected: SuiteOutcome) -> DriveOutcome:
    return DriveOutcome(
        outcome=Outcome[expected.outcome], fitness=expected.fitness, trajectory_sha256=expected.trajectory_sha256
    )


def _expected(execution: Execution) -> SuiteOutcome:
    values = {name: getattr(execution, name) for name in ("fitness", "trajectory_sha256")}
    return SuiteOutcome.model_validate(values | {"outcome": execution.outcome.name})
