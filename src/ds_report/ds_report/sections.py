# SPDX-License-Identifier: Apache-2.0
"""Sections of the report: where a car fails, why tests failed, what each sibling adds, maps over further features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ds_analysis.common.outcome_table import (
    MOST_ANALYSED,
    ROAD_FEATURES,
    OutcomeTable,
    OutcomeTableError,
    table_of_campaign,
)
from ds_analysis.common.selection import most_frequent
from ds_analysis.common.statistics import families_of
from ds_analysis.failures import FailureReason, groups_of, reasons_of, where
from ds_analysis.prediction.car import predict_car
from ds_analysis.prediction.verdicts import ERROR_RATE, Verdicts, cell_table
from ds_analysis.real.records import RecordError, read_drives
from ds_analysis.siblings.analysis import analyse, analysis_tables
from ds_base.figures import WIDTH, draw_figure, short_name
from ds_base.folder_files import StoreError
from ds_base.installation import ds_command, missing_module
from ds_base.palette import FAIL, PASS
from ds_base.table import Table
from ds_base.words import count
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, compared_ids
from ds_orchestrator.search.features import feature_of
from ds_report.camera_pictures import worst_first
from ds_report.heatmap import Picture, bounds_of, draw_map, draw_verdicts
from ds_report.pages import data_address

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_GROUPS = 12
"""Groups that are shown; chosen: a screen. The last ones hold single failures."""


@dataclass(frozen=True, kw_only=True)
class AnswerSection:
    """What is predicted of a car, or why nothing is; how to read it; whether siblings helped, what drives certify."""

    sentence: str
    reading: str = ""
    notes: Sequence[str] = ()
    picture: str = ""
    cells: Table | None = None


def answer_section(folder: Path, data: CampaignData) -> AnswerSection:
    """Predict the car from a campaign and its real drives; a twin counts as one more simulator."""
    try:
        # A real drive may be of any test.
        car = predict_car(folder, table_of_campaign(data, most=None if read_drives(folder) else MOST_ANALYSED))
    except (OutcomeTableError, RecordError, StoreError) as error:
        return AnswerSection(sentence=f"No prediction for a car: {error}.")
    certified = "" if car.certificate is None else car.certificate.sentence
    has_cells = any(cell.tests for cell in car.verdicts.cells)  # a feature of one's own may have no value
    command = ds_command("real", "propose", folder)
    undecided = "" if car.drives else f"A few drives on the car decide most cells: `{command}` draws them."
    return AnswerSection(
        sentence=car.sentence,
        reading=" ".join(filter(None, (_reading(car.verdicts, len(car.drives)), undecided, car.table.sample_note))),
        notes=[one for one in (car.help.sentence, certified) if one],
        picture=data_address(draw_verdicts(car.verdicts, "Predicted failures on a car")) if has_cells else "",
        cells=cell_table(car.verdicts),
    )


def _reading(verdicts: Verdicts, drives: int) -> str:
    framed = " Framed cells were driven by the car." if drives else ""
    tolerated, wrong = (f"{100 * rate:.0f}%" for rate in (verdicts.tolerated, ERROR_RATE))
    return (
        f"A cell fails if more than {tolerated} of tests like its own would fail on the car, and is safe if fewer "
        f"would; either is meant to be wrong at most {wrong} of the time. Where that cannot be said, it is disputed. "
        f"The table has 90% intervals.{framed}"
    )


@dataclass(frozen=True, kw_only=True)
class SiblingSection:
    """What each sibling adds, for a page, on roads with a verdict on every simulator."""

    roads: int
    sentences: Sequence[str]
    tables: Sequence[Table]
    pictures: Sequence[tuple[str, str]]


def sibling_section(data: CampaignData) -> SiblingSection | None:
    """Analyse tests that were driven on every simulator of a campaign; None if there is none, or only one simulator."""
    config = data.config
    if len(config.simulators) < 2 or not data.verdicts:
        return None
    table = table_of_campaign(data, most=MOST_ANALYSED).judged()
    if not len(table):
        return None
    try:
        analysis = analyse(table, [config.twin] if config.twin else config.siblings)
    except ModuleNotFoundError as error:  # without the extra `analysis`
        left_out = f"What the simulators say about each other is left out: {missing_module(str(error.name))}"
        return SiblingSection(roads=len(table), sentences=[left_out], tables=[], pictures=[])
    tables = analysis_tables(analysis)
    if table.sample_note:
        tables = [replace(one, notes=[*one.notes, table.sample_note]) for one in tables]
    return SiblingSection(
        roads=len(table),
        sentences=[*analysis.sentences, *([table.sample_note] if table.sample_note else [])],
        tables=tables,
        pictures=[
            (f"Largest lateral position over {analysis.feature}", data_address(draw_failures(table, analysis.feature))),
            ("Who fails where", data_address(draw_matrix(table, analysis.feature))),
        ],
    )


@dataclass(frozen=True, kw_only=True)
class FurtherMap:
    """Siblings, merged map and twin over one pair of features, each in words and as a `data:` address."""

    title: str
    folder: str
    pictures: Sequence[tuple[str, str]]


def further_map(axes: tuple[str, ...], maps: Mapping[MapId, FeatureMap]) -> FurtherMap:
    """Draw the maps of a campaign over two features."""
    across, up = (feature_of(name).title.partition(",")[0] for name in axes)
    bounds = bounds_of(maps.values())
    return FurtherMap(
        title=f"{up} by {across}",
        folder=f"maps/{'_by_'.join(axes)}",
        pictures=[
            (
                f"{one.title}: failures in {sum(cell.probability > 0 for cell in one.cells.values())} of "
                f"{len(one.cells)} cells",
                data_address(draw_map(one, "probability", bounds=bounds)),
            )
            for one in (maps[map_id] for map_id in compared_ids(maps))
        ],
    )


class FailureSection(NamedTuple):
    """Why tests failed: the largest group in words, and whether it clearly leads; all groups."""

    sentences: Sequence[str]
    groups: Sequence[tuple[int, str, FailureReason, str]]  # how many, where, the worst, address of its replay, or ""


def failure_section(data: CampaignData) -> FailureSection | None:
    """Group a campaign's failures; None if there are none whose frames are known."""
    reasons, data = reasons_of(data), data.distinct
    if not reasons:
        return None
    groups, failed = groups_of(reasons), sum(e.outcome.is_failure for e in data.executions)
    family = dict(zip((t.test_id for t in data.tests), families_of([t.road for t in data.tests]), strict=True))
    families = np.array([family[one.test_id] for one in reasons], np.intp)
    first, *others = ((f"{len(of)} of {count(len(reasons), 'failure')}", kind) for kind, of in groups.items())
    sentences = [f"Most often ({first[0]}), the driver {first[1]}."]
    if most_frequent([one.kind for one in reasons], families) is None:
        second = f"in {others[0][0].split()[0]} it {others[0][1]}"
        sentences = [f"No way of failing clearly leads: in {first[0]} the driver {first[1]}, {second}."]
    if len(reasons) < failed:
        sentences[0] += f" Read from the records of {len(reasons)} of {failed} failures."
    rank = {test_id: k for k, test_id in enumerate(worst_first(data.tests, data.executions))}
    shown = []
    for group in list(groups.values())[:MOST_GROUPS]:
        worst = min(group, key=lambda reason: rank[reason.test_id])
        cell = data.cells.get(worst.test_id)
        address = "" if cell is None else f"#cell={'-'.join(map(str, cell))}&test={worst.test_id}"
        shown.append((len(group), where(group), worst, address))
    return FailureSection(sentences, shown)


