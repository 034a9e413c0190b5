"""File of a regression suite: tests with the outcomes of the network from whose campaign they were chosen.

A suite is data: it names simulators and drivers, and runs no code of its own.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ds_orchestrator.campaign.config import ConditionsText, ConfigError
from ds_orchestrator.campaign.config_errors import problems
from ds_orchestrator.search.features import DEFAULT_FEATURES, feature_of
from ds_road import Road
from ds_sim.bounded_yaml import BoundedYamlError, read_bounded
from ds_sim.conditions.model import DEFAULT
from ds_sim.simulator import Outcome

FORMAT = "digital-siblings-suite"
VERSION = 1
LARGEST_FILE = 16 * 2**20
"""Bytes of a suite; chosen: thousands of roads fit."""
MOST_TESTS = 2000
"""Tests of a suite; chosen: beyond, it is a campaign."""
VERDICTS = tuple(outcome.name for outcome in Outcome if outcome.is_verdict)
Reason = Literal["failing", "boundary", "cell"]


class SuiteError(ConfigError):
    """A suite that cannot be made, read or run."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class SuiteOutcome(_Strict):
    """Outcome of a test on one simulator, with the network of the suite.

    Attributes:
        outcome: name of the outcome, a verdict.
        fitness: smallest lateral distance, m.
        trajectory_sha256: digest of the trajectory.
    """

    outcome: Literal["COMPLETED", "OUT_OF_BOUNDS", "STUCK", "TIMEOUT"]
    fitness: Annotated[float, Field(allow_inf_nan=False)]
    trajectory_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class SuiteTest(_Strict):
    """Test of a suite.

    Attributes:
        name: of the test in its campaign.
        why: why it was chosen.
        control_points: of the road, m.
        road_sha256: digest of the control points; see `road_sha256`.
        seed: seed of the run.
        conditions: operating conditions.
        cell: bins of the features, or None.
        outcomes: simulator -> outcome.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,200}$")]
    why: Annotated[list[Reason], Field(min_length=1)]
    control_points: Annotated[list[list[float]], Field(min_length=4, max_length=1000)]
    road_sha256: str
    seed: Annotated[int, Field(ge=0, lt=2**32)]
    conditions: ConditionsText = DEFAULT
    cell: list[int] | None = None
    outcomes: Annotated[dict[str, SuiteOutcome], Field(min_length=1)]


class Suite(_Strict):
    """Regression suite.

    Attributes:
        format: `FORMAT`.
        version: `VERSION`.
        campaign: name of the campaign's folder.
        driver: driver of the campaign.
        driver_sha256: digest of its files, or "".
        siblings: simulators that act as siblings.
        twin: simulator that acts as the twin, or None.
        lane: lane in which roads are driven.
        maxitwo_compatible: as in the campaign's configuration.
        features: axes of the cells.
        code_sha256: digest of the simulators' code by which the outcomes came about.
        tests: the tests.
    """

    format: Literal["digital-siblings-suite"] = "digital-siblings-suite"
    version: Literal[1] = 1
    campaign: str
    driver: str
    driver_sha256: str = ""
    siblings: Annotated[list[str], Field(min_length=1, max_length=20)]
    twin: str | None = None
    lane: Literal["right", "left"] = "right"
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
            validity = self.road_of(test).validity
            if not validity.valid:
                raise ValueError(f"the road of test {test.name} is not valid: {validity.reason}")
        return self

    @property
    def simulators(self) -> list[str]:
        """Siblings, then the twin if there is one."""
        return [*self.siblings, *([self.twin] if self.twin else [])]

    def road_of(self, test: SuiteTest) -> Road:
        """The road of a test, in the suite's lane."""
        return Road(test.control_points, maxitwo_compatible=self.maxitwo_compatible, lane=self.lane)


def road_sha256(control_points: list[list[float]]) -> str:
    """Digest of control points: SHA-256 over their JSON, every number as Python's shortest exact decimal."""
    points = [[float(value) for value in point] for point in control_points]
    return hashlib.sha256(json.dumps(points).encode()).hexdigest()


def write_suite(suite: Suite, path: Path) -> None:
    """Write a suite, one test a line, so that a diff shows what changed."""
    document = suite.model_dump()
    tests = document.pop("tests")
    head = json.dumps(document, indent=1, allow_nan=False).removesuffix("\n}")
    lines = ",\n".join("  " + json.dumps(test, allow_nan=False) for test in tests)
    path.write_text(f'{head},\n "tests": [\n{lines}\n ]\n}}\n', "utf-8")


def read_suite(path: Path) -> Suite:
    """Read and check a suite.

    Raises:
        SuiteError: the file is no suite, of another version, or was changed; one line says which.
    """
    try:
        raw: Any = json.loads(read_bounded(path, LARGEST_FILE))
    except OSError as error:
        raise SuiteError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except BoundedYamlError as error:
        raise SuiteError(f"{path}: {error}") from None
    except (ValueError, RecursionError):
        raise SuiteError(f"{path}: not JSON, expected a suite of `ds suite make`") from None
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
        return Suite.model_validate(raw)
    except ValidationError as error:
        raise SuiteError(f"{path}: {problems(error, Suite)}") from None
    except RecursionError:
        raise SuiteError(f"{path}: nested too deeply, expected a suite of `ds suite make`") from None
