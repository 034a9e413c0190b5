# SPDX-License-Identifier: Apache-2.0
"""Configuration of a campaign: a YAML file, validated before anything starts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PlainSerializer, PlainValidator, ValidationError, field_validator, model_validator
from pydantic_core import PydanticKnownError

from ds_base.config_errors import Keys, problems, read_keys
from ds_base.errors import InputError
from ds_base.extension import confirm, is_extension
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.engine import DriveSettings, EngineName, Record, usual_record
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_orchestrator.maps.algebra import operator_of
from ds_orchestrator.maps.campaign_maps import MapPlan
from ds_orchestrator.search.algorithms import STEP, ConditionSpace, SearchedCondition, SearchSettings, search_of
from ds_orchestrator.search.features import DEFAULT_FEATURES, FEATURES, VISIBLE_CONTRAST, base_of, feature_of
from ds_road import Side
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions
from ds_sim.conditions.text import format_conditions, parse_conditions
from ds_sim.registry import SimulatorName, unknown_simulator

MOST_WORKERS = 64
"""Chosen: each worker is four processes or more."""
MOST_NAMES = 20
"""Siblings or operators; chosen: each pair of siblings adds a map."""
USUAL_AXES = ("line_contrast", "visibility", "veiling_luminance")
"""Conditions that become the second axis of the maps if they are searched, in this order; chosen: they decide
whether lines are seen. The first one is the curvature of the driven lane."""


class ConfigError(InputError):
    """A configuration that names an unknown key or a value that is not allowed."""


def _conditions(value: object) -> Conditions:
    if isinstance(value, Conditions):
        return value
    if value not in (None, "none") and not isinstance(value, str):
        raise ValueError(f"{value!r:.60}: expected text such as visibility=60,line_contrast=0.4, or none")
    return DEFAULT if value in (None, "none") else parse_conditions(str(value))


def _driver(value: object) -> DriverName:
    if isinstance(value, DriverName):
        return value
    if not isinstance(value, str):
        raise PydanticKnownError("string_type")
    return DriverName.parse(value)


ConditionsText = Annotated[Conditions, PlainValidator(_conditions), PlainSerializer(format_conditions)]
"""Operating conditions, written as text in a file."""
DriverText = Annotated[DriverName, PlainValidator(_driver), PlainSerializer(str)]
"""Driver, written as its name in a file."""


class SearchedConditionConfig(Keys, strict=True):
    """Operating condition that a search varies; see `SearchedCondition`."""

    low: float
    high: float
    step: float = STEP


class SearchConfig(Keys, strict=True):
    """Search on each sibling (paper 4.2.4); other attributes, and their defaults, are those of `SearchSettings`.

    Attributes:
        method: `deephyperion` as in the paper, `deephyperion_cs` with its successor's selection by contribution score,
            or `random`, the baseline.
        runs: searches on each sibling, each with its own seed (paper: 5).
        conditions: operating conditions to search beside roads, by name; none is the paper's search.
    """

    method: str = "deephyperion"
    population: Annotated[int, Field(ge=1, le=10_000)] = SearchSettings.population
    iterations: Annotated[int, Field(ge=0, le=1_000_000)] = SearchSettings.iterations
    runs: Annotated[int, Field(ge=1, le=1_000)] = 5
    min_angle: Annotated[int, Field(ge=1, le=360)] = SearchSettings.min_angle
    max_angle: Annotated[int, Field(ge=1, le=360)] = SearchSettings.max_angle
    extent: Annotated[int, Field(ge=1, le=25)] = SearchSettings.extent
    conditions: dict[str, SearchedConditionConfig] = {}
    mutate_conditions: Annotated[float, Field(ge=0, le=1)] = SearchSettings.mutate_conditions

    @field_validator("method")
    @classmethod
    def _known_method(cls, value: str) -> str:
        search_of(value)
        return value

    @model_validator(mode="after")
    def _angles_in_order(self) -> SearchConfig:
        if self.min_angle > self.max_angle:
            raise ValueError(f"min_angle {self.min_angle} is above max_angle {self.max_angle}")
        return self

    def space(self, fixed: Conditions) -> ConditionSpace:
        """Conditions to search, beside fixed ones."""
        searched = [SearchedCondition(name=name, **one.model_dump()) for name, one in self.conditions.items()]
        return ConditionSpace(tuple(searched), fixed)


class OperatorsConfig(Keys, strict=True):
    """How the siblings' union maps are merged (paper 3.5): operators on failure probabilities and on quality losses.

    Further operators, to compare, yield another merged map each.
    """

    probability: str = "product"
    quality_loss: str = "minimum"
    compare: Annotated[list[str], Field(max_length=MOST_NAMES)] = []

    @field_validator("*")
    @classmethod
    def _known_operators(cls, value: str | list[str]) -> str | list[str]:
        names = value if isinstance(value, list) else [value]
        for name in names:
            operator_of(name)
        if len(set(names)) != len(names):
            raise ValueError(f"an operator is named twice: {', '.join(names)}")
        return value


class CampaignConfig(Keys, strict=True):
    """Configuration of a campaign.

    Attributes:
        siblings: names of the simulators that act as digital siblings, in order DS1, DS2, ...
        twin: name of the simulator that acts as the digital twin, or none.
        driver: `autopilot`, a network by name, weights file or description, or module:Class, as for `ds drive`; a
            backend may follow, as in `dave2@onnx`, and generators, as in `dave2+FOLDER`.
        sim2real: generators that translate every image to a pseudo-real one before the network sees it: a shipped set,
            a folder, or `none`; it becomes part of the driver's name. False: those that the driver names, if any.
        search: search on each sibling.
        maxitwo_compatible: reproduce known quirks of the authors' package (docs/method.md).
        lane: lane in which every road is driven, `right` or `left`.
        conditions: operating conditions of every test, as in `visibility=60,line_contrast=0.4`; `none` for each
            simulator's own world.
        gates: tests that the autopilot must complete with visible lines before the driver is judged by them:
            `conditions` for tests with other than the default conditions, `all` for every test.
        features: axes of the feature maps, two or three; `minimum_radius:20` joins twenty bins into one.
        migration: `all` drives every executed test on the other siblings and the twin, `elites` only the elites of
            each search run.
        operators: merge operators.
        seed: seed from which every other seed is derived.
        engine: what drives: `graph`, nodes of ROS; `local`, processes on this machine without ROS; `auto`, `graph`
            where ROS is set up, else `local`; `dask`, processes on a cluster. Results do not depend on it.
        workers: graphs or processes that drive in parallel; results do not depend on it either, so a resumed campaign
            may change both.
        retries: further attempts after a run that ended in an error.
        command_timeout: wall-clock time that a simulator waits for its driver, s.
        record: content of a run's bag, `telemetry`, `compressed` or `raw`; `none` records no bag.
    """

    siblings: Annotated[list[SimulatorName], Field(min_length=1, max_length=MOST_NAMES)] = [
        SimulatorName("bullet"),
        SimulatorName("softbody"),
    ]
    twin: SimulatorName | None = SimulatorName("donkey")
    driver: DriverText = DriverName("dave2")
    sim2real: bool = False
    search: SearchConfig = SearchConfig()
    maxitwo_compatible: bool = False
    lane: Side = "right"
    conditions: ConditionsText = DEFAULT
    gates: Literal["conditions", "all"] = "conditions"
    features: list[str] = list(DEFAULT_FEATURES)
    migration: Literal["all", "elites"] = "all"
    operators: OperatorsConfig = OperatorsConfig()
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    engine: EngineName = "auto"
    workers: Annotated[int, Field(ge=1, le=MOST_WORKERS)] = 1
    retries: Annotated[int, Field(ge=0, le=10)] = 2
    command_timeout: Annotated[float, Field(gt=0, le=3600)] = 10.0
    record: Record = Field(default_factory=usual_record)

    @field_validator("siblings", "twin")
    @classmethod
    def _known_simulators(
        cls, value: list[SimulatorName] | SimulatorName | None
    ) -> list[SimulatorName] | SimulatorName | None:
        if value in (None, "none"):
            return None
        for name in value if isinstance(value, list) else [value]:
            if not name.exists:
                raise ValueError(unknown_simulator(name))
        return value

    @model_validator(mode="before")
    @classmethod
    def _with_generators(cls, values: Any) -> Any:
        """Make the generators part of the driver's name, so that two ways to write a campaign give one campaign."""
        if not isinstance(values, dict) or values.get("sim2real") in (None, False, ""):
            return values
        generators, driver = values["sim2real"], values.get("driver", "dave2")
        if not isinstance(generators, str) or not isinstance(driver, str | DriverName):
            raise ValueError(f"sim2real: {generators!r:.60}: expected false, or a set of generators, by name or folder")
        driver = _driver(driver)
        if driver == AUTOPILOT or driver.generators:
            raise ValueError(f"sim2real: {driver} names its generators or sees no images: leave sim2real out")
        return {**values, "sim2real": False, "driver": driver.seeing(generators)}

    @field_validator("features")
    @classmethod
    def _known_features(cls, value: list[str]) -> list[str]:
        plain = {base_of(feature_of(name).name) for name in value}
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

    @model_validator(mode="before")
    @classmethod
    def _axes_of_conditions(cls, raw: Any) -> Any:
        """Choose the default axes of a search of conditions: curvature, and the first of the usual conditions."""
        search = raw.get("search") if isinstance(raw, dict) else None
        searched = search.get("conditions") if isinstance(search, dict) else None
        if not isinstance(searched, dict) or not searched or "features" in raw:
            return raw
        axes = [name for name in (*USUAL_AXES, *FIELDS) if name in searched]
        return {**raw, "features": ["lane_curvature", axes[0]]} if axes else raw

    @model_validator(mode="after")
    def _conditions_that_can_be(self) -> CampaignConfig:
        self.search.space(self.conditions)
        for name in map(base_of, self.features):
            if name in FIELDS and name not in self.search.conditions:
                raise ValueError(f"features: {name} is not searched, expected it among search.conditions")
            if name == VISIBLE_CONTRAST and not self.has_gates:
                raise ValueError(f"features: {name} is measured by the gates, expected conditions or gates: all")
        return self

    @property
    def simulators(self) -> list[SimulatorName]:
        """Siblings, then the twin if there is one."""
        return [*self.siblings, *([self.twin] if self.twin else [])]

    @property
    def has_gates(self) -> bool:
        """Whether tests may have conditions or gates."""
        return not self.conditions.is_default or bool(self.search.conditions) or self.gates == "all"

    @property
    def elites_only(self) -> bool:
        """Whether only elites migrate."""
        return self.maxitwo_compatible or self.migration == "elites"

    @property
    def settings(self) -> SearchSettings:
        """Hyper-parameters of one search run."""
        return SearchSettings(
            **self.search.model_dump(exclude={"runs", "method", "conditions"}),
            maxitwo_compatible=self.maxitwo_compatible,
            lane=self.lane,
            conditions=self.search.space(self.conditions),
        )

    def drive_settings(self, *, cluster: ClusterOptions | None = None, attach: bool = False) -> DriveSettings:
        """How the campaign's tests are driven; see `DriveSettings`."""
        return DriveSettings(
            siblings=tuple(self.siblings),
            twin=self.twin,
            driver=self.driver,
            conditions=self.conditions,
            gates=self.gates,
            retries=self.retries,
            command_timeout=self.command_timeout,
            record=self.record,
            engine=self.engine,
            workers=self.workers,
            cluster=cluster or ClusterOptions(),
            attach=attach,
        )

    @property
    def further_axes(self) -> list[tuple[str, ...]]:
        """Axes of the maps that are drawn beside the configured ones.

        For a search of conditions these are the curvature of the driven lane by each of `USUAL_AXES` that is searched,
        and the paper's axes; none otherwise.
        """
        if not self.search.conditions:
            return []
        usual = [("lane_curvature", name) for name in USUAL_AXES if name in self.search.conditions]
        return [axes for axes in (*usual, DEFAULT_FEATURES) if axes != tuple(self.features)]

    @property
    def tests(self) -> int:
        """Number of tests that all searches generate."""
        return self.search.runs * self.settings.budget * len(self.siblings)

    @property
    def executions_at_most(self) -> int:
        """Upper bound of the number of executions; fewer are needed where only elites migrate."""
        return self.tests * len(self.simulators)

    def map_plan(self, ignored: frozenset[str] = frozenset()) -> MapPlan:
        """How maps are built; `ignored` lists tests that the search skipped because they had no outcome."""
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
        """JSON text of every key that affects results; a campaign resumes only with an equal one.

        Defaults of later keys are left out: campaigns of versions that knew no others have the same text.
        """
        lane = {"lane": True} if self.lane == "right" else {}
        return self.model_dump_json(exclude={"engine": True, "workers": True, **lane, **self._unset()})

    def shown(self) -> dict[str, Any]:
        """Every key that affects results, as a report shows it; conditions and gates only where they are set."""
        return self.model_dump(exclude={"engine": True, "workers": True, **self._unset()})

    def _unset(self) -> dict[str, Any]:
        later = {"conditions": DEFAULT, "gates": "conditions"}
        of_search = {"conditions", "mutate_conditions"} - self.search.model_dump(exclude_defaults=True).keys()
        unset: dict[str, Any] = {key: True for key, value in later.items() if getattr(self, key) == value}
        return {**unset, "search": of_search} if of_search else unset


