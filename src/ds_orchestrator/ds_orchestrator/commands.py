"""What the verbs of `ds` do, each returning a result that can be shown to a person or written as JSON."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import ds_road
from ds_driver.driving import AUTOPILOT
from ds_orchestrator import results
from ds_orchestrator.campaign import Campaign, Stopped, execution_of
from ds_orchestrator.config import CampaignConfig, ConfigError
from ds_orchestrator.lock import only_one
from ds_orchestrator.pictures import png
from ds_orchestrator.progress import ScreenWatcher
from ds_orchestrator.store import Store
from ds_orchestrator.versions import versions
from ds_road import write_roads
from ds_sim.session import RunRecord

PICTURED = 6
"""Roads that a comparison draws; chosen: what one looks at in a minute."""


class Interrupted(Exception):
    """The user stopped a command."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a verb found out.

    Attributes:
        document: as JSON values.
        show: shows it to a person, on standard output.
        error: True if a run ended in an error.
    """

    document: Any
    show: Callable[[], None]
    error: bool = False


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _countdown() -> Callable[[int, int, str], None]:
    """Says what is done, and for how long it will go on if it goes on like this."""
    started = time.monotonic()

    def progress(done: int, total: int, line: str) -> None:
        left = (time.monotonic() - started) / done * (total - done)
        _say(f"{done}/{total} {line}; about {left:.0f} s left")

    return progress


def run_campaign(config: CampaignConfig, out: Path, *, attach: bool = False) -> Result:
    """Run a campaign to its report, or go on with it.

    Raises:
        Interrupted: the user stopped it; what was finished is kept.
    """
    from ds_orchestrator.graph_plan import check_driver
    from ds_sim.registry import make_simulator

    check_driver(config.driver)
    for name in config.simulators:
        make_simulator(name).close()
    out.mkdir(parents=True, exist_ok=True)
    with only_one(out):
        return _run_campaign(config, out, attach=attach)


def _run_campaign(config: CampaignConfig, out: Path, *, attach: bool) -> Result:
    from ds_driver.weights import weights_sha256
    from ds_orchestrator.graph_plan import namespaces_of
    from ds_orchestrator.running import running_graph

    store = Store(out / "campaign.sqlite", config=config.model_dump_json())
    if config.driver != AUTOPILOT:
        weights = weights_sha256(config.driver)
        if store.note("sha256 of the driver's weights", weights) != weights:
            raise ConfigError(f"the weights of {config.driver} have changed since {out} began: choose another --out")
    for name, version in versions().items():
        if store.note(f"version {name}", version) != version:
            store.note(f"version {name}, later", version)
    _note_parameter_files(store, config)
    (out / "bags").mkdir(exist_ok=True)
    namespaces = namespaces_of(config.siblings, config.twin)
    started = time.monotonic()
    try:
        with (
            running_graph(
                namespaces, config.driver, command_timeout=config.command_timeout, logs=out / "logs", attach=attach
            ) as executor,
            ScreenWatcher(Campaign.executions_in_all(config)) as watcher,
        ):
            campaign = Campaign(config, out, store, executor, watcher, namespaces)
            try:
                campaign.run()
            except BaseException:
                executor.stop()
                raise
    except (KeyboardInterrupt, Stopped):
        store.close()
        raise Interrupted from None
    _say(f"executed in {time.monotonic() - started:.0f} s; drawing maps and report")
    report = results.write_all(out, store)
    document: dict[str, Any] = {
        "folder": str(out),
        "report": str(report),
        "executions": len(store.executions()),
        "executions_in_error": campaign.failed_executions,
        "correlations": [asdict(c) for c in results.correlations_of(config, results.maps_of(store))],
    }
    table = _correlation_table(document["correlations"])
    store.close()

    def show() -> None:
        Console().print(table)
        print(report)

    return Result(document=document, show=show, error=campaign.failed_executions > 0)


def _note_parameter_files(store: Store, config: CampaignConfig) -> None:
    """Remember what is in each simulator's parameter file; a campaign does not go on with another car."""
    from ds_sim.registry import make_simulator

    known = store.notes()
    for name in config.simulators:
        if "@" in name:
            key, content = f"car {name}", str(make_simulator(name).spec.extra.get("car", ""))
            if known.get(key, content) != content:
                raise ConfigError(f"{name}: the file has changed since the campaign began: restore it or begin anew")
            store.note(key, content)


def stored_config(folder: Path) -> CampaignConfig:
    """The configuration of a campaign that was begun."""
    store = results.open_store(folder)
    config = results.config_of(store)
    store.close()
    return config


