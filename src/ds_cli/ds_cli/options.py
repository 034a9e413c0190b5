# SPDX-License-Identifier: Apache-2.0
"""Options and arguments that several verbs of `ds` share."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

import typer

from ds_base.extension import confirm
from ds_sim.registry import STANDARD, SimulatorName, UnknownSimulatorError, make_simulator, simulators, with_libraries

if TYPE_CHECKING:
    from ds_analysis.comparison.ci_results import Criteria
    from ds_driver.networks.driver_name import DriverName
    from ds_orchestrator.engines.cluster import ClusterOptions

ALL = "all"
"""Name that stands for every simulator that set-up installs."""


def _complete_simulator(incomplete: str) -> list[str]:
    return [str(name) for name in simulators() if name.startswith(incomplete)]


def complete_driver(incomplete: str) -> list[str]:
    """Drivers for tab completion."""
    return [
        name
        for name in ("autopilot", "dave2", "dave2_b", "dave2_short", "chauffeur", "epoch")
        if name.startswith(incomplete)
    ]


def complete_condition(incomplete: str) -> list[str]:
    """Names of conditions for tab completion, after the complete ones before the last comma."""
    from ds_sim.conditions.model import FIELDS

    before, comma, begun = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in FIELDS if name.startswith(begun)]


def complete_value(incomplete: str) -> list[str]:
    """Names of conditions for tab completion, to be followed by a value."""
    return [f"{name}=" for name in complete_condition(incomplete)]


OutFolder = Annotated[Path, typer.Option(help="Campaign folder; a campaign that was stopped there is resumed.")]
AttachFlag = Annotated[bool, typer.Option(help="Start no nodes: use those that run in this ROS domain.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Campaign folder.")]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the random roads.")]
MaxAngle = Annotated[int, typer.Option(min=1, max=360, help="Maximum angle of random roads, degrees.")]
Lane = Annotated[
    Literal["right", "left", "middle", "single"] | None,
    typer.Option(
        help="Lane in which to drive: right, left, middle (on the centre line), or single (the only one, without a "
        "centre line). If left out, the lane of the road file, or right."
    ),
]


def simulator_option(text: str) -> Any:
    """Option for one simulator, explained by a text."""
    return typer.Option(parser=SimulatorName, metavar="<str>", help=text, autocompletion=_complete_simulator)


Simulators = Annotated[str, typer.Option(help="Simulators, separated by commas.")]
Simulator = Annotated[
    SimulatorName,
    simulator_option(
        "Simulator: bullet, softbody, panda, donkey, donkey@FILE (fitted), recording@FOLDER, ros@FILE, one of an "
        "installed package, or module:Class."
    ),
]

Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Graphs or processes that drive at the same time. If left out, as many as the configuration says, or a "
        "process for each processor. Results do not depend on it.",
    ),
]

FailOnFailure = Annotated[Literal["failure"] | None, typer.Option(help="Exit with 3 if the driver fails on any test.")]
Videos = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for a video of each failed drive, ten at most.")
]

DriverText = Annotated[
    str,
    typer.Option(
        help="Driver: autopilot, dave2, a .safetensors or .yaml file, or module:Class.", autocompletion=complete_driver
    ),
]
Backend = Annotated[str, typer.Option(help="Inference backend: auto, torch, onnx, openvino or openvino-bf16.")]

ImageTopic = Annotated[str | None, typer.Option(help="Topic of the images, if a bag has several.")]
RecordedSteering = Annotated[
    str | None, typer.Option(help="Recorded steering as TOPIC:FIELD, such as /cmd:drive.steering_angle.")
]
SteeringFactor = Annotated[
    float, typer.Option(help="Factor that scales the recorded steering to -1 (full left) to +1 (full right).")
]
ImageRows = Annotated[str | None, typer.Option(help="Image rows to keep, as FIRST:LAST; the lower part if left out.")]


def _confirm(names: list[str] | None) -> list[str] | None:
    confirm(names or ())
    return names


Trust = Annotated[
    list[str] | None,
    typer.Option(
        "--trust",
        metavar="NAME",
        callback=_confirm,
        help="Name in the folder that may run code of its own, such as module:Class; repeatable.",
    ),
]


def rows_of(text: str | None) -> tuple[int, int] | None:
    """Parse `FIRST:LAST`."""
    if text is None:
        return None
    first, colon, last = text.partition(":")
    if colon and first.isdecimal() and last.isdecimal() and len(text) < 20:
        return int(first), int(last)
    raise typer.BadParameter(f"--rows {text!r}: expected FIRST:LAST, such as 40:120")


def simulators_of(text: str, *, default: bool = False) -> list[SimulatorName]:
    """Parse simulator names separated by commas, and check that each can be made.

    Where nobody asked for these (`default`), those whose libraries are not installed are left out, with a line.
    """
    from ds_cli.output import say

    names = [SimulatorName(name) for name in text.split(",")]
    if default:
        names, left_out = with_libraries(names)
        for line in left_out:
            say(line)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UnknownSimulatorError(f"simulator {', '.join(twice)} is named twice in {text!r}: name each once")
    for name in names:
        make_simulator(name).close()
    return names


def every_or_named(text: str) -> list[SimulatorName]:
    """Parse simulator names as `simulators_of` does; `all` stands for every shipped one that can be made here."""
    return simulators_of(",".join(STANDARD), default=True) if text == ALL else simulators_of(text)


def driver_named(text: str, backend: str = "auto", device: str = "cpu") -> DriverName:
    """The driver that a word of the command line names, on a backend, as in `dave2@onnx`; refuses what cannot be."""
    from ds_driver.networks.backends import BackendError
    from ds_driver.networks.driver_name import AUTOPILOT, DriverName

    name = DriverName.parse(text)
    driver = name.on(backend, device)
    if name == AUTOPILOT and driver != name:
        raise BackendError("the autopilot runs no network: leave out --backend and --device")
    return driver


def check_writable(*paths: Path | None) -> None:
    """Refuse files that could not be written at the end, before anything is driven."""
    for path in paths:
        if path is not None and path.is_dir():
            raise IsADirectoryError(21, "is a folder, expected a file to write", str(path))
        if path is not None and not path.absolute().parent.is_dir():
            raise FileNotFoundError(2, "there is no such folder: create it first", str(path.absolute().parent))


@dataclass(frozen=True)
class PassCriteria:
    """Options of pass criteria, and of what a CI job shows."""

    fail_on: Annotated[
        Literal["failure", "regression", "worse"] | None,
        typer.Option(
            help="Exit with 3 if any test fails (failure), if any newly fails (regression), or if the network is "
            "significantly worse on some simulator (worse)."
        ),
    ] = None
    max_failures: Annotated[
        str | None,
        typer.Option(metavar="N|P%", help="Exit with 3 if more tests fail on some simulator, such as 5% or 3."),
    ] = None
    junit: Annotated[Path | None, typer.Option(metavar="FILE.xml", help="JUnit XML to write.")] = None
    has_reference: ClassVar[bool] = True

    @property
    def criteria(self) -> Criteria:
        """The pass criteria, if they make sense."""
        from ds_analysis.comparison import ci_results

        limit = None if self.max_failures is None else ci_results.MaxFailures.parse(self.max_failures)
        criteria = ci_results.Criteria(fail_on=self.fail_on, max_failures=limit)
        criteria.check(has_reference=self.has_reference)
        return criteria

    def check(self, *files: Path | None) -> None:
        """Refuse what makes no sense, and files that could not be written."""
        _ = self.criteria
        check_writable(self.junit, *files)


@dataclass(frozen=True)
class ComparisonCriteria(PassCriteria):
    """Options of a comparison's pass criteria."""

    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="Markdown summary to write, for a pull request.")
    ] = None


