# SPDX-License-Identifier: Apache-2.0
"""Writes proposed drives for a person: roads to tape out, what to set, and a table to fill in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ds_analysis.real.proposal import ProposedDrive
from ds_analysis.real.records import COLUMNS, FOLDER, OPTIONAL
from ds_base.atomic_files import write_whole
from ds_base.bounded_tables import csv_text
from ds_report.road_sheet import draw_sheet, sheet_of
from ds_sim.camera.encodings import png
from ds_sim.conditions.model import FIELDS
from ds_sim.conditions.text import format_3sf

TO_FILL = "outcomes.csv"
_HOW = (
    "Tape each road out by its drawing or its CSV (metres on the floor, origin at the lower left), set the conditions, "
    "start at the arrow in the marked lane, and let the network drive once. The drive fails if the middle of the car "
    "leaves the lane, or if it stops. Drive the tests in this order and leave none out: they were drawn at random, and "
    "outcomes certify something only up to the first one that is missing. Then fill in `outcomes.csv`."
)


def write_drives_to_do(folder: Path, number: int, drives: Sequence[ProposedDrive]) -> Path:
    """Write a round of at least one drive, numbered from 1 on, into a campaign's folder; returns the round's folder.

    Per drive a drawing and a CSV with the points to tape out, `README.md` with what to set, `outcomes.csv` to fill in.
    """
    place = folder / FOLDER / f"round_{number}"
    how = (
        f"Scale 1:{drives[0].scale:g}. {_HOW}" if drives[0].road else "Drive these tests, then fill in `outcomes.csv`."
    )
    lines = [f"# Drives on the car, round {number}", "", how, ""]
    for rank, drive in enumerate(drives, start=1):
        lines += [f"## {rank}. {drive.test_id}", ""]
        if drive.road is None:
            lines += [f"- {name}: {format_3sf(value)}" for name, value in drive.features.items()]
        else:
            sheet, stem = sheet_of(drive.road, drive.scale), f"{rank}_{drive.test_id}"
            title = f"{rank}. test {drive.test_id}, drive in the {drive.road.lane} lane"
            write_whole(place / f"{stem}.png", png(draw_sheet(sheet, title)))
            write_whole(place / f"{stem}.csv", sheet.csv())
            size = f"{sheet.width:.1f} x {sheet.height:.1f} m"
            lines += [f"![road]({stem}.png)", "", f"- road: `{stem}.csv`, {size}; drive in the {drive.road.lane} lane"]
            settings = [f"- set {name} to {value}: {FIELDS[name].doc}" for name, value in drive.to_set.items()]
            lines += settings or ["- conditions: none to set, a dry road in even light"]
        said = ", ".join(f"{name} {outcome}" for name, outcome in drive.siblings.items())
        lines += [f"- in simulation: {said}; the car is expected to fail with {drive.probability:.0%}", ""]
    write_whole(place / "README.md", "\n".join(lines))
    to_fill = [[drive.test_id, *[""] * (len(COLUMNS) + len(OPTIONAL) - 1)] for drive in drives]
    write_whole(place / TO_FILL, csv_text([[*COLUMNS, *OPTIONAL], *to_fill]))
    return place
