"""`ds campaign export`: a campaign's results as Parquet tables."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from ds_cli.options import Folder

campaign_app = typer.Typer()


def export_campaign(folder: Path, out: Path, *, frames: bool) -> list[Path]:
    """Write the tables of a campaign.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds no campaign, or a damaged one.
    """
    from ds_analysis.interchange.parquet import write_tables
    from ds_orchestrator.campaign.folder import open_store, read_campaign

    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    return write_tables(data, out, frames=frames)


@campaign_app.command("export")
def campaign_export_command(
    folder: Folder,
    out: Annotated[Path, typer.Option(help="Folder to write to, created if missing.")],
    frames: Annotated[bool, typer.Option("--frames", help="Also write every frame of every drive.")] = False,
) -> None:
    """Write a campaign's results as Parquet tables, for pandas, Polars, DuckDB or Spark.

    executions.parquet has a row for each test on each simulator; with --frames, frames.parquet one for each frame.
    Every column carries its unit and description. The campaign may still be running.
    """
    for path in export_campaign(folder, out, frames=frames):
        print(path)
