"""A comparison as Markdown, for the description of a pull request or the summary of a CI job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ds_orchestrator.comparison.analysis import Comparison
from ds_orchestrator.comparison.summary import answer_of, cautions_of, sentences_of
from ds_orchestrator.comparison.tables import MOST_ROWS, cell_table, command_of, drive_table, simulator_table
from ds_orchestrator.evaluation.table import Table


def markdown_of(comparison: Comparison, road_files: Mapping[str, str], unmet: Sequence[str] = ()) -> str:
    """Format a comparison as GitHub's and GitLab's Markdown.

    Args:
        comparison: the comparison.
        road_files: test -> file with its road, for tests that newly fail.
        unmet: pass criteria that are not met, one sentence each.
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
        lines += ["<details><summary>See them: commands that write a video of each</summary>", "", "```bash"]
        lines += [*commands, "```", "", "</details>", ""]
    cells = cell_table(comparison, most=MOST_ROWS)
    if cells.rows:
        lines += ["<details><summary>Where: cells of the feature map that changed</summary>", "", *_table(cells)]
        lines += ["", "</details>", ""]
    if cautions := cautions_of(comparison):
        lines += ["<details><summary>What these numbers cannot carry</summary>", ""]
        lines += [*(f"- {_text(caution)}" for caution in cautions), "", "</details>", ""]
    return "\n".join(lines)


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
