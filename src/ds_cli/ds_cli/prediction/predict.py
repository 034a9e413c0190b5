"""`ds predict`: where the car fails, is safe, or is disputed, and how well such predictions do on a driven twin."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from ds_cli.options import JsonFlag
from ds_cli.output import Result, answer, say

if TYPE_CHECKING:
    from ds_analysis.common.table import Table
    from ds_analysis.prediction.verdicts import Verdicts

app = typer.Typer()

TestsFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder of a campaign, `ds siblings compare` or `ds outcomes import`.")
]
TwinName = Annotated[
    str | None,
    typer.Option(help="Simulator that plays the twin, all others the siblings; the campaign's own if left out."),
]


def cell_labels(verdicts: Verdicts) -> list[tuple[str, ...]]:
    """Format the bins of every cell, one text per axis."""
    from ds_orchestrator.search.features import feature_of

    axes = [feature_of(name) for name in verdicts.features]
    return [tuple(axis.label(bin_) for axis, bin_ in zip(axes, one.cell, strict=True)) for one in verdicts.cells]


@app.command("predict")
def predict_command(
    folder: TestsFolder,
    twin: TwinName = None,
    tolerated: Annotated[
        float, typer.Option(min=0.001, max=0.999, help="Failure rate up to which a cell counts as safe.")
    ] = 0.1,
    out: Annotated[Path | None, typer.Option(help="Folder for prediction.json, verdicts.png and tables.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Predict where a car, or a simulator that was never driven, fails.

    Each cell fails, is safe, disputed or untested. A car is predicted from every simulator, the twin among them, and
    from its own recorded drives; `--twin` predicts a simulator as if it had never been driven. Where there is a twin,
    predictors that do not know it are scored on its outcomes, beside the undriven baseline. docs/merge.md says how.
    """
    from ds_analysis.common.outcome_table import MOST_ANALYSED, OutcomeTableError
    from ds_analysis.common.table import write_tables
    from ds_analysis.outcomes.folders import read_table
    from ds_analysis.prediction.calibration import forecast_cells
    from ds_analysis.prediction.car import predict_car
    from ds_analysis.prediction.predictor_scores import compare_predictors, comparison_tables
    from ds_analysis.prediction.twin_prediction import predict_twin, span_of
    from ds_analysis.prediction.verdict_picture import draw_verdicts
    from ds_analysis.prediction.verdicts import cell_table, judge
    from ds_orchestrator.store.folder_files import make_folder
    from ds_sim.camera.encodings import png

    if out is not None:
        make_folder(out)
    table = read_table(folder, twin=twin, most=MOST_ANALYSED)
    car = None
    if twin is None:
        say(f"{len(table)} tests on {', '.join(table.as_population().siblings)}: predicting a car")
        car = predict_car(folder, table, tolerated=tolerated)
        verdicts, prediction = car.verdicts, car.prediction
        sentence, title = car.sentence, "Predicted failures on a car"
    else:
        say(f"{len(table)} tests on {', '.join(table.siblings)}: predicting {twin} as if it had never been driven")
        prediction = predict_twin(table)
        verdicts = judge(table, prediction, tolerated=tolerated)
        sentence, title = f"On {twin}: {verdicts.sentence}", f"Predicted failures on {twin}, never driven"
    tables: list[Table] = [cell_table(verdicts, cell_labels(verdicts))]
    document: dict[str, Any] = {
        "siblings": list(table.siblings),
        "twin": table.twin,
        "sentence": sentence,
        "real_drives": car.drives if car else 0,
        "population": prediction.population.document(),
        "verdicts": verdicts.document(),
        "kinds": prediction.document_of_kinds(),
        "comparison": None,
        "forecasts": [],
        **({"tests_left_out": table.left_out} if table.left_out else {}),
    }
    try:
        # Scored on the twin as if it had never been driven.
        alone = prediction if twin is not None else predict_twin(table) if table.twin is not None else prediction
        comparison = compare_predictors(table, alone)
    except OutcomeTableError as error:
        if twin is not None:
            raise
        document["no_comparison"] = str(error)
    else:
        tables += comparison_tables(comparison)
        document["comparison"] = comparison.document()
        document["forecasts"] = [one.document() for one in forecast_cells(table, alone)]
    if out is not None:
        write_tables(tables, out)
        (out / "prediction.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
        if any(one.tests for one in verdicts.cells):
            (out / "verdicts.png").write_bytes(png(draw_verdicts(verdicts, title)))

    def show() -> None:
        console = Console()
        print(sentence)
        for one in tables:
            one.show(console)
        if "no_comparison" in document:
            print(f"predictors are not compared: {document['no_comparison']}")
        if table.sample_note:
            print(table.sample_note)
        print(prediction.kinds_sentence)
        if warning := span_of(prediction).warning:
            print(f"warning: {warning}")
        if out is not None:
            print(out / "prediction.json")

    answer(Result(document=document, show=show), as_json)
