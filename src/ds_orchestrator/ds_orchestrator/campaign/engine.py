# SPDX-License-Identifier: Apache-2.0
"""How tests are driven, and the protocol of what drives them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Literal, Protocol

from ds_base.installation import missing_of_ros
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import SimulatorName
from ds_sim.session import RunRecord

EngineName = Literal["auto", "graph", "local", "dask"]
"""What drives. `auto` stands for `graph` where ROS is set up, and for `local` where it is not."""
Record = Literal["none", "telemetry", "compressed", "raw"]
BAG_MODULES = ("mcap", "rosbags")
"""What writes bags: the extra `recording`."""


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """How tests are driven; the meaning of each key is that of `CampaignConfig`.

    Attributes:
        gates: `none`, too: the autopilot drives no test first.
        engine: never `auto` once made; no result depends on it, nor on what follows.
        cluster: cluster of the engine `dask`.
        attach: use running nodes in this ROS domain instead of starting any.
    """

    siblings: tuple[SimulatorName, ...]
    twin: SimulatorName | None = None
    driver: DriverName
    conditions: Conditions = DEFAULT
    gates: Literal["none", "conditions", "all"] = "conditions"
    retries: int = 2
    command_timeout: float = 10.0
    record: Record = "none"
    engine: EngineName = "local"
    workers: int = 1
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    attach: bool = False

    def __post_init__(self) -> None:
        """Choose an engine for `auto`."""
        object.__setattr__(self, "engine", engine_here(self.engine, attach=self.attach))

    @property
    def simulators(self) -> tuple[SimulatorName, ...]:
        """Siblings, then the twin if there is one."""
        return (*self.siblings, *([self.twin] if self.twin else []))

    @property
    def namespaces(self) -> dict[SimulatorName, str]:
        """Simulator -> ROS namespace: /ds1, /ds2, ... for siblings in order, /twin for the twin."""
        spaces = {name: f"/ds{index}" for index, name in enumerate(self.siblings, start=1)}
        return {**spaces, self.twin: "/twin"} if self.twin else spaces

    def identity(self) -> str:
        """JSON text of what the results of given tests depend on."""
        keys = ("siblings", "twin", "driver", "gates", "retries", "command_timeout")
        return json.dumps({key: getattr(self, key) for key in keys} | {"driver": str(self.driver)})


def usual_record() -> Record:
    """Content of bags where nothing says so: telemetry, or no bag where its libraries are not installed."""
    return "none" if any(find_spec(name) is None for name in BAG_MODULES) else "telemetry"


def engine_here(engine: EngineName, *, attach: bool = False) -> EngineName:
    """What `auto` stands for here, where running nodes are used or not; any other engine stays."""
    if engine != "auto":
        return engine
    return "graph" if attach or not missing_of_ros() else "local"


Watch = Callable[[int, float, float], None]
"""Called during a run with the number of frames, the driven part of the road in [0, 1], and the lateral position, m."""


class Engine(Protocol):
    """Drives roads on simulators with one driver and the autopilot, in this process or in others."""

    @property
    def capacity(self) -> int | None:
        """Drives at a time, on whatever simulators; None where each simulator takes as many as there are workers."""
        ...

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive to an outcome, with the engine's driver or the autopilot; errors are outcomes too.

        Called from several threads. An engine that gives feedback during a run calls `watch` from another thread.
        """
        ...

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        ...
