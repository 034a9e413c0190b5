# SPDX-License-Identifier: Apache-2.0
"""A comparison as tables, as JSON values, and as Markdown for a pull request or the summary of a CI job."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from ds_analysis.common.selection import ALPHA
from ds_analysis.comparison.analysis import Comparison, advice_of, answer_of, cautions_of, sentences_of
from ds_analysis.comparison.paired_drives import PairedCounts, PairedDrive
from ds_base.table import Column, Table, Value, p_in_words, styled
from ds_driver.networks.driver_name import DriverName
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import label_of

MOST_ROWS = 12
"""Rows of a list on a terminal or in a summary; chosen: a screen, and the files have all."""


def simulator_table(comparison: Comparison) -> Table:
    """Tabulate paired outcomes, one row for each simulator."""
    # Where all tests are alike, a column on random roads would repeat the others.
    with_random = comparison.origin == "reference" and any(row.unsearched.tests for row in comparison.simulators)
    rows: list[tuple[Value, ...]] = []
    for row in comparison.simulators:
        name = row.simulator + (" (twin)" if row.simulator == comparison.twin else "")
        *counts, _ = _counts(row.counts).values()
        random = f"+{row.unsearched.newly_fail} -{row.unsearched.fixed} /{row.unsearched.tests}"
        rows.append((name, *counts, row.p_adjusted, *[random] * with_random, row.margin_change, row.verdict))
    return Table(
        name="compared_networks",
        title=f"{comparison.candidate.label} against {comparison.reference.label}",
        columns=[
            Column("simulator"),
            *styled("count", "tests", "reference", "candidate", "newly fail", "fixed"),
            *styled("number", "difference", "95 %"),
            Column("p (Holm)", "p"),
            *[Column("random roads")] * with_random,
            Column("margin, m", "number"),
            Column("on other roads"),
        ],
        rows=rows,
        notes=[
            "Reference, candidate: tests on which they fail. Difference: the candidate's failure probability minus the "
            "reference's, with its 95% interval; above 0 is worse. Margin: median change of the smallest distance to "
            "the lane's edge. On other roads: whether such a difference is significant (p below 0.05)."
            + (" Random roads: newly fail, fixed, and all, of tests that no search chose." if with_random else "")
        ],
    )


def cell_table(comparison: Comparison, *, most: int | None = None) -> Table:
    """Tabulate cells in which some test changed, the worst first, at most so many."""
    changed = [one for one in comparison.cells if one.counts.newly_fail or one.counts.fixed]
    changed.sort(key=lambda one: (-(one.counts.difference or 0.0), one.p_adjusted, one.simulator, one.cell))
    rows: list[tuple[Value, ...]] = []
    for one in changed[:most]:
        counts = one.counts
        bins = (axis.label(bin_) for axis, bin_ in zip(comparison.features, one.cell, strict=True))
        numbers = (counts.tests, counts.newly_fail, counts.fixed, counts.difference, counts.interval, one.p_adjusted)
        rows.append((one.simulator, *bins, *numbers))
    left = f" The worst {most} of {len(changed)} are shown." if most is not None and len(changed) > most else ""
    smallest = f"the smallest: {p_in_words(min(one.p_adjusted for one in changed))}" if changed else "none changed"
    return Table(
        name="compared_cells",
        title="Cells of the feature map that changed",
        columns=[
            Column("simulator"),
            *(Column(axis.title) for axis in comparison.features),
            *styled("count", "tests", "newly fail", "fixed"),
            *styled("number", "difference", "95 %"),
            Column("p (BH)", "p"),
        ],
        rows=rows,
        notes=[f"p by Benjamini and Hochberg over {len(comparison.cells)} cells of all simulators; {smallest}.{left}"],
    )


def drive_table(comparison: Comparison, *, most: int | None = None) -> Table:
    """Tabulate `most` tests that newly fail, or that lost most distance to the lane's edge; every pair if None."""
    worse = comparison.newly_failing
    shown = worse or [drive for drive in comparison.drives if drive.margin_change < 0.0]
    if most is None:
        shown = list(comparison.drives)
    every = most is None
    title = "Tests that newly fail" if worse else "No test newly fails; nearest to it, by the lost distance"
    left = [f"{most} of {len(shown)} are shown."] if most is not None and len(shown) > most else []
    return Table(
        name="compared_tests",
        title="Every test, the worst change first" if every else title,
        columns=[
            *styled("text", "test", "simulator"),
            *[Column("change")] * every,
            *styled("text", "reference", "candidate"),
            *styled("number", "margin of reference, m", "of candidate, m"),
        ],
        rows=[
            (
                drive.test.name,
                drive.simulator,
                *[drive.change] * every,
                drive.reference.outcome.words,
                drive.candidate.outcome.words,
                drive.reference.fitness,
                drive.candidate.fitness,
            )
            for drive in shown[:most]
        ],
        notes=["Margin: smallest distance to the lane's edge, negative outside.", *left],
    )


