"""A comparison as Markdown, for the description of a pull request or the summary of a CI job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ds_analysis.common.paired_statistics import ALPHA
from ds_analysis.common.table import Table
from ds_analysis.comparison.analysis import Comparison
from ds_analysis.comparison.summary import answer_of, cautions_of, sentences_of
from ds_analysis.comparison.tables import MOST_ROWS, cell_table, command_of, drive_table, simulator_table

_READING = (
    "The reference is the network to be replaced, the candidate the one that would replace it; beside each name the "
    "first digits of its files' SHA-256.",
    "A test is a road, its conditions and a seed, driven by both on the same simulator; leaving the lane or getting "
    "stuck is a failure. Simulators are deterministic: the same network repeats its drives to the bit, so that a test "
    "that newly fails is no accident of one drive.",
    "The twin is the most faithful simulator, the others are cheap ones that are wrong in different ways.",
    "p: McNemar's exact test on the tests that changed; Holm's adjustment takes the number of simulators into account. "
    "Significant: below 0.05. 95 % intervals: Jeffreys.",
)


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
            f"No kind of road stands out: over {len(comparison.cells)} cells of the feature maps the smallest p is "
            f"{smallest:.2g} after Benjamini and Hochberg; most cells have too few tests.",
            "",
        ]
    cells = _table(cell_table(comparison, most=MOST_ROWS))
    return [
        "<details><summary>Where: cells of the feature map that changed</summary>",
        "",
        *cells,
        "",
        "</details>",
        "",
    ]


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
