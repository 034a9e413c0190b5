"""What a campaign is told to do: a YAML file, checked before anything starts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from ds_orchestrator.campaign.config_errors import load_yaml, problems, yaml_problem
from ds_orchestrator.maps.campaign_maps import MapPlan
from ds_orchestrator.maps.merge_operators import OPERATORS
from ds_orchestrator.search.algorithms import SEARCHES
from ds_orchestrator.search.base import SearchSettings
from ds_orchestrator.search.features import DEFAULT_FEATURES, FEATURES, feature_of
from ds_sim.registry import SIMULATORS

Record = Literal["none", "telemetry", "compressed", "raw"]
MOST_WORKERS = 64
"""Chosen: each is four processes and more; nobody has that many cores to give."""


RENAMED_KEYS = {"published": "maxitwo_compatible", "operators.quality": "operators.quality_loss"}
"""Keys of earlier versions, which are still accepted, and what they are called now."""


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

    def settings(self, *, maxitwo_compatible: bool = False) -> SearchSettings:
        """The hyper-parameters of one run."""
        return SearchSettings(**self.model_dump(exclude={"runs", "method"}), maxitwo_compatible=maxitwo_compatible)


class OperatorsConfig(_Strict):
    """How the siblings' union maps are merged (paper 3.5).

    Attributes:
        probability: operator of the failure probabilities.
        quality_loss: operator of the lack of driving quality.
        compare: further operators, each of which makes a map of its own beside the merged one.
    """

    probability: str = "product"
    quality_loss: str = "minimum"
    compare: list[str] = []

    @field_validator("probability", "quality_loss")
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
        maxitwo_compatible: reproduce the five known quirks of the authors' package (docs/method.md).
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
    maxitwo_compatible: bool = False
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
        return self.maxitwo_compatible or self.migration == "elites"

    @property
    def settings(self) -> SearchSettings:
        """The hyper-parameters of one run of the search."""
        return self.search.settings(maxitwo_compatible=self.maxitwo_compatible)

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
            maxitwo_compatible=self.maxitwo_compatible,
            probability=self.operators.probability,
            quality_loss=self.operators.quality_loss,
            others=tuple(self.operators.compare),
            ignored=ignored,
        )

    def identity(self) -> str:
        """The configuration as JSON text without what changes no result; a campaign goes on with the same one only."""
        return self.model_dump_json(exclude={"workers"})


def read_config(path: Path, *, hint: Callable[[str], None] = lambda line: None) -> CampaignConfig:
    """Read and validate a configuration.

    Args:
        path: of the YAML file.
        hint: called with one line for every key that has been renamed since.

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
    return parse_config(raw, str(path), hint=hint)


def parse_config(raw: object, source: str, *, hint: Callable[[str], None] = lambda line: None) -> CampaignConfig:
    """Validate a configuration that was read already; see `read_config`.

    Args:
        raw: value of the YAML or JSON document.
        source: name of the file, for error messages.
        hint: called with one line for every key that has been renamed since.
    """
    try:
        return CampaignConfig.model_validate(_with_new_names(raw, source, hint))
    except ValidationError as error:
        raise ConfigError(f"{source}: {problems(error, CampaignConfig)}") from None


def _with_new_names(raw: object, source: str, hint: Callable[[str], None]) -> object:
    """A copy of a configuration in which renamed keys have their present names."""
    if not isinstance(raw, dict):
        return raw
    renamed = dict(raw)
    for old, new in RENAMED_KEYS.items():
        section, _, old_key = old.rpartition(".")
        holder = renamed.get(section) if section else renamed
        if not isinstance(holder, dict) or old_key not in holder:
            continue
        new_key = new.rpartition(".")[2]
        if new_key in holder:
            raise ConfigError(f"{source}: {old} and {new} are the same key: keep {new}")
        hint(f"{source}: the key {old} is called {new} now")
        changed = {new_key if key == old_key else key: value for key, value in holder.items()}
        if section:
            renamed[section] = changed
        else:
            renamed = changed
    return renamed
