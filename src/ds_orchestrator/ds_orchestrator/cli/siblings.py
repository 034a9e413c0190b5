"""`ds siblings compare`: how much the simulators agree."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_orchestrator.cli.options import (
    Backend,
    DriverName,
    JsonFlag,
    MaxAngle,
    Seed,
    Simulators,
    driver_named,
    simulators_of,
)
from ds_orchestrator.cli.output import Interrupted, Result, countdown, end, number

if TYPE_CHECKING:
    from ds_sim.session import RunRecord

PICTURED = 6
"""Roads that a comparison draws; chosen: a minute's look."""

app = typer.Typer()
siblings_app = typer.Typer(help="Compare how the simulators behave.", no_args_is_help=True)
app.add_typer(siblings_app, name="siblings")


def compare_siblings(
    driver: str, simulators: list[str], *, roads: int, seed: int, max_angle: int, out: Path | None
) -> Result:
    """Drive the same roads with the same driver on every simulator, and compare verdicts and trajectories.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: fewer than two simulators.
        Interrupted: the user stopped it; nothing is written.
    """
    import numpy as np

    import ds_road
    from ds_driver.closed_loop.simulation import Drive, drive_all
    from ds_driver.closed_loop.success_rate import unseen_roads
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.evaluation.simulator_agreement import APART, compare, most_different, summary
    from ds_orchestrator.graph.process_specs import check_driver
    from ds_sim.camera.png import png

    if len(simulators) < 2:
        raise ConfigError(f"simulators {', '.join(simulators)}: expected at least two, as --sims a,b")
    check_driver(driver)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    chosen = unseen_roads(roads, seed, max_angle=max_angle)
    drives = [Drive(name, driver, road, seed + i) for i, road in enumerate(chosen) for name in simulators]
    runs: dict[str, list[RunRecord]] = {name: [] for name in simulators}
    say = countdown()
    try:
        for done, (drive, run) in enumerate(zip(drives, drive_all(drives), strict=True), start=1):
            runs[drive.simulator].append(run)
            say(done, len(drives), f"{run.road.road_id} on {drive.simulator}: {run.outcome.name.lower()}")
    except KeyboardInterrupt:
        raise Interrupted from None
    pairs = compare(runs)
    document: dict[str, Any] = {
        "driver": driver,
        "roads": roads,
        "seed": seed,
        "max_angle": max_angle,
        "simulators": {name: summary(of) for name, of in runs.items()},
        "pairs": [asdict(pair) for pair in pairs],
        "failed_on": {
            road.road_id: [n for n in simulators if runs[n][i].outcome.is_failure] for i, road in enumerate(chosen)
        },
    }
    if out is not None:
        (out / "comparison.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
        ds_road.write_roads(chosen, out / "roads.json")
        for rank, index in enumerate(most_different(runs, PICTURED)):
            paths = {
                name: np.array([(o.vehicle.x, o.vehicle.y) for o in runs[name][index].observations])
                for name in simulators
            }
            (out / f"most_different_{rank + 1}.png").write_bytes(png(ds_road.draw(chosen[index], trajectories=paths)))

    def show() -> None:
        table = Table("simulator", "roads", "failures", "errors", "median of max |lateral|, m")
        for name, row in document["simulators"].items():
            median = row["median_max_lateral_position"]
            table.add_row(name, str(row["roads"]), str(row["failures"]), str(row["errors"]), number(median))
        Console().print(table)
        verdicts = Table("pair", "both fail", "first only", "second only", "neither", "Cohen's kappa")
        distances = Table("pair", "median apart, m", "95 %, m", f"over {APART:g} m apart", "correlation")
        for pair in pairs:
            names = f"{pair.first}, {pair.second}"
            counts = (pair.both_fail, pair.only_first_fails, pair.only_second_fails, pair.both_complete)
            kappa = number(pair.kappa) or "undefined"
            if pair.kappa_interval:
                kappa += " ({:.2f} to {:.2f})".format(*pair.kappa_interval)
            verdicts.add_row(names, *map(str, counts), kappa)
            share = "" if pair.share_apart is None else f"{pair.share_apart:.0%}"
            distances.add_row(names, number(pair.median_apart), number(pair.apart_95), share, number(pair.correlation))
        Console().print(verdicts)
        for reason in sorted({pair.reason for pair in pairs if pair.reason}):
            print(f"kappa undefined: {reason}")
        Console().print(distances)
        if out is not None:
            print(out)

    return Result(document=document, show=show, error=any(row["errors"] for row in document["simulators"].values()))


@siblings_app.command("compare")
def siblings_compare_command(
    driver: DriverName = "dave2",
    backend: Backend = "auto",
    roads: Annotated[int, typer.Option(min=1, help="Random roads.")] = 40,
    seed: Seed = 40,
    max_angle: MaxAngle = 270,
    sims: Simulators = "bullet,softbody,donkey",
    out: Annotated[Path | None, typer.Option(help="Folder for comparison.json, roads.json and pictures.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Drive the same roads on several simulators: which fail where, and how far apart the vehicles drive."""
    named = driver_named(driver, backend, "cpu")
    found = compare_siblings(named, simulators_of(sims), roads=roads, seed=seed, max_angle=max_angle, out=out)
    end(found, as_json)
