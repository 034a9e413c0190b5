# SPDX-License-Identifier: Apache-2.0
"""`ds real`: a small budget of drives on a real car."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ds_base.folder_files import locked, make_folder, write_json, write_whole
from ds_base.installation import ds_command
from ds_cli.output import Result, say, verb
from ds_cli.prediction.predict import TestsFolder, Tolerated

if TYPE_CHECKING:
    from ds_analysis.prediction.car import CarPrediction

real_app = typer.Typer()


def _updated(folder: Path, *, tolerated: float, out: Path | None) -> Result:
    """Predict the car before and after its drives, and write both."""
    from ds_analysis.outcomes.reading import read_table
    from ds_analysis.prediction.car import predict_car
    from ds_analysis.real.records import FOLDER, RecordError
    from ds_report.heatmap import draw_verdicts
    from ds_sim.camera.encodings import png

    car = predict_car(folder, read_table(folder), tolerated=tolerated)
    if not car.drives:
        raise RecordError(
            f"{folder} has no real drives: record some with `{ds_command('real', 'record', folder, 'FILE.csv')}`"
        )
    path = (folder / FOLDER if out is None else out) / "update.json"
    document = car.document()
    write_json(path, document)
    for name, of in (("before", car.before), ("after", car.verdicts)):
        if any(one.tests for one in of.cells):
            picture = png(draw_verdicts(of, f"The car, {name} {len(car.drives)} real drives"))
            write_whole(path.with_name(f"{name}.png"), picture)
    following = ds_command("real", "propose", folder, "--drives", 6)
    return Result(document=document, show=lambda: _show(car, path), next=following)


def _show(car: CarPrediction, path: Path) -> None:
    print(car.sentence)
    print(car.help.sentence)
    if car.certificate is not None:
        print(car.certificate.sentence)
    if car.open:
        print(_open(car.open))
    changed = [
        f"{', '.join(car.verdicts.labels(one['cell']))}: {one['before']} -> {one['after']}" for one in car.changed
    ]
    if changed:
        shown = "; ".join(changed[:6])
        print(f"The drives changed the verdict of {len(changed)} cells: {shown}{'; ...' if len(changed) > 6 else ''}")
    print(path)


def _open(tests: Sequence[str]) -> str:
    shown = ", ".join(tests[:6]) + (f" and {len(tests) - 6} more" if len(tests) > 6 else "")
    return f"{len(tests)} proposed drive{' is' if len(tests) == 1 else 's are'} not recorded yet: {shown}."


@verb(real_app, "propose")
def propose_command(
    folder: TestsFolder,
    drives: Annotated[int, typer.Option(min=1, help="Number of drives.")] = 6,
    scale: Annotated[
        float | None,
        typer.Option(min=1.0, max=100.0, help="Scale of the car: 16 for 1:16; that of earlier proposals, or 16."),
    ] = None,
    certify: Annotated[
        float | None,
        typer.Option(min=0.01, max=0.99, help="Say how many drives it takes to certify this failure rate."),
    ] = None,
    spread: Annotated[
        bool, typer.Option("--spread", help="Spread tests over predicted probabilities: tells more, certifies nothing.")
    ] = False,
) -> Result:
    """Draw tests to drive on the car at random, and write roads to tape out and what to set.

    `ds real update` can bound the car's failures whenever you stop, because each call continues the same random order.
    Writes to DIR/real: drawings and points in metres at the car's size, and outcomes.csv to fill in.

    Example: ds real propose out --drives 6
    """
    from ds_analysis.outcomes.reading import read_table
    from ds_analysis.prediction.car import predict_car
    from ds_analysis.prediction.certificate import drives_until
    from ds_analysis.real.proposal import candidates_of, propose
    from ds_base.table import Column, Table
    from ds_report.drives_on_the_car import TO_FILL, write_drives_to_do

    with locked(folder):
        car = predict_car(folder, read_table(folder))
        driven = [drive.test_id for drive in car.drives]
        proposals = propose(folder, car.table, car.prediction, driven, drives, scale=scale, spread=spread)
        place = write_drives_to_do(folder, len(car.proposed.rounds) + 1, proposals)
    table = Table(
        name="proposal",
        title=f"Drives on the car, drawn at random, after {len(car.drives)} real drives",
        columns=[
            Column("test"),
            Column("P(fails)", "number"),
            Column("siblings that fail", "count"),
            Column("conditions"),
        ],
        rows=[
            (
                one.test_id,
                one.probability,
                list(one.siblings.values()).count("failed"),
                ", ".join(f"{name} {value}" for name, value in one.to_set.items()),
            )
            for one in proposals
        ],
    )
    tests = len(car.proposed.population) or len(candidates_of(car.table))
    sure = None if certify is None else drives_until(certify, tests)
    following = ds_command("real", "record", folder, place / TO_FILL, "--who", "me", "--when", date.today())

    def show() -> None:
        if car.open:
            print(f"{_open(car.open)} The drives below follow them in the same order.")
        table.show(Console())
        if certify is not None:
            never = f"no number of drives certifies {certify:.0%}: there are too few tests"
            most = f"{sure} drives without a failure certify that the car fails on at most {certify:.0%} of tests"
            print(never if sure is None else most)
        print(place)
        print(f"Drive them in this order, and fill in {TO_FILL}.")

    document = {
        "drives": [one.document() for one in proposals],
        "open": list(car.open),
        "drawn_drives_to_certify": sure,
        "folder": str(place),
    }
    return Result(document=document, show=show, next=following)


@verb(real_app, "record")
def record_command(
    folder: TestsFolder,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.csv|BAG|TUB", help="CSV: test_id, outcome, who, when, max_lateral_position (m), note."
        ),
    ],
    who: Annotated[str | None, typer.Option(help="Who drove, where the file does not say.")] = None,
    when: Annotated[str | None, typer.Option(help="Date, where the file does not say, as 2026-03-01.")] = None,
    test: Annotated[str | None, typer.Option(help="Test that a bag or tub recorded.")] = None,
    outcome: Annotated[
        str | None, typer.Option(help="Verdict on a bag or tub: completed, failed, out_of_bounds, stuck or timeout.")
    ] = None,
    topic: Annotated[
        str | None, typer.Option(help="Odometry of a bag, or TOPIC:FIELD of the lateral position, m of the car's.")
    ] = None,
    scale: Annotated[
        float | None, typer.Option(min=1.0, max=100.0, help="Scale of the car, if nothing was proposed; 16 for 1:16.")
    ] = None,
    drawn: Annotated[
        bool, typer.Option("--drawn", help="Tests that were not proposed were drawn at random from all, not chosen.")
    ] = False,
    tolerated: Tolerated = 0.1,
) -> Result:
    """Record outcomes of drives on the car, proposed or not, apart from simulated ones, and show what they change.

    A drive comes from a CSV with a row for each drive; from a rosbag2 recording, by its odometry from the start of the
    road or a topic with the lateral position; from a folder that `ds recording locate` wrote; or from a Donkey Car tub
    with --outcome. A test counts once. Only drives that were proposed, or that you say were --drawn, certify something.

    Example: ds real record out outcomes.csv
    """
    from dataclasses import replace

    from ds_analysis.common.outcome_table import RoadTable
    from ds_analysis.outcomes.reading import read_table
    from ds_analysis.real import records
    from ds_analysis.real.proposal import SCALE, read_proposed
    from ds_recording.real_drive import is_recording, read_recording

    with locked(folder):
        table, proposed = read_table(folder).as_population(), read_proposed(folder)
        used_scale = proposed.scale or (scale or SCALE if isinstance(table, RoadTable) else 1.0)
        if is_recording(file):
            which = f"{file}: which test is it? expected --test with one of "
            if not isinstance(table, RoadTable):
                raise records.RecordError(f"{which}a CSV, as these tests have no roads")
            if test is None or test not in table.test_ids:
                raise records.RecordError(f"{which}{', '.join(sorted(table.test_ids)[:6])}")
            road = table.roads[table.test_ids.index(test)]
            seen = read_recording(file, road, scale=used_scale, topic=topic)
            verdict = outcome or seen.outcome(road.lane_width / 2)
            if verdict is None:
                driven = "" if seen.share is None else f" after {seen.share:.0%} of the road"
                raise records.RecordError(
                    f"{file}: the recording tells no verdict{driven}: expected --outcome, such as completed"
                )
            values = {
                "test_id": test,
                "outcome": verdict,
                "who": who or "",
                "when": when or seen.when,
                "max_lateral_position": "" if seen.lateral is None else str(seen.lateral / used_scale),
                "note": "",
            }
            new = [records.drive_of(values, {test: road.lane_width / 2}, used_scale, file.name)]
        else:
            limits = dict(zip(table.test_ids, map(float, table.limits[:, 0]), strict=True))
            new = records.read_csv(file, limits, scale=used_scale, who=who, when=when)
        recorded = records.read_drives(folder)
        records.added(recorded, new)
        kept = records.added(records.read_recorded(folder), [replace(drive, drawn=drawn) for drive in new])
        path = records.write_drives(folder, kept)
        again = len({drive.test_id for drive in recorded} & {drive.test_id for drive in new})
        chosen = len({drive.test_id for drive in new} - {*proposed.tests})
        say(f"{len(new) - again} drives recorded in {path}, {again} known before, {chosen} of tests not proposed")
        return _updated(folder, tolerated=tolerated, out=None)


@verb(real_app, "update")
def update_command(
    folder: TestsFolder,
    tolerated: Tolerated = 0.1,
    out: Annotated[
        Path | None, typer.Option(help="Folder for update.json, before.png, after.png; DIR/real if left out.")
    ] = None,
) -> Result:
    """Show predictions before and after the recorded drives, what they certify, and whether simulators have helped.

    Example: ds real update out
    """
    if out is not None:
        make_folder(out)
    with locked(folder) if out is None else nullcontext():
        return _updated(folder, tolerated=tolerated, out=out)