def status(folder: Path) -> Result:
    """How far a campaign is."""
    store = results.open_store(folder)
    config = results.config_of(store)
    executions = store.executions()
    counts: dict[str, dict[str, int]] = {name: {} for name in config.simulators}
    for execution in executions:
        counts[execution.simulator][execution.outcome.name] = (
            counts[execution.simulator].get(execution.outcome.name, 0) + 1
        )
    document: dict[str, Any] = {
        "executions": len(executions),
        "executions_in_all": Campaign.executions_in_all(config),
        "outcomes": counts,
        "errors": [
            dict(zip(("test_id", "simulator", "attempt", "outcome", "message"), row, strict=True))
            for row in store.errors()
        ],
    }
    store.close()

    def show() -> None:
        table = Table(title=f"{document['executions']} of {document['executions_in_all']} executions")
        for column in ("simulator", "outcome", "tests"):
            table.add_column(column)
        for simulator, outcomes in counts.items():
            for outcome, count in sorted(outcomes.items()):
                table.add_row(simulator, outcome.lower(), str(count))
        Console().print(table)

    return Result(document=document, show=show)


def drive(
    sim: str,
    driver: str,
    road: ds_road.Road,
    *,
    seed: int,
    bag: Path | None,
    video: Path | None,
    attach: bool,
    namespace: str,
) -> Result:
    """Drive one road through the graph; with `attach`, whatever driver runs there drives."""
    from ds_orchestrator.bags import BagError, write_bag
    from ds_orchestrator.graph_plan import check_driver
    from ds_orchestrator.redriving import redrive
    from ds_orchestrator.running import running_graph
    from ds_orchestrator.video import check_path, write_video
    from ds_sim.registry import make_simulator

    make_simulator(sim)
    if not attach:
        check_driver(driver)
    if road.sampled or road.published or road.lane_width != ds_road.LANE_WIDTH:
        # A road travels to a simulator as its control points alone, which would give another road here.
        raise ds_road.RoadError(
            "a road of road points, or of another lane width, can be checked and shown, not driven: give its control "
            f"points, with lanes of {ds_road.LANE_WIDTH:g} m"
        )
    if not road.validity.valid:
        raise ds_road.RoadError(f"the road is not valid: {road.validity.reason}")
    if bag is not None and bag.exists():
        raise BagError(f"{bag} exists already: choose another folder")
    if video is not None:
        check_path(video)
    namespaces = {sim: namespace}
    with tempfile.TemporaryDirectory(prefix="ds_drive_") as logs:
        try:
            with running_graph(namespaces, driver, command_timeout=10.0, logs=Path(logs), attach=attach) as executor:
                started = time.monotonic()
                run = executor.execute(sim, road, seed)
                wall = time.monotonic() - started
        except KeyboardInterrupt:
            raise Interrupted from None
    if bag is not None:
        write_bag(bag, namespaces[sim], run, {"simulator": sim, "driver": driver})
    whose = "attached" if attach else driver
    if video is not None:
        # The images travelled to the driver only; the same commands show them again.
        write_video(video, f"{sim}, {Path(whose).name}", road, redrive(sim, run), run.commands)
    execution = execution_of("", sim, run)
    document: dict[str, Any] = {
        "simulator": sim,
        "driver": whose,
        "road_id": road.road_id,
        "seed": seed,
        "outcome": run.outcome.name,
        "message": run.message,
        "fitness": run.fitness if run.observations else None,
        "max_lateral_position": run.max_lateral_position if run.observations else None,
        "steps": run.steps,
        "simulated_seconds": run.simulated_seconds,
        "wall_seconds": round(wall, 3),
        "trajectory_sha256": execution.trajectory_sha256,
    }

    def show() -> None:
        table = Table(show_header=False)
        for key, value in document.items():
            table.add_row(key, str(value))
        Console().print(table)

    return Result(document=document, show=show, error=run.outcome.is_error)


def maps(folder: Path) -> Result:
    """Every map of a campaign."""
    from ds_orchestrator.maps import to_json

    store = results.open_store(folder)
    document: dict[str, Any] = to_json(results.maps_of(store))
    store.close()

    def show() -> None:
        for name, content in document.items():
            table = Table(title=name)
            for column in ("turns", "curvature", "tests", "failures", "probability", "quality"):
                table.add_column(column, justify="right")
            for cell in content["cells"]:
                table.add_row(
                    str(cell["turns_count"]),
                    f"{cell['curvature_bin'] / 100:.2f}",
                    str(cell["tests"]),
                    "" if cell["failures"] is None else str(cell["failures"]),
                    f"{cell['probability']:.2f}",
                    f"{cell['quality']:.2f}",
                )
            Console().print(table)

    return Result(document=document, show=show)


