"""What a campaign is told to do: a YAML file, checked before anything starts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from ds_orchestrator.config_problems import load_yaml, problems, yaml_problem
from ds_orchestrator.features import DEFAULT_FEATURES, FEATURES, feature_of
from ds_orchestrator.maps import MapPlan
from ds_orchestrator.operators import OPERATORS
from ds_orchestrator.search import SEARCHES, SearchSettings
from ds_sim.registry import SIMULATORS

Record = Literal["none", "telemetry", "compressed", "raw"]
MOST_WORKERS = 64
"""Chosen: each is four processes and more; nobody has that many cores to give."""


class ConfigError(ValueError):
    """A configuration that names an unknown key or a value that is not allowed."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def _one_of(value: str, allowed: Any, what: str) -> str:
    if value not in allowed:
        raise ValueError(f"unknown {what} {value!r}: expected one of {', '.join(allowed)}")
    return value


class SearchConfig(_Strict):
    """The search on each sibling (paper 4.2.4: DeepHyperion, population 20, iterations 150, 5 runs).

    Attributes:
        method: `deephyperion` as in the paper, `deephyperion_cs` with its successor's selection by contribution score,
            or `random`, the baseline.
        population: random roads to begin with.
        iterations: roads after that.
        runs: searches on each sibling, each with a seed of its own.
        min_angle: degrees, smallest maximum angle of random roads.
        max_angle: degrees, largest maximum angle of random roads.
        extent: m, largest move of a control point.
    """

    method: str = "deephyperion"
    population: Annotated[int, Field(ge=1, le=10_000)] = 20
    iterations: Annotated[int, Field(ge=0, le=1_000_000)] = 150
    runs: Annotated[int, Field(ge=1, le=1_000)] = 5
    min_angle: Annotated[int, Field(ge=1, le=360)] = 100
    max_angle: Annotated[int, Field(ge=1, le=360)] = 300
    extent: Annotated[int, Field(ge=1, le=25)] = 6

    @field_validator("method")
    @classmethod
    def _known_method(cls, value: str) -> str:
        return _one_of(value, SEARCHES, "search")

    @model_validator(mode="after")
    def _angles_in_order(self) -> SearchConfig:
        if self.min_angle > self.max_angle:
            raise ValueError(f"min_angle {self.min_angle} is above max_angle {self.max_angle}")
        return self

    def settings(self, *, published: bool = False) -> SearchSettings:
        """The hyper-parameters of one run."""
        return SearchSettings(**self.model_dump(exclude={"runs", "method"}), published=published)


class OperatorsConfig(_Strict):
    """How the siblings' union maps are merged (paper 3.5).

    Attributes:
        probability: operator of the failure probabilities.
        quality: operator of the lack of driving quality.
        compare: further operators, each of which makes a map of its own beside the merged one.
    """

    probability: str = "product"
    quality: str = "minimum"
    compare: list[str] = []

    @field_validator("probability", "quality")
    @classmethod
    def _known_operator(cls, value: str) -> str:
        return _one_of(value, OPERATORS, "operator")

    @field_validator("compare")
    @classmethod
    def _known_operators(cls, value: list[str]) -> list[str]:
        for name in value:
            _one_of(name, OPERATORS, "operator")
        if len(set(value)) != len(value):
            raise ValueError(f"an operator is named twice: {', '.join(value)}")
        return value