def read_config(path: Path) -> CampaignConfig:
    """Read and validate a configuration: a YAML file, to which the paths in it are relative.

    Raises:
        ConfigError: one line with the key, what is wrong with it, and what is allowed.
    """
    raw = read_keys(path, ConfigError)
    if raw is None:
        raise ConfigError(
            f"{path}: empty, expected a campaign's keys (such as {', '.join(CampaignConfig.model_fields)})"
        )
    return parse_config(rebase_paths(raw, path.parent, Path()), str(path))


def rebase_paths(raw: Any, start: Path, end: Path) -> Any:
    """Make the paths in a configuration, which are relative to one folder, relative to another."""

    def simulator(name: Any) -> Any:
        return str(SimulatorName(name).moved(start, end)) if isinstance(name, str) else name

    if not isinstance(raw, dict):
        return raw
    moved = {key: simulator(value) if key == "twin" else value for key, value in raw.items()}
    driver, generators, siblings = raw.get("driver"), raw.get("sim2real"), raw.get("siblings")
    if isinstance(driver, str) and (name := DriverName.parse(driver)) != (there := name.moved(start, end)):
        moved["driver"] = str(there)
    if isinstance(generators, str):
        moved["sim2real"] = DriverName("", generators).moved(start, end).generators
    if isinstance(siblings, list):
        moved["siblings"] = [simulator(name) for name in siblings]
    return moved


def parse_config(raw: object, source: str, *, received: bool = False) -> CampaignConfig:
    """Validate a parsed configuration; see `read_config`.

    Args:
        raw: value of the YAML or JSON document.
        source: name of the file, for error messages.
        received: the text may come from others, so that what it names is not loaded unless the user names it, too.

    Examples:
        >>> from ds_orchestrator import parse_config
        >>> config = parse_config({"siblings": ["bullet", "softbody"], "twin": "donkey", "seed": 7}, "my.yaml")
        >>> config.twin, config.search.population
        ('donkey', 20)
    """
    if not received:
        confirm(name for name in map(base_of, _texts(raw)) if is_extension(name))
    try:
        return CampaignConfig.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(f"{source}: {problems(error, CampaignConfig)}") from None


def _texts(raw: object) -> Iterator[str]:
    """Every text in a parsed document."""
    if isinstance(raw, str):
        yield raw
    elif isinstance(raw, (dict, list)):
        for part in raw.values() if isinstance(raw, dict) else raw:
            yield from _texts(part)