def evaluation(folder: Path) -> Result:
    """Each sibling and the merged map against the twin."""
    store = results.open_store(folder)
    document = [asdict(c) for c in results.correlations_of(results.config_of(store), results.maps_of(store))]
    store.close()
    table = _correlation_table(document)
    return Result(document=document, show=lambda: Console().print(table))


def report(folder: Path) -> Path:
    """Write maps, pictures and report again."""
    store = results.open_store(folder)
    path = results.write_all(folder, store)
    store.close()
    return path


def generate_roads(seed: int, count: int, max_angle: int) -> list[Any]:
    """Control points of random roads."""
    rng = np.random.default_rng(seed)
    return [ds_road.generate(rng, max_angle=max_angle).control_points for _ in range(count)]


def check_roads(file: Path) -> Result:
    """Validity and features of every road of a file."""
    document = [ds_road.check(raw) for raw in ds_road.read_raw_roads(file)]

    def show() -> None:
        table = Table("road", "valid", "length m", "curvature /m", "turns", "turns as published", "reason")
        for index, row in enumerate(document):
            known = row["length"] is not None
            table.add_row(
                str(index),
                "yes" if row["valid"] else "no",
                f"{row['length']:.1f}" if known else "",
                f"{row['curvature']:.4f}" if known else "",
                str(row["turns_count"]) if known else "",
                str(row["turns_count_published"]) if known else "",
                row["reason"],
            )
        Console().print(table)

    return Result(document=document, show=show)


def show_road(file: Path | None, seed: int, max_angle: int, out: Path) -> Path:
    """Draw one road as a PNG."""
    out.write_bytes(png(ds_road.draw(one_road(file, seed, max_angle))))
    return out


def fit_twin(paths: list[Path], out: Path, start: Path | None, *, window: float, evaluations: int) -> Result:
    """Fit the twin to recorded drives; writes the file of parameters and, beside it, `fit.png`."""
    from ds_twin_donkey.fit import FitSettings, fit
    from ds_twin_donkey.fit_picture import draw_fit
    from ds_twin_donkey.logs import read_log
    from ds_twin_donkey.parameter_file import document_of, read_parameters, write_parameters

    logs = [read_log(path) for path in paths]
    begin = read_parameters(start)[0] if start else None
    out.parent.mkdir(parents=True, exist_ok=True)
    drives = [drive for log in logs for drive in log.drives]
    try:
        found = fit(drives, begin, FitSettings(window_seconds=window, max_evaluations=evaluations), _say)
    except KeyboardInterrupt:
        raise Interrupted from None
    document = document_of(found, logs)
    write_parameters(out, document)
    picture = out.parent / "fit.png"
    draw_fit(found, picture)
    document |= {"file": str(out), "picture": str(picture)}

    def show() -> None:
        table = Table("parameter", "value", "95 % interval", "unit", "")
        for name, row in document["parameters"].items():
            if row["status"] != "held":
                interval = " to ".join(f"{value:.4g}" for value in row.get("interval_95", []))
                table.add_row(name, f"{row['value']:.4g}", interval, row["unit"], row["status"])
        Console().print(table)
        print(out)

    return Result(document=document, show=show)


def collect(out: Path, simulators: list[str], **settings: Any) -> None:
    """Collect a data set; the settings are those of `ds_driver.collection.CollectionPlan`."""
    from ds_driver.collection import CollectionPlan
    from ds_driver.collection import collect as collect_drives
    from ds_driver.dataset import write_manifest

    plan = CollectionPlan(**settings)
    collect_drives(plan, simulators, out, _countdown())
    write_manifest(out, {"plan": asdict(plan), "simulators": simulators, "versions": versions()})


def train(data: Path, out: Path, **settings: Any) -> None:
    """Train a network; the settings are those of `ds_driver.training.TrainingPlan`."""
    from ds_driver.training import TrainingPlan
    from ds_driver.training import train as train_network

    plan = TrainingPlan(**settings)
    train_network(data, out, plan, _crops(), _say)
    print(out / f"{plan.network}.safetensors")


def assess(network: str, *, roads: int, seed: int, simulators: list[str]) -> Result:
    """Drive unseen roads with a network, without ROS."""
    from ds_driver.assessment import success_rates, unseen_roads
    from ds_orchestrator.graph_plan import check_driver

    check_driver(network)
    document: dict[str, Any] = {
        "network": network,
        "roads": roads,
        "seed": seed,
        "success": success_rates(network, simulators, unseen_roads(roads, seed), seed, _countdown()),
    }

    def show() -> None:
        table = Table("simulator", "success")
        for name, rate in document["success"].items():
            table.add_row(name, f"{rate:.2f}")
        Console().print(table)

    return Result(document=document, show=show)