def command_of(drive: PairedDrive, driver: DriverName, road_file: str) -> str:
    """The command that drives a test again, and shows it as a video."""
    video = f"{drive.test.name}-{label_of(drive.simulator)}.mp4"
    parts = ["ds", "drive", "--sim", drive.simulator, "--driver", str(driver), "--road", road_file, "--video", video]
    return shlex.join(parts)


def document_of(comparison: Comparison, road_files: Mapping[str, str]) -> dict[str, Any]:
    """Convert a comparison to JSON values; see `markdown_of`."""
    return {
        "advice": advice_of(comparison),
        "answer": answer_of(comparison),
        "sentences": sentences_of(comparison),
        "cautions": cautions_of(comparison),
        "reference": comparison.reference.document(),
        "candidate": comparison.candidate.document(),
        "origin": comparison.origin,
        "source": comparison.source,
        "features": [feature.axis for feature in comparison.features],
        "simulators": [
            {
                "simulator": row.simulator,
                "verdict": row.verdict,
                **_counts(row.counts),
                "p_holm": row.p_adjusted,
                "random_roads": {**_counts(row.unsearched), "p_holm": row.unsearched_p_adjusted},
                "median_margin_change": row.margin_change,
            }
            for row in comparison.simulators
        ],
        "cells": [
            {"simulator": one.simulator, "cell": list(one.cell), **_counts(one.counts), "p_bh": one.p_adjusted}
            for one in comparison.cells
        ],
        "tests": [_test(drive, comparison, road_files) for drive in comparison.drives],
        "excluded": comparison.excluded,
        "left_out": [dict(zip(("test", "simulator", "reason"), one, strict=True)) for one in comparison.left_out],
    }


def _test(drive: PairedDrive, comparison: Comparison, road_files: Mapping[str, str]) -> dict[str, Any]:
    scenario = drive.test.scenario
    document: dict[str, Any] = {
        "test": drive.test.name,
        "simulator": drive.simulator,
        "change": drive.change,
        "road_id": scenario.road.road_id if scenario else "",
        "seed": scenario.seed if scenario else 0,
        "conditions": format_conditions(scenario.conditions) if scenario else "",
        "cell": None if drive.test.cell is None else list(drive.test.cell),
        "unsearched": drive.test.unsearched,
        "reference": {"outcome": drive.reference.outcome.name, "fitness": drive.reference.fitness},
        "candidate": {"outcome": drive.candidate.outcome.name, "fitness": drive.candidate.fitness},
    }
    if drive.change == "newly fails" and drive.test.name in road_files:
        document["command"] = command_of(drive, comparison.candidate.driver, road_files[drive.test.name])
    return document


def _counts(counts: PairedCounts) -> dict[str, Any]:
    names = "tests", "reference_failures", "candidate_failures", "newly_fail", "fixed", "difference", "interval", "p"
    return {name: getattr(counts, name) for name in names}