@dataclass(frozen=True)
class CampaignCriteria(PassCriteria):
    """Options of a campaign's pass criteria."""

    fail_on: FailOnFailure = None
    has_reference = False


@dataclass(frozen=True)
class Driving:
    """Options of what drives, and how many at a time."""

    workers: Workers = None
    engine: Annotated[
        str | None,
        typer.Option(
            "--engine",
            help="What drives: graph (nodes of ROS), local (processes without ROS), auto (graph where ROS is set up, "
            "else local) or dask (processes on a cluster). If left out, as the configuration says, or local. Results "
            "do not depend on it.",
        ),
    ] = None

    def chosen(self) -> dict[str, Any]:
        """Keys of a configuration, as far as they are chosen."""
        from ds_orchestrator.campaign.config import MOST_WORKERS, ConfigError
        from ds_orchestrator.campaign.engine import EngineName as Names

        if self.workers is not None and self.workers > MOST_WORKERS:
            raise ConfigError(f"--workers {self.workers}: expected 1 to {MOST_WORKERS}")
        if self.engine is not None and self.engine not in get_args(Names):
            raise ConfigError(f"--engine {self.engine}: expected one of {', '.join(get_args(Names))}")
        changed = {"workers": self.workers, "engine": self.engine}
        return {key: value for key, value in changed.items() if value is not None}

    def without_ros(self) -> dict[str, Any]:
        """Keys of settings: the engine `local` with a process for each processor, unless the options say otherwise."""
        from ds_orchestrator.campaign.config import MOST_WORKERS
        from ds_orchestrator.campaign.engine import engine_here

        chosen = self.chosen()
        workers = min(len(os.sched_getaffinity(0)), MOST_WORKERS)
        if engine_here(chosen.get("engine", "local")) == "graph":
            workers = 1  # one graph of nodes
        return {"engine": "local", "workers": workers, **chosen}


@dataclass(frozen=True)
class DrivingAnywhere(Driving):
    """The same with a cluster of machines."""

    cluster: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.yaml",
            help="With --engine dask: file with the scheduler and TLS files (docs/scale.md). If left out, a cluster on "
            "this machine.",
        ),
    ] = None

    def without_ros(self) -> dict[str, Any]:
        """See `Driving.without_ros`."""
        return {**super().without_ros(), "cluster": self.cluster_options()}

    def cluster_options(self) -> ClusterOptions:
        """The cluster that `--cluster` describes; one on this machine without it."""
        from ds_orchestrator.engines.cluster import ClusterOptions, read_cluster

        return ClusterOptions() if self.cluster is None else read_cluster(self.cluster)
