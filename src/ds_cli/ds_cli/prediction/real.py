"""`ds real`: a small budget of drives on a real car."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from ds_cli.options import JsonFlag
from ds_cli.output import Result, answer, say
from ds_cli.prediction.predict import TestsFolder, cell_labels
from ds_sim.installation import ds_command

if TYPE_CHECKING:
    from ds_analysis.common.outcome_table import OutcomeTable
    from ds_analysis.prediction.real.proposal import Proposed
    from ds_analysis.prediction.real.records import RealDrive
    from ds_analysis.prediction.real.update import Update
    from ds_analysis.prediction.twin_prediction import TwinPrediction

app = typer.Typer()
real_app = typer.Typer(help="Choose, record and use a few drives on a real car.", no_args_is_help=True)
app.add_typer(real_app, name="real")

Tolerated = Annotated[float, typer.Option(min=0.001, max=0.999, help="Failure rate up to which a cell counts as safe.")]


def _recorded(
    path: Path,
    proposed: Proposed,
    test: str | None,
    outcome: str | None,
    topic: str | None,
    *,
    who: str | None,
    when: str | None,
) -> RealDrive:
    """The drive that a bag or tub recorded; the arguments are those of `ds real record`."""
    from ds_analysis.prediction.real.recordings import read_recording
    from ds_analysis.prediction.real.records import RecordError, drive_of

    if test not in proposed.roads:
        known = ", ".join(sorted(proposed.roads)[:6])
        raise RecordError(f"{path}: which proposed test is it? expected --test with one of {known}")
    road, scale = proposed.roads[test], proposed.scale or 1.0
    found = read_recording(path, road, scale=scale, topic=topic)
    outcome = outcome or found.outcome(road.lane_width / 2)
    if outcome is None:
        driven = "" if found.share is None else f" after {found.share:.0%} of the road"
        raise RecordError(f"{path}: the recording tells no verdict{driven}: expected --outcome, such as completed")
    values = {
        "test_id": test, "outcome": outcome, "who": who or "", "when": when or found.when,
        "max_lateral_position": "" if found.lateral is None else str(found.lateral / scale), "note": "",
    }  # fmt: skip
    return drive_of(values, proposed.limits, scale, path.name)


def update_prediction(folder: Path, *, tolerated: float, out: Path | None) -> Result:
    """Predict the car before and after its recorded drives.

    Raises:
        ds_analysis.prediction.real.records.RecordError: there are no drives, or they are damaged.
    """
    from ds_analysis.prediction.real.proposal import read_proposed
    from ds_analysis.prediction.real.records import FOLDER, RecordError, read_drives
    from ds_analysis.prediction.real.update import update
    from ds_analysis.prediction.verdict_picture import draw_verdicts
    from ds_driver.whole_files import write_json, write_whole
    from ds_sim.camera.encodings import png

    drives = read_drives(folder)
    if not drives:
        raise RecordError(
            f"{folder} has no real drives: record some with `{ds_command('real', 'record', folder, 'FILE.csv')}`"
        )
    table, prediction = _fitted(folder)
    rounds = read_proposed(folder).rounds
    found = update(table, prediction, drives, tolerated=tolerated, rounds=rounds)
    document: dict[str, Any] = found.document()
    path = (folder / FOLDER if out is None else out) / "update.json"
    write_json(path, document)
    for name, of in (("before", found.before), ("after", found.after)):
        if any(one.tests for one in of.cells):
            picture = png(draw_verdicts(of, f"The car, {name} {len(drives)} real drives"))
            write_whole(path.with_name(f"{name}.png"), picture)
    return Result(document=document, show=lambda: _show(found, path))


def _fitted(folder: Path) -> tuple[OutcomeTable, TwinPrediction]:
    """Tests of a folder, a driven digital twin among the siblings, and the prediction of a car."""
    from ds_analysis.outcomes.folders import read_table
    from ds_analysis.prediction.twin_prediction import predict_twin

    table = read_table(folder).as_population()
    say(f"{len(table)} tests on {', '.join(table.siblings)}: fitting the population of simulators")
    return table, predict_twin(table)


def _show(found: Update, path: Path) -> None:
    from ds_analysis.common.table import Column, Table

    labels = dict(zip((one.cell for one in found.after.cells), cell_labels(found.after), strict=True))
    before, after = ({one.cell: one for one in of.cells} for of in (found.before, found.after))
    table = Table(
        name="changed_cells",
        title="Cells whose verdict the drives changed",
        columns=[
            *(Column(name) for name in found.after.features), Column("before"), Column("rate before", "number"),
            Column("after"), Column("rate after", "number"), Column("90 %", "number"),
        ],
        rows=[
            (
                *labels[one.cell], one.before, before[one.cell].rate, one.after, after[one.cell].rate,
                after[one.cell].interval,
            )
            for one in found.changed
        ],
    )  # fmt: skip
    if found.changed:
        table.show(Console())
    for name, of in (("before", found.before), ("after", found.after)):
        print(f"{name}: {of.sentence}")
    print(found.sentence)
    for line in found.worth.sentences:
        print(line)
    if found.certificate is not None:
        print(found.certificate.sentence)
    if found.span.warning:
        print(f"warning: {found.span.warning}")
    print(path)


@real_app.command("propose")
def propose_command(
    folder: TestsFolder,
    drives: Annotated[int, typer.Option(min=1, help="Number of drives.")] = 6,
    scale: Annotated[
        float | None,
        typer.Option(min=1.0, max=100.0, help="Scale of the car: 16 for 1:16; that of earlier proposals, or 16."),
    ] = None,
    certify: Annotated[
        float | None,
        typer.Option(min=0.01, max=0.99, help="Say how many drawn drives it takes to certify this failure rate."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Choose the drives on the car that would tell most, and write roads to tape out, conditions and what each decides.

    Every other test is drawn at random, so that `ds real update` can bound the car's failures however one stops.

    Writes to DIR/real: drawings and points in metres at the car's size, and outcomes.csv to fill in.
    """
    from ds_analysis.common.table import Column, Table
    from ds_analysis.prediction.real.certificate import drives_until
    from ds_analysis.prediction.real.drive_choice import LEAST_GAIN, candidates_of, expected_error
    from ds_analysis.prediction.real.proposal import SCALE, propose, read_proposed, write_proposal
    from ds_analysis.prediction.real.records import read_drives
    from ds_analysis.prediction.real.update import margin_drives
    from ds_orchestrator.store.folder_files import locked

    with locked(folder):
        outcomes, prediction = _fitted(folder)
        known = read_drives(folder)
        chosen_scale = scale or read_proposed(folder).scale or SCALE
        updated = prediction.updated(margin_drives(outcomes, known))
        found = propose(outcomes, updated, drives, scale=chosen_scale)
        paths = write_proposal(folder, found)
    expected = expected_error(outcomes, updated)
    table = Table(
        name="proposal",
        title=f"Drives on the car that tell most, after {len(known)} real drives",
        columns=[
            Column("test"), Column("P(fails)", "number"), Column("gain", "small"),
            Column("siblings that fail", "count"),
            Column("conditions"), Column("decides"),
        ],
        rows=[
            (
                one.test_id, one.probability, one.gain, list(one.siblings.values()).count("failed"),
                ", ".join(f"{name} {value}" for name, value in one.to_set.items()), one.sentence,
            )
            for one in found
        ],
        notes=[
            "gain: expected reduction of the mean squared error of all predictions by the drive, after those above, "
            "empty for tests that were drawn at random, which show whether the simulators mislead; "
            f"that error is expected to be {expected:.4f} now: stop when a drive gains less than "
            f"{100 * LEAST_GAIN:.0f} % of it"
        ],
    )  # fmt: skip

    sure = None if certify is None else drives_until(certify, len(candidates_of(outcomes, prediction)))

    def show() -> None:
        table.show(Console())
        if certify is not None:
            never = f"no number of drives certifies {certify:.0%}: there are too few tests"
            most = f"{sure} drawn drives without a failure certify that the car fails on at most {certify:.0%} of tests"
            print(never if sure is None else f"{most}; every other drive is drawn")
        for path in paths:
            print(path)

    document = {
        "drives": [one.document() for one in found],
        "expected_squared_error": expected,
        "drawn_drives_to_certify": sure,
        "files": [str(path) for path in paths],
    }
    answer(Result(document=document, show=show), as_json)