class CampaignConfig(_Strict):
    """A whole campaign.

    Attributes:
        siblings: names of the simulators that act as digital siblings, in order DS1, DS2, ...
        twin: name of the simulator that acts as the digital twin, or none.
        driver: `autopilot`, a network by name, weights file or description, or module:Class; as for `ds drive`, and
            with what computes it if that matters: `dave2@onnx`.
        sim2real: translate every image to a pseudo-real one before the network sees it.
        search: the search on each sibling.
        published: reproduce the five known quirks of the authors' package (docs/method.md).
        features: axes of the feature maps, two or three; `minimum_radius:20` takes twenty bins as one.
        migration: `all` drives every executed test on the other siblings and the twin, `elites` only those that a run
            of the search ends with.
        operators: of the merge.
        seed: of everything.
        workers: graphs that drive at the same time; the results do not depend on it, so it may change on the way.
        retries: further attempts at a run that ended in an error.
        command_timeout: s of wall clock that a simulator waits for its driver.
        record: what a run's bag holds, `telemetry`, `compressed` or `raw`; `none` leaves no bag.
    """

    siblings: Annotated[list[str], Field(min_length=1)] = ["bullet", "softbody"]
    twin: str | None = "donkey"
    driver: str = "dave2"
    sim2real: bool = False
    search: SearchConfig = SearchConfig()
    published: bool = False
    features: list[str] = list(DEFAULT_FEATURES)
    migration: Literal["all", "elites"] = "all"
    operators: OperatorsConfig = OperatorsConfig()
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    workers: Annotated[int, Field(ge=1, le=MOST_WORKERS)] = 1
    retries: Annotated[int, Field(ge=0, le=10)] = 2
    command_timeout: Annotated[float, Field(gt=0, le=3600)] = 10.0
    record: Record = "telemetry"

    @field_validator("siblings", "twin")
    @classmethod
    def _known_simulators(cls, value: list[str] | str | None) -> list[str] | str | None:
        for name in value if isinstance(value, list) else [value]:
            if name not in (None, "none") and name.partition("@")[0] not in SIMULATORS and ":" not in name:
                raise ValueError(
                    f"unknown simulator {name!r}: expected one of {', '.join(SIMULATORS)}, or module:Class"
                )
        return None if value == "none" else value

    @field_validator("sim2real")
    @classmethod
    def _no_model_yet(cls, value: bool) -> bool:
        if value:
            raise ValueError("there is no model that makes images look real: expected false")
        return value

    @field_validator("features")
    @classmethod
    def _known_features(cls, value: list[str]) -> list[str]:
        plain = {feature_of(name).name.partition(":")[0] for name in value}
        if len(plain) != len(value) or not 2 <= len(value) <= 3:
            raise ValueError(f"[{', '.join(value)}]: expected two or three different ones of {', '.join(FEATURES)}")
        if {"turns_count", "segment_count"} <= plain:
            raise ValueError("turns_count and segment_count are the same number: leave one of them out")
        return value

    @model_validator(mode="after")
    def _different_simulators(self) -> CampaignConfig:
        twice = sorted({name for name in self.siblings if self.siblings.count(name) > 1})
        if twice:
            raise ValueError(f"siblings: {', '.join(twice)} is named twice, expected each simulator once")
        if self.twin in self.siblings:
            raise ValueError(f"twin: {self.twin} is a sibling too, expected another simulator, or none")
        return self

    @property
    def simulators(self) -> list[str]:
        """Siblings first, then the twin if there is one."""
        return [*self.siblings, *([self.twin] if self.twin else [])]

    @property
    def elites_only(self) -> bool:
        """Whether only elites leave the sibling on which they were found."""
        return self.published or self.migration == "elites"

    @property
    def settings(self) -> SearchSettings:
        """The hyper-parameters of one run of the search."""
        return self.search.settings(published=self.published)

    @property
    def executions_at_most(self) -> int:
        """Executions of the whole campaign; fewer where only elites are migrated."""
        tests = self.search.runs * self.settings.budget * len(self.siblings)
        return tests * len(self.simulators)

    def map_plan(self, ignored: frozenset[str] = frozenset()) -> MapPlan:
        """How the maps are made; `ignored` are the tests without whose outcome a search went on."""
        return MapPlan(
            features=tuple(self.features),
            elites_only=self.elites_only,
            published=self.published,
            probability=self.operators.probability,
            quality=self.operators.quality,
            others=tuple(self.operators.compare),
            ignored=ignored,
        )

    def identity(self) -> str:
        """The configuration as JSON text without what changes no result; a campaign goes on with the same one only."""
        return self.model_dump_json(exclude={"workers"})


def read_config(path: Path) -> CampaignConfig:
    """Read and check a configuration.

    Raises:
        ConfigError: in one line, the key, what is wrong with it, and what is allowed.
    """
    try:
        raw = load_yaml(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not YAML: {yaml_problem(error)}") from None
    if raw is None:
        raise ConfigError(
            f"{path}: empty, expected a campaign's keys (such as {', '.join(CampaignConfig.model_fields)})"
        )
    return parse_config(raw, str(path))


def parse_config(raw: object, source: str) -> CampaignConfig:
    """Check a configuration that was read already; see `read_config`."""
    try:
        return CampaignConfig.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(f"{source}: {problems(error, CampaignConfig)}") from None
