# SPDX-License-Identifier: Apache-2.0
"""`ds outcomes`: imports outcomes from elsewhere, and exports outcomes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_base.folder_files import make_folder, write_whole
from ds_base.installation import ds_command
from ds_cli.output import Result, say, say_next, verb

if TYPE_CHECKING:
    from ds_analysis.outcomes.columns import Columns

outcomes_app = typer.Typer()


@verb(outcomes_app, "import")
def outcomes_import_command(
    tables: Annotated[
        list[Path],
        typer.Argument(
            metavar="TABLE...",
            help="CSV or Parquet: outcomes, then further columns of each test; or folders of SBFT test files.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the study, created if missing.")],
    columns: Annotated[Path | None, typer.Option(help="YAML file that says which column is what.")] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse a row that cannot be read, and a feature with empty cells.")
    ] = False,
) -> Result:
    """Make a study of the same tests' outcomes on any simulators, to predict, propose drives and compare.

    A table needs the columns test_id, simulator and failed, or their usual other names. If they cannot be found, the
    folder gets a columns.yaml to check and pass on with --columns. docs/outcomes.md begins with a table of ten lines.

    Example: ds outcomes import table.csv --out study
    """
    from ds_analysis.outcomes.columns import ImportNotes, read_columns
    from ds_analysis.outcomes.study import import_outcomes, write_study
    from ds_analysis.prediction.mixture import FEWEST_TESTS
    from ds_bags.layout import printable
    from ds_base.left_out import LeftOut

    notes = ImportNotes(rows=LeftOut("rows", strict))
    description = _guessed(tables, out) if columns is None else read_columns(columns)
    study = import_outcomes(tables, description, notes)
    for line in (notes.rows.line(), notes.columns.line(), *notes.features):
        if line:
            say(printable(line, 2000))
    study.table()
    make_folder(out)
    path = write_study(out, study)
    flakiness = study.flakiness()
    document = {
        "study": str(path),
        "features": list(study.features),
        "left_out": [name for name, _ in notes.columns.items],
        "rows_left_out": [{"row": name, "reason": reason} for name, reason in notes.rows.items],
        "made_features": notes.features,
        "twin": study.twin,
        "car": study.car,
        "simulators": {
            name: {"tests": tests, "drives": drives, "failed": failed, "flaky": flaky}
            for name, (tests, drives, failed, flaky) in flakiness.items()
        },
    }

    roles = {study.twin: " (twin)", study.car: " (car)"}

    def show() -> None:
        table = Table("simulator", "tests", "drives", "failed", "tests whose repeats disagree")
        for name, (tests, drives, failed, flaky) in flakiness.items():
            shown = "" if flaky is None else f"{flaky:.0%}"
            table.add_row(f"{name}{roles.get(name, '')}", str(tests), str(drives), f"{failed:.0%}", shown)
        Console().print(table)
        print(f"features: {', '.join(study.features)}")
        if len(study.simulators) - (study.twin is not None) < 2:
            print("warning: only one sibling: what it says counts half, as no other simulator confirms it")
        few = [f"{name} ({tests})" for name, (tests, *_) in flakiness.items() if tests < FEWEST_TESTS]
        if few:
            print(f"fewer than {FEWEST_TESTS} tests: {', '.join(few)}; they count where they were driven")
        print(path)

    return Result(document=document, show=show, next=ds_command("predict", out))


def _guessed(tables: list[Path], out: Path) -> Columns:
    """What the columns are, by usual names; writes a first file to check where these do not say it."""
    from ds_analysis.common.outcome_table import OutcomeTableError
    from ds_analysis.outcomes.column_names import FILE, guess_columns
    from ds_analysis.outcomes.columns import Columns

    guess = None if any(path.is_dir() for path in tables) else guess_columns(tables[0])
    if guess is None:
        return Columns()
    if guess.sure:
        say("by usual names: " + ", ".join(f"{key} is {value}" for key, value in guess.columns.items()))
        return Columns.model_validate(guess.columns)
    file = out / FILE
    command = ds_command("outcomes", "import", *tables, "--columns", file, "--out", out)
    if file.exists():
        raise OutcomeTableError(f"{tables[0]}: its columns have no usual names, and {file} exists: `{command}` uses it")
    make_folder(out)
    write_whole(file, guess.text(tables[0].name))
    asked = f", and fill in {' and '.join(guess.asked)}" if guess.asked else ""
    say(f"{tables[0]}: wrote {file} with what its columns seem to be: check it{asked}")
    say_next(command)
    raise typer.Exit(2)


@outcomes_app.command("export")
def outcomes_export_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a campaign, a comparison or a study.")],
    out: Annotated[Path, typer.Option(help="Table to write: .csv or .parquet.")],
) -> None:
    """Write outcomes as one long table, a row for each drive, as `ds outcomes import` reads it.

    Example: ds outcomes export out --out table.csv
    """
    from ds_analysis.common.outcome_table import is_study
    from ds_analysis.outcomes.reading import read_road_table
    from ds_analysis.outcomes.study import read_study, study_of, write_rows

    study = read_study(folder) if is_study(folder) else study_of(read_road_table(folder))
    write_rows(out, study)
    print(f"{out}: {len(study.rows)} drives of {', '.join(study.simulators)}")
    say_next(ds_command("predict", folder))
