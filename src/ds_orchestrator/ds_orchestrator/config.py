"""What a campaign is told to do: a YAML file, checked before anything starts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ds_orchestrator.search import SearchSettings
from ds_sim.registry import SIMULATORS


class ConfigError(ValueError):
    """A configuration that names an unknown key or a value that is not allowed."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SearchConfig(_Strict):
    """DeepHyperion on each sibling (paper 4.2.4: population 20, iterations 150, 5 runs)."""

    population: Annotated[int, Field(ge=1, le=10_000)] = 20
    iterations: Annotated[int, Field(ge=0, le=1_000_000)] = 150
    runs: Annotated[int, Field(ge=1, le=1_000)] = 5
    min_angle: Annotated[int, Field(ge=1, le=360)] = 100
    max_angle: Annotated[int, Field(ge=1, le=360)] = 300
    extent: Annotated[int, Field(ge=1, le=25)] = 6

    @model_validator(mode="after")
    def _angles_in_order(self) -> SearchConfig:
        if self.min_angle > self.max_angle:
            raise ValueError(f"min_angle {self.min_angle} is above max_angle {self.max_angle}")
        return self

    def settings(self) -> SearchSettings:
        """The hyper-parameters of one run."""
        return SearchSettings(**self.model_dump(exclude={"runs"}))


class CampaignConfig(_Strict):
    """A whole campaign.

    Attributes:
        siblings: names of the simulators that act as digital siblings, in order DS1, DS2, ...
        twin: name of the simulator that acts as the digital twin, or none.
        driver: `autopilot`, a network by name, weights file or description, or module:Class; as for `ds drive`, and
            with what computes it if that matters: `dave2@onnx`.
        search: the search on each sibling.
        seed: of everything.
        retries: further attempts at a run that ended in an error.
        command_timeout: s of wall clock that a simulator waits for its driver.
        record: `telemetry` leaves a bag per run, `none` does not.
    """

    siblings: Annotated[list[str], Field(min_length=1)] = ["bullet", "softbody"]
    twin: str | None = "donkey"
    driver: str = "dave2"
    search: SearchConfig = SearchConfig()
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    retries: Annotated[int, Field(ge=0, le=10)] = 2
    command_timeout: Annotated[float, Field(gt=0, le=3600)] = 10.0
    record: Annotated[str, Field(pattern="^(none|telemetry)$")] = "telemetry"

    @model_validator(mode="after")
    def _known_simulators(self) -> CampaignConfig:
        if len(set(self.simulators)) != len(self.simulators):
            raise ValueError(f"a simulator is named twice: {', '.join(self.simulators)}")
        for name in self.simulators:
            if name.partition("@")[0] not in SIMULATORS and ":" not in name:
                raise ValueError(
                    f"unknown simulator {name!r}: expected one of {', '.join(SIMULATORS)}, or module:Class"
                )
        return self

    @property
    def simulators(self) -> list[str]:
        """Siblings first, then the twin if there is one."""
        return [*self.siblings, *([self.twin] if self.twin else [])]


def read_config(path: Path) -> CampaignConfig:
    """Read and check a configuration.

    Raises:
        ConfigError: in one line, the key, what is wrong with it, and what is allowed.
    """
    try:
        raw = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not YAML ({' '.join(str(error).split())})") from None
    return parse_config(raw or {}, str(path))


def parse_config(raw: object, source: str) -> CampaignConfig:
    """Check a configuration that was read already; see `read_config`."""
    try:
        return CampaignConfig.model_validate(raw)
    except ValidationError as error:
        problems = [
            f"{'.'.join(map(str, e['loc'])) or 'top level'}: {e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        ]
        keys = ", ".join(CampaignConfig.model_fields)
        hint = f" (keys: {keys})" if any(e["type"] == "extra_forbidden" for e in error.errors()) else ""
        raise ConfigError(f"{source}: {'; '.join(problems)}{hint}") from None