def compare_siblings(
    driver: str, simulators: list[str], *, roads: int, seed: int, max_angle: int, out: Path | None
) -> Result:
    """Drive the same roads with the same driver on every simulator, and say how differently it went."""
    from ds_driver.assessment import unseen_roads
    from ds_driver.driving import Drive, drive_all
    from ds_orchestrator.comparison import APART, compare, most_different, summary
    from ds_orchestrator.graph_plan import check_driver

    if len(simulators) < 2:
        raise ConfigError(f"simulators {', '.join(simulators)}: expected at least two, as --sims a,b")
    check_driver(driver)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    chosen = unseen_roads(roads, seed, max_angle=max_angle)
    drives = [Drive(name, driver, road, seed + i) for i, road in enumerate(chosen) for name in simulators]
    runs: dict[str, list[RunRecord]] = {name: [] for name in simulators}
    say = _countdown()
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
        write_roads(chosen, out / "roads.json")
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
            table.add_row(name, str(row["roads"]), str(row["failures"]), str(row["errors"]), _number(median))
        Console().print(table)
        verdicts = Table("pair", "both fail", "first only", "second only", "neither", "Cohen's kappa")
        distances = Table("pair", "median apart, m", "95 %, m", f"over {APART:g} m apart", "correlation")
        for pair in pairs:
            names = f"{pair.first}, {pair.second}"
            counts = (pair.both_fail, pair.only_first_fails, pair.only_second_fails, pair.both_complete)
            kappa = _number(pair.kappa) or "undefined"
            if pair.kappa_interval:
                kappa += " ({:.2f} to {:.2f})".format(*pair.kappa_interval)
            verdicts.add_row(names, *map(str, counts), kappa)
            share = "" if pair.share_apart is None else f"{pair.share_apart:.0%}"
            distances.add_row(
                names, _number(pair.median_apart), _number(pair.apart_95), share, _number(pair.correlation)
            )
        Console().print(verdicts)
        for reason in sorted({pair.reason for pair in pairs if pair.reason}):
            print(f"kappa undefined: {reason}")
        Console().print(distances)
        if out is not None:
            print(out)

    return Result(document=document, show=show, error=any(row["errors"] for row in document["simulators"].values()))


def models() -> Result:
    """The shipped networks with their cards."""
    from ds_driver.networks import count_parameters
    from ds_driver.weights import load_network, shipped_networks

    document = [
        {
            "name": name,
            "parameters": count_parameters(load_network(name)),
            "bytes": path.stat().st_size,
            "input": [160, 320, 3],
            "card": json.loads(path.with_suffix(".json").read_text()),
        }
        for name, path in shipped_networks().items()
    ]

    def show() -> None:
        table = Table("name", "parameters", "bytes", "success on unseen roads")
        for row in document:
            success = ", ".join(f"{k} {v:.2f}" for k, v in row["card"]["success"].items())
            table.add_row(row["name"], f"{row['parameters']:,}", f"{row['bytes']:,}", success)
        Console().print(table)

    return Result(document=document, show=show)


def shipped_config(name: str) -> CampaignConfig:
    """A configuration that comes with ds_bringup."""
    import os

    from ds_orchestrator.config import read_config

    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "share" / "ds_bringup" / "config" / f"{name}.yaml"
        if path.exists():
            return read_config(path)
    raise ConfigError(f"{name}.yaml of ds_bringup is not on AMENT_PREFIX_PATH: build and source the workspace")


def one_road(file: Path | None, seed: int, max_angle: int) -> ds_road.Road:
    """The road of a file that holds just one, or a random one."""
    if file is None:
        return ds_road.generate(np.random.default_rng(seed), max_angle=max_angle)
    roads = ds_road.read_roads(file)
    if len(roads) != 1:
        raise ds_road.RoadError(f"{file}: {len(roads)} roads, expected one")
    return roads[0]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _crops() -> dict[str, Any]:
    from ds_driver.preprocessing import Crop
    from ds_sim.registry import SIMULATORS, make_simulator

    specs = {name: make_simulator(name).spec for name in SIMULATORS}
    return {name: Crop(spec.crop_top, spec.crop_bottom) for name, spec in specs.items()}


def _correlation_table(rows: list[dict[str, Any]]) -> Table:
    table = Table("map", "against the twin's failures", "cells", "Pearson r", "p", "")
    for row in rows:
        table.add_row(
            row["name"],
            row["value"],
            str(row["cells"]),
            "" if row["r"] is None else f"{row['r']:.3f}",
            "" if row["p"] is None else f"{row['p']:.2g}",
            row["reason"],
        )
    return table
