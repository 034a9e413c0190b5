"""The command `ds`: every verb of the project, for people and for programs.

Results go to standard output, with `--json` as one JSON document and nothing else; everything else goes to standard
error. Exit status: 0 done, 1 a run ended in an error, 2 bad input.
"""

from __future__ import annotations

import json
import sqlite3
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ds_orchestrator import commands
from ds_orchestrator.config import read_config
from ds_sim.registry import UnknownSimulatorError, make_simulator

app = typer.Typer(
    help="Test a driving network on digital siblings.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
road_app = typer.Typer(help="Roads: generate, check, show.", no_args_is_help=True)
campaign_app = typer.Typer(help="Campaigns: run, resume, look at.", no_args_is_help=True)
siblings_app = typer.Typer(help="Siblings: how differently they behave.", no_args_is_help=True)
app.add_typer(siblings_app, name="siblings")
twin_app = typer.Typer(help="The digital twin: fit it to recorded drives.", no_args_is_help=True)
app.add_typer(road_app, name="road")
app.add_typer(twin_app, name="twin")
app.add_typer(campaign_app, name="campaign")

JsonFlag = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]
OutFolder = Annotated[Path, typer.Option(help="Folder of the campaign; one that was stopped there goes on.")]
AttachFlag = Annotated[bool, typer.Option(help="Start nothing: use the nodes that run in this ROS domain.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a campaign.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random road.")]
MaxAngle = Annotated[int, typer.Option(min=1, max=360, help="Maximum angle of random roads, degrees.")]


@app.command()
def demo(out: OutFolder = Path("demo"), attach: AttachFlag = False, as_json: JsonFlag = False) -> None:
    """The whole method, small, with the shipped network; ends with the path of the report."""
    _end(commands.run_campaign(commands.shipped_config("demo"), out, attach=attach), as_json)


@campaign_app.command("run")
def campaign_run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="What to do.")],
    out: OutFolder,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a campaign, or go on with the one in the folder if it has the same configuration."""
    _end(commands.run_campaign(read_config(config), out, attach=attach), as_json)


@campaign_app.command("resume")
def campaign_resume(folder: Folder, attach: AttachFlag = False, as_json: JsonFlag = False) -> None:
    """Go on with a campaign that was stopped."""
    _end(commands.run_campaign(commands.stored_config(folder), folder, attach=attach), as_json)


@campaign_app.command("status")
def campaign_status(folder: Folder, as_json: JsonFlag = False) -> None:
    """How far a campaign is."""
    _show(commands.status(folder), as_json)


@app.command()
def drive(
    sim: Annotated[str, typer.Option(help="bullet, softbody, donkey, donkey@FILE, or module:Class.")],
    driver: Annotated[str, typer.Option(help="autopilot, dave2, or a weights file.")] = "dave2",
    road: Annotated[Path | None, typer.Option(help="File with one road as JSON.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the run, and of the road if no file is given.")] = 0,
    max_angle: MaxAngle = 270,
    bag: Annotated[Path | None, typer.Option(help="Write a rosbag2 folder here.")] = None,
    video: Annotated[Path | None, typer.Option(help="Write an .mp4 of the drive here.")] = None,
    attach: AttachFlag = False,
    namespace: Annotated[str, typer.Option(help="Of the simulator.")] = "/ds1",
    as_json: JsonFlag = False,
) -> None:
    """Drive one road and say how it went."""
    chosen = commands.one_road(road, seed, max_angle)
    result = commands.drive(sim, driver, chosen, seed=seed, bag=bag, video=video, attach=attach, namespace=namespace)
    _end(result, as_json)


@app.command()
def maps(folder: Folder, as_json: JsonFlag = False) -> None:
    """Every feature map of a campaign."""
    _show(commands.maps(folder), as_json)


@app.command()
def evaluate(folder: Folder, as_json: JsonFlag = False) -> None:
    """How well the siblings and their merge foretell the twin."""
    _show(commands.evaluation(folder), as_json)


@app.command()
def report(folder: Folder) -> None:
    """Write the report of a campaign again."""
    print(commands.report(folder))


@road_app.command("generate")
def road_generate(
    seed: Seed = 0,
    count: Annotated[int, typer.Option(min=1, max=100_000, help="How many.")] = 1,
    max_angle: MaxAngle = 270,
) -> None:
    """Random roads as a JSON list on standard output."""
    print(json.dumps(commands.generate_roads(seed, count, max_angle)))


@road_app.command("check")
def road_check(file: Annotated[Path, typer.Argument(help="JSON list of roads.")], as_json: JsonFlag = False) -> None:
    """Validity and features of every road of a file."""
    _show(commands.check_roads(file), as_json)


@road_app.command("show")
def road_show(
    file: Annotated[Path | None, typer.Argument(help="File with one road as JSON.")] = None,
    seed: Seed = 0,
    max_angle: MaxAngle = 270,
    out: Annotated[Path, typer.Option(help="PNG to write.")] = Path("road.png"),
) -> None:
    """Draw a road."""
    print(commands.show_road(file, seed, max_angle, out))


@twin_app.command("fit")
def twin_fit(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Bags and Donkey Car tubs.")],
    out: Annotated[Path, typer.Option(help="File of parameters to write; fit.png goes beside it.")] = Path(
        "parameters.yaml"
    ),
    start: Annotated[Path | None, typer.Option(help="File of parameters to begin with; nominal if left out.")] = None,
    window: Annotated[float, typer.Option(min=1.0, max=30.0, help="Length of a window, s.")] = 3.0,
    evaluations: Annotated[int, typer.Option(min=1, help="At most, per round.")] = 40,
    as_json: JsonFlag = False,
) -> None:
    """Fit the twin's parameters to recorded drives."""
    _show(commands.fit_twin(logs, out, start, window=window, evaluations=evaluations), as_json)


