"""Proposes drives on a real car, as files that a person can use, and remembers what was proposed."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path, PurePath
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from ds_analysis.common.outcome_table import OutcomeTable, State
from ds_analysis.prediction.real.drive_choice import Choice, choose
from ds_analysis.prediction.real.records import COLUMNS, FOLDER, MOST_ROWS, OPTIONAL, RecordError, Text
from ds_analysis.prediction.real.road_sheet import draw_sheet, sheet_of
from ds_analysis.prediction.twin_prediction import MarginDrive, TwinPrediction
from ds_analysis.prediction.verdicts import called
from ds_driver.whole_files import write_json, write_whole
from ds_orchestrator.store.folder_files import read_file
from ds_orchestrator.store.sqlite_file import StoreError
from ds_road import Road, road_from_json, road_to_json
from ds_sim.camera.encodings import png
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions
from ds_sim.conditions.text import format_conditions, parse_conditions, three_digits

PROPOSAL = "proposal.json"
TO_FILL = "outcomes.csv"
SCALE = 16.0
"""Metres of the road per metre of the car's: the twin is a car of 1:16 (paper 4.1)."""


@dataclass(frozen=True, kw_only=True)
class ProposedDrive:
    """A test to drive on the car.

    Attributes:
        test_id: id of the test.
        road: road to tape out; None if the test is known by its features alone.
        conditions: conditions to set.
        features: imported feature -> value, of a test without a road.
        limit: lateral position at which it fails, m of the road frame, or of imported outcomes their own unit.
        scale: metres of the road per metre of the car's.
        probability: predicted probability that the car fails.
        gain: expected reduction of the mean squared error of all predicted probabilities, by this drive after those
            before it; None for a test that was drawn at random.
        siblings: simulator -> outcome of this test there: `failed`, `completed` or `not driven`.
        if_fails: mean predicted failure probability of all other tests if the car fails.
        if_completes: the same if it completes.
        decided: number of other tests called `fails` or `safe` now; if the car fails; if it completes.
    """

    test_id: str
    road: Road | None
    conditions: Conditions
    features: Mapping[str, float]
    limit: float
    scale: float
    probability: float
    gain: float | None
    siblings: dict[str, str]
    if_fails: float
    if_completes: float
    decided: tuple[int, int, int]

    @property
    def sentence(self) -> str:
        """What the drive decides, in one line."""
        now, fails, completes = self.decided
        return (
            f"if the car fails (probability {self.probability:.2f}), {self.if_fails:.0%} of the other tests are "
            f"expected to fail, and {fails} are decided; if it completes, {self.if_completes:.0%}, and {completes} "
            f"(now {now})"
        )

    @property
    def to_set(self) -> dict[str, str]:
        """Condition -> its value as a person sets it, to three digits: lengths and speeds at the car's scale."""
        return {name: _as_set(name, value, self.scale) for name, value in self.conditions.changed.items()}

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        road = None if self.road is None else road_to_json(self.road)
        fields = {key: value for key, value in asdict(self).items() if key not in ("road", "conditions")}
        return {**fields, "road": road, "conditions": format_conditions(self.conditions), "decides": self.sentence}


def _as_set(name: str, value: float, scale: float) -> str:
    unit = FIELDS[name].unit
    own = f"{three_digits(value)} {unit}".rstrip()
    if unit == "rad":
        return f"{three_digits(math.degrees(value))} degrees"
    if unit in ("m", "m/s") and scale != 1.0:
        return f"{three_digits(value / scale)} {unit} ({own} at full scale)"
    return own


def propose(
    table: OutcomeTable, prediction: TwinPrediction, drives: int, *, scale: float = SCALE
) -> list[ProposedDrive]:
    """Choose drives, and compute what each would decide.

    Raises:
        ds_analysis.prediction.real.drive_choice.BudgetError: there are not so many tests to choose from.
    """
    now = prediction.probabilities()
    return [_proposed(table, prediction, choice, now, scale) for choice in choose(table, prediction, drives)]


def _proposed(table: OutcomeTable, prediction: TwinPrediction, choice: Choice, now: Any, scale: float) -> ProposedDrive:
    others = np.arange(len(table)) != choice.row
    fails, completes = (
        prediction.updated([MarginDrive(row=choice.row, failed=failed)]).probabilities()[others]
        for failed in (True, False)
    )

    def decided(probabilities: Any) -> int:
        return int(np.logical_or(*called(probabilities)).sum())

    words = {State.FAILED: "failed", State.COMPLETED: "completed"}
    features = dict(zip(table.feature_names, table.features[choice.row].tolist(), strict=True))
    return ProposedDrive(
        test_id=table.test_ids[choice.row],
        road=table.roads[choice.row] if table.roads else None,
        conditions=table.conditions[choice.row] if table.conditions else DEFAULT,
        features={} if table.roads else features,
        limit=float(table.limits[choice.row, 0]),
        scale=scale if table.roads else 1.0,
        probability=float(now[choice.row]),
        gain=choice.gain,
        siblings={
            name: words.get(State(table.states[choice.row, table.column(name)]), "not driven")
            for name in table.siblings
        },
        if_fails=float(fails.mean()),
        if_completes=float(completes.mean()),
        decided=(decided(now[others]), decided(fails), decided(completes)),
    )


@dataclass(frozen=True, kw_only=True)
class Proposed:
    """What was proposed for a folder so far.

    Attributes:
        roads: test -> road; tests that are known by their features alone have none.
        limits: test -> lateral position at which it fails, m of the road frame.
        scale: metres of the road per metre of the car's; None before the first proposal.
        rounds: proposals, as JSON values.
    """

    roads: dict[str, Road]
    limits: dict[str, float]
    scale: float | None
    rounds: list[list[dict[str, Any]]]


