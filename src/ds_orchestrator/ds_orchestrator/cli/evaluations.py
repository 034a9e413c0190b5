"""`ds evaluate`, `ds offline`: how well the siblings foretell the twin, in the paper's tables."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ds_orchestrator.campaign.campaign_data import read_campaign
from ds_orchestrator.campaign.folder import open_store
from ds_orchestrator.cli.options import Folder, JsonFlag, Trust
from ds_orchestrator.cli.output import Result, answer, countdown
from ds_orchestrator.evaluation.campaign_evaluation import (
    correlations_of,
    maps_of,
    network_of,
    paired_differences_of,
    tables_of,
)
from ds_orchestrator.evaluation.open_loop import ErrorsError, architecture_of, predict
from ds_orchestrator.evaluation.paper_tables import NETWORKS, Network, error_tables
from ds_orchestrator.evaluation.steering_error_stats import check_error_robustness, compare_errors
from ds_orchestrator.evaluation.table import Table, document_of, keep_tables, write_tables
from ds_orchestrator.report.build import RQ1

app = typer.Typer()


def evaluation(
    folder: Path, *, data: Path | None, images: int | None, out: Path | None, trusted: Collection[str] = ()
) -> Result:
    """The tables of a campaign: RQ2 and RQ3, and RQ1 if there is a data set."""
    with closing(open_store(folder)) as store:
        campaign = read_campaign(store)
    config, maps = campaign.config, maps_of(campaign)
    if config.twin is None:
        raise ErrorsError(f"the campaign in {folder} has no twin, so there is nothing to compare its maps with")
    tables: list[Table] = []
    if data is not None:
        from ds_driver.networks.received import received_driver

        received_driver(config.driver, confirmed=trusted)
        tables += _offline_tables(
            data, config.driver, config.siblings, config.twin, images, network_of(config), trusted
        )
        keep_tables(tables, folder / RQ1)
    tables += tables_of(config, maps, correlations_of(config, maps), paired_differences_of(config, maps))
    return _answer(tables, out or folder / "evaluation")


def offline(
    data: Path,
    driver: str,
    *,
    siblings: list[str] | None,
    twin: str,
    images: int | None,
    out: Path | None,
    trusted: Collection[str] = (),
) -> Result:
    """RQ1 of any network on any data set."""
    architecture = architecture_of(driver)
    network: Network | None = (architecture, "sim") if architecture in NETWORKS else None
    return _answer(_offline_tables(data, driver, siblings, twin, images, network, trusted), out)


def _offline_tables(
    data: Path,
    driver: str,
    siblings: list[str] | None,
    twin: str,
    images: int | None,
    network: Network | None,
    trusted: Collection[str],
) -> list[Table]:
    found = predict(data, driver, countdown(), images=images, trusted=trusted)
    names = siblings if siblings is not None else [name for name in found if name != twin]
    missing = [name for name in (*names, twin) if name not in found]
    if missing:
        raise ErrorsError(f"{data} has no images of {', '.join(missing)}: it has those of {', '.join(found)}")
    errors = {name: found[name].absolute_errors for name in (*names, twin)}
    of_siblings = {name: errors[name] for name in names}
    compared, other_ways = compare_errors(of_siblings, errors[twin]), check_error_robustness(of_siblings, errors[twin])
    return error_tables(compared, other_ways, errors, names, twin, network)


def _answer(tables: list[Table], out: Path | None) -> Result:
    document: dict[str, Any] = dict(document_of(tables))
    if out is not None:
        write_tables(tables, out)

    def show() -> None:
        console = Console()
        for table in tables:
            table.show(console)
        if out is not None:
            print(f"{out}: every table as CSV and LaTeX")

    return Result(document=document, show=show)


Images = Annotated[int | None, typer.Option(min=1, help="At most so many images of each simulator.")]
Tables = Annotated[Path | None, typer.Option(help="Folder for the tables as CSV and LaTeX.")]


@app.command("evaluate")
def evaluate_command(
    folder: Folder,
    data: Annotated[Path | None, typer.Option(help="Data set for RQ1; see `ds offline`.")] = None,
    images: Images = None,
    out: Annotated[Path | None, typer.Option(help="Folder for CSV and LaTeX; DIR/evaluation if left out.")] = None,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """How well the siblings and their merge foretell the twin: the paper's tables, its numbers beside ours."""
    answer(evaluation(folder, data=data, images=images, out=out, trusted=trust or []), as_json)


@app.command("offline")
def offline_command(
    data: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of a data set; see `ds collect`.")],
    driver: Annotated[str, typer.Option(help="A shipped network or a weights file.")] = "dave2",
    siblings: Annotated[str | None, typer.Option(help="Separated by commas; all but the twin if left out.")] = None,
    twin: Annotated[str, typer.Option(help="Simulator that acts as the twin.")] = "donkey",
    images: Images = None,
    out: Tables = None,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """RQ1: a network's steering errors on the siblings' images against those on the twin's, without driving."""
    names = siblings.split(",") if siblings is not None else None
    answer(offline(data, driver, siblings=names, twin=twin, images=images, out=out, trusted=trust or []), as_json)