def draw_failures(table: OutcomeTable, feature: str, vector: Path | None = None) -> Picture:
    """Draw the largest lateral position of at least one test, all judged, over a feature, (rows, columns, 3) RGB."""

    def draw(figure: Figure) -> None:
        values, limits = table.feature(feature), (0.0, 1.08 * float(table.limits.max()))
        panels = figure.subplots(len(table.simulators), sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(panels, table.simulators, strict=True):
            failed, lateral = table.failed(name), table.largest_lateral(name)
            axes.plot(values[~failed], lateral[~failed], "o", color=PASS, fillstyle="none")
            axes.plot(values[failed], lateral[failed], "o", color=FAIL)
            title = f"{name}: fails on {int(failed.sum())} of {len(failed)} roads (discs)"
            axes.set(title=title, ylabel="largest lateral position, m", ylim=limits)
        panels[-1].set_xlabel(_with_unit(feature))

    return draw_figure(WIDTH, 230 * len(table.simulators), draw, vector)


def draw_matrix(table: OutcomeTable, feature: str, vector: Path | None = None) -> Picture:
    """Draw which simulator fails on which road, roads sorted by a feature, as (rows, columns, 3) uint8 RGB."""

    def draw(figure: Figure) -> None:
        order = np.argsort(table.feature(feature), kind="stable")
        axes = figure.subplots()
        for row, name in enumerate(table.simulators):
            failed = np.flatnonzero(table.failed(name)[order])
            axes.barh(row, len(order), height=0.85, color=PASS)
            axes.bar(failed, 0.85, 1.0, row - 0.425, align="edge", color=FAIL, edgecolor="white", linewidth=0.5)
        shown = np.unique(np.round(np.linspace(0, len(order) - 1, 9)).astype(int))
        axes.set_xticks(shown + 0.5, [f"{value:.2g}" for value in table.feature(feature)[order[shown]]])
        axes.set_yticks(range(len(table.simulators)), map(short_name, table.simulators))
        axes.set(xlim=(0, len(order)), ylim=(len(table.simulators) - 0.5, -0.5), xlabel=_with_unit(feature))
        axes.set_title("Who fails where: a column for each road, orange where the driver fails")
        axes.grid(visible=False)

    return draw_figure(WIDTH, 104 + 30 * len(table.simulators), draw, vector)


def _with_unit(feature: str) -> str:
    if feature not in ROAD_FEATURES:
        return f"{feature}, share of its range"
    if "curvature" in feature:
        return f"{feature}, 1/m"
    return f"{feature}, m" if feature == "length" else feature