def read_proposed(folder: Path) -> Proposed:
    """Read what was proposed for a campaign's folder.

    Raises:
        RecordError: the file is damaged.
    """
    path = folder / FOLDER / PROPOSAL
    damaged = RecordError(f"{path} cannot be read: restore it, or remove it and propose again")
    try:
        content = read_file(folder, PurePath(FOLDER, PROPOSAL))
        document = _Document.model_validate_json(content, strict=True)
        rounds = json.loads(content)["rounds"]
        rows = list(chain.from_iterable(document.rounds))
        if len(rows) > MOST_ROWS:
            raise damaged
        roads = {row.test_id: road_from_json(row.road) for row in rows if row.road is not None}
        limits = {row.test_id: row.limit for row in rows}
        for row in rows:
            parse_conditions(row.conditions)
            if row.road is not None and roads[row.test_id] != road_from_json(row.road):
                raise damaged
            limits[row.test_id] = roads[row.test_id].lane_width / 2 if row.test_id in roads else limits[row.test_id]
    except FileNotFoundError:
        return Proposed(roads={}, limits={}, scale=None, rounds=[])
    except (StoreError, RecordError):
        raise
    except ValueError:  # as pydantic, JSON, roads and conditions raise
        raise damaged from None
    return Proposed(roads=roads, limits=limits, scale=document.scale, rounds=rounds)


class _Row(BaseModel):
    """A proposed drive, as far as it is read again."""

    test_id: Text
    road: Any
    conditions: Annotated[str, Field(max_length=1000)]
    limit: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0
    gain: float | None = 0.0


class _Document(BaseModel):
    """File of proposals."""

    scale: Annotated[float, Field(ge=1.0, le=100.0)]
    rounds: Annotated[list[list[_Row]], Field(max_length=MOST_ROWS)]


def write_proposal(folder: Path, drives: Sequence[ProposedDrive]) -> list[Path]:
    """Write a proposal into a campaign's folder.

    Writes, in `real/`, `round_<n>/`: per drive a drawing and a CSV with the points to tape out, `README.md` with what
    to set and what each drive decides, `outcomes.csv` to fill in; and `proposal.json` with all rounds.

    Raises:
        RecordError: drives of another scale were proposed before.
    """
    before = read_proposed(folder)
    scale = drives[0].scale
    if before.scale is not None and before.scale != scale:
        raise RecordError(
            f"drives of a car of 1:{before.scale:g} were proposed before, not 1:{scale:g}: keep the scale, or copy the "
            "folder for another car"
        )
    number = len(before.rounds) + 1
    place = folder / FOLDER / f"round_{number}"
    how = f"Scale 1:{scale:g}. {_HOW}" if drives[0].road else "Drive each test on the car, then fill in `outcomes.csv`."
    lines = [f"# Drives on the car, round {number}", "", how, ""]
    for rank, drive in enumerate(drives, start=1):
        stem = f"{rank}_{drive.test_id}"
        if drive.road is None:
            lines += _section(rank, drive, None)
            continue
        sheet = sheet_of(drive.road, scale)
        title = f"{rank}. test {drive.test_id}, drive in the {drive.road.lane} lane"
        write_whole(place / f"{stem}.png", png(draw_sheet(sheet, title)))
        write_whole(place / f"{stem}.csv", sheet.csv())
        lines += _section(rank, drive, f"{stem}.csv`, {sheet.width:.1f} x {sheet.height:.1f} m")
    write_whole(place / "README.md", "\n".join(lines))
    write_whole(place / TO_FILL, _to_fill(drives))
    rounds = [*before.rounds, [drive.document() for drive in drives]]
    write_json(folder / FOLDER / PROPOSAL, {"scale": scale, "rounds": rounds})
    return [place, folder / FOLDER / PROPOSAL]


_HOW = (
    "Tape each road out by its drawing or its CSV (metres on the floor, origin at the lower left), set the conditions, "
    "start at the arrow in the marked lane, and let the network drive once. The drive fails if the middle of the car "
    "leaves the lane, or if it stops. Note the largest distance of the car's middle from the middle of its lane if you "
    "can measure it: it tells more than the verdict. Then fill in `outcomes.csv`."
)


def _section(rank: int, drive: ProposedDrive, sheet: str | None) -> list[str]:
    said = ", ".join(f"{name} {outcome}" for name, outcome in drive.siblings.items())
    if sheet is None or drive.road is None:
        how = [f"- {name}: {three_digits(value)}" for name, value in drive.features.items()]
    else:
        how = [f"- set {name} to {value}: {FIELDS[name].doc}" for name, value in drive.to_set.items()]
        how = how or ["- conditions: none to set, a dry road in even light"]
        drawing = f"![road]({sheet.partition('.csv')[0]}.png)"
        how = [drawing, "", f"- road: `{sheet}; drive in the {drive.road.lane} lane", *how]
    return [
        f"## {rank}. {drive.test_id}", "", *how,
        f"- in simulation: {said}", f"- decides: {drive.sentence}", "",
    ]  # fmt: skip


def _to_fill(drives: Sequence[ProposedDrive]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*COLUMNS, *OPTIONAL])
    for drive in drives:
        writer.writerow([drive.test_id, *[""] * (len(COLUMNS) + len(OPTIONAL) - 1)])
    return out.getvalue()