_READING = (
    "The reference is the network to be replaced, the candidate the one that would replace it; beside each name the "
    "first digits of its files' SHA-256.",
    "A test is a road, its conditions and a seed, driven by both on the same simulator; leaving the lane or getting "
    "stuck is a failure. Simulators are deterministic: the same network repeats its drives to the bit, so that a test "
    "that newly fails is no accident of one drive.",
    "The twin is the most faithful simulator, the others are cheap ones that are wrong in different ways.",
    "p says whether that holds for other such roads: McNemar's exact test on the tests that changed, or, of mutants, "
    "random signs of whole families; Holm's adjustment takes the number of simulators into account. "
    "Significant: below 0.05. 95% intervals: Jeffreys.",
)


def markdown_of(comparison: Comparison, road_files: Mapping[str, str], unmet: Sequence[str] = ()) -> str:
    """Format a comparison as GitHub's and GitLab's Markdown.

    `road_files` has the file with the road of tests that newly fail; `unmet` the pass criteria that are not met.
    """
    lines = [f"## {_text(comparison.candidate.label)} against {_text(comparison.reference.label)}", ""]
    lines += [f"**{answer_of(comparison)}**", ""]
    lines += [f"- {_text(sentence)}" for sentence in sentences_of(comparison)]
    lines += [f"- Pass criterion not met: {_text(sentence)}" for sentence in unmet]
    lines += ["", f"{_text(comparison.source)}.", ""]
    lines += [*_table(simulator_table(comparison)), ""]
    if comparison.newly_failing:
        lines += ["### Tests that newly fail", "", *_table(drive_table(comparison, most=MOST_ROWS)), ""]
        driver = comparison.candidate.driver
        shown = [one for one in comparison.newly_failing if one.test.name in road_files][:MOST_ROWS]
        commands = [command_of(one, driver, road_files[one.test.name]) for one in shown]
        if commands:
            lines += ["<details><summary>See them: commands that write a video of each</summary>", ""]
            lines += ["The road files are among the results of this run.", "", "```bash"]
            lines += [*commands, "```", "", "</details>", ""]
    lines += _where(comparison)
    if cautions := cautions_of(comparison):
        lines += ["<details><summary>What these numbers cannot carry</summary>", ""]
        lines += [*(f"- {_text(caution)}" for caution in cautions), "", "</details>", ""]
    lines += ["<details><summary>How to read this</summary>", "", *(f"- {line}" for line in _READING), "", "</details>"]
    return "\n".join([*lines, ""])


def _where(comparison: Comparison) -> list[str]:
    """Cells that changed, if any changed significantly; other rows would be noise that looks like evidence."""
    if not comparison.cells:
        return []
    smallest = min(one.p_adjusted for one in comparison.cells)
    if smallest >= ALPHA:
        return [
            f"No kind of road stands out: over {len(comparison.cells)} cells of the feature maps the smallest: "
            f"{p_in_words(smallest)} after Benjamini and Hochberg; most cells have too few tests.",
            "",
        ]
    head = "<details><summary>Where: cells of the feature map that changed</summary>"
    return [head, "", *_table(cell_table(comparison, most=MOST_ROWS)), "", "</details>", ""]


def _table(table: Table) -> list[str]:
    lines = [
        "| " + " | ".join(_text(column.name) for column in table.columns) + " |",
        "|" + "|".join("---" if column.style == "text" else "---:" for column in table.columns) + "|",
        *("| " + " | ".join(map(_text, row)) + " |" for row in table.texts()),
    ]
    return [*lines, "", *(_text(note) for note in table.notes)]


def _text(text: str) -> str:
    """Text that Markdown shows as it is: names of files and drivers come from users."""
    for character in "\\`*_[]<>|#":
        text = text.replace(character, f"\\{character}")
    return " ".join(text.split())