@real_app.command("record")
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
    test: Annotated[str | None, typer.Option(help="Proposed test that a bag or tub recorded.")] = None,
    outcome: Annotated[
        str | None, typer.Option(help="Verdict on a bag or tub: completed, failed, out_of_bounds, stuck or timeout.")
    ] = None,
    topic: Annotated[
        str | None, typer.Option(help="Odometry of a bag, or TOPIC:FIELD of the lateral position, m of the car's.")
    ] = None,
    tolerated: Tolerated = 0.1,
    as_json: JsonFlag = False,
) -> None:
    """Record outcomes of proposed drives, apart from simulated ones, and show what they change.

    From a CSV with a row per drive; from a rosbag2 recording of one drive, by its odometry from the start of the road
    or a topic with the lateral position; from a folder that `ds recording locate` wrote of it; or from a Donkey Car tub
    with --outcome.
    """
    from ds_analysis.prediction.real.proposal import read_proposed
    from ds_analysis.prediction.real.recordings import is_recording
    from ds_analysis.prediction.real.records import RecordError, added, read_csv, read_drives, write_drives
    from ds_orchestrator.store.folder_files import locked

    with locked(folder):
        proposed = read_proposed(folder)
        if proposed.scale is None:
            raise RecordError(
                f"nothing was proposed for {folder}: run `{ds_command('real', 'propose', folder, '--drives', 6)}` first"
            )
        if is_recording(file):
            new = [_recorded(file, proposed, test, outcome, topic, who=who, when=when)]
        else:
            new = read_csv(file, proposed.limits, scale=proposed.scale, who=who, when=when)
        path = write_drives(folder, added(read_drives(folder), new))
        say(f"{len(new)} drives recorded in {path}")
        result = update_prediction(folder, tolerated=tolerated, out=None)
    answer(result, as_json)


@real_app.command("update")
def update_command(
    folder: TestsFolder,
    tolerated: Tolerated = 0.1,
    out: Annotated[
        Path | None, typer.Option(help="Folder for update.json, before.png, after.png; DIR/real if left out.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Show predictions before and after the recorded drives, and whether the car is outside the siblings' span."""
    from ds_orchestrator.store.folder_files import locked, make_folder

    if out is not None:
        make_folder(out)
    with locked(folder) if out is None else nullcontext():
        result = update_prediction(folder, tolerated=tolerated, out=out)
    answer(result, as_json)