@app.command()
def collect(
    out: Annotated[Path, typer.Option(help="Folder of the data set; a collection that was stopped goes on.")],
    roads: Annotated[int, typer.Option(min=1, help="Random roads, each driven both ways.")] = 25,
    seed: Seed = 1,
    every: Annotated[int, typer.Option(min=1, help="Keep one frame of so many.")] = 1,
    disturbance: Annotated[float, typer.Option(min=0.0, max=1.0, help="Steering pushes while driving.")] = 0.0,
    sims: Annotated[str, typer.Option(help="Simulators, separated by commas.")] = "bullet,softbody,donkey",
) -> None:
    """Labelled driving data from the autopilot."""
    commands.collect(out, _simulators(sims), roads=roads, seed=seed, every=every, disturbance=disturbance)


@app.command()
def train(
    data: Annotated[Path, typer.Option(help="Folder of a data set.")],
    out: Annotated[Path, typer.Option(help="Folder for weights; a training that was stopped there goes on.")],
    network: Annotated[str, typer.Option(help="Architecture.")] = "dave2",
    seed: Seed = 1,
    epochs: Annotated[int, typer.Option(min=1, help="At most.")] = 12,
    images: Annotated[int | None, typer.Option(min=1, help="At most so many per simulator.")] = None,
    learning_rate: Annotated[float, typer.Option(min=1e-7, max=1.0, help="Of Adam.")] = 1e-4,
    threads: Annotated[int, typer.Option(min=1, help="Of the mathematics.")] = 2,
) -> None:
    """Train one network for all simulators of a data set."""
    plan = {"network": network, "seed": seed, "epochs": epochs, "images_per_simulator": images}
    commands.train(data, out, learning_rate=learning_rate, threads=threads, **plan)


@app.command()
def assess(
    network: Annotated[str, typer.Argument(help="dave2 or a weights file.")] = "dave2",
    roads: Annotated[int, typer.Option(min=1, help="Random roads that no training has seen.")] = 25,
    seed: Seed = 424242,
    sims: Annotated[str, typer.Option(help="Simulators, separated by commas.")] = "bullet,softbody,donkey",
    as_json: JsonFlag = False,
) -> None:
    """Share of unseen roads that a network completes on each simulator."""
    _show(commands.assess(network, roads=roads, seed=seed, simulators=_simulators(sims)), as_json)


@siblings_app.command("compare")
def siblings_compare(
    driver: Annotated[str, typer.Option(help="autopilot, dave2, or a weights file.")] = "dave2",
    roads: Annotated[int, typer.Option(min=1, help="Random roads.")] = 40,
    seed: Seed = 40,
    max_angle: MaxAngle = 270,
    sims: Annotated[str, typer.Option(help="Simulators, separated by commas.")] = "bullet,softbody,donkey",
    out: Annotated[Path | None, typer.Option(help="Folder for numbers, roads and pictures.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """The same roads with the same driver: which fail where, and how far apart the vehicles drive."""
    found = commands.compare_siblings(driver, _simulators(sims), roads=roads, seed=seed, max_angle=max_angle, out=out)
    _end(found, as_json)


@app.command()
def models(as_json: JsonFlag = False) -> None:
    """The networks that are shipped, and how good they are."""
    _show(commands.models(), as_json)


def _simulators(text: str) -> list[str]:
    """Simulators by name, separated by commas; each can be made, and none is named twice."""
    names = text.split(",")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UnknownSimulatorError(f"simulator {', '.join(twice)} is named twice in {text!r}: name each once")
    for name in names:
        make_simulator(name).close()
    return names


def _show(result: commands.Result, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result.document, allow_nan=False))
    else:
        result.show()


def _end(result: commands.Result, as_json: bool) -> None:
    """Show a result, and end with status 1 if a run ended in an error."""
    _show(result, as_json)
    if result.error:
        raise typer.Exit(1)


def _one_line(error: BaseException) -> str:
    text: Any = error.strerror if isinstance(error, OSError) and error.strerror else error
    where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
    return f"{where}{' '.join(str(text).split())}"


def _say_stopped() -> None:
    print("stopped: what was finished is kept, the same command goes on from there", file=sys.stderr)


def main() -> None:
    """Run `ds`; whatever goes wrong ends in one line on standard error."""
    try:
        app(prog_name="ds")
    except commands.Interrupted:
        _say_stopped()
        sys.exit(130)
    except SystemExit as end:
        if end.code == 130:  # typer's answer to Ctrl-C
            _say_stopped()
        raise
    except (ValueError, OSError, sqlite3.Error) as error:
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except RuntimeError as error:
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
