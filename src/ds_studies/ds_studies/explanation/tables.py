"""Explanations as tables and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.table import Column, Table
from ds_analysis.failures.reasons import FailureGroup
from ds_road.figures import COLOURS, WIDTH, draw_figure, short_name
from ds_studies.explanation.shares import Explanation

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def groups_table(groups: Sequence[FailureGroup]) -> Table:
    """Tabulate groups of failures, one row each."""
    columns = [Column("the driver"), Column("failures", "count"), Column("where"), Column("for example")]
    rows = [
        (
            group.kind, len(group.reasons), ", ".join(f"{n} on {name}" for name, n in group.by_simulator.items()),
            group.reasons[0].test_id,
        )
        for group in groups
    ]  # fmt: skip
    return Table(name="failures", title="Failures by what led there", columns=columns, rows=rows)


def shares_table(found: Explanation) -> Table:
    """Tabulate the parts of one explanation, the largest share first, then what is left over."""
    columns = [
        Column("part"), Column("share", "number"), Column(f"alone on {found.against}"),
        Column(f"{found.fails} without it"),
    ]  # fmt: skip
    rows = [
        (part, share, "fails" if found.brings(part) else "completes", "completes" if found.cures(part) else "fails")
        for part, share in found.shares.items()
    ]
    return Table(
        name=f"explanation_{found.test_id}_{found.fails}",
        title=f"{found.test_id}: fails on {found.fails}, not on {found.against}",
        columns=columns,
        rows=[*rows, ("left over", found.left_over, "", "")],
        notes=[f"{len(found.losses)} drives; {found.only_together:.2f} of the difference comes about only together."],
    )


def draw_shares(explained: Sequence[Explanation]) -> NDArray[np.uint8]:
    """Draw the shares of every part, one group of bars for each explanation: (rows, columns, 3) uint8 RGB."""
    bars = [(k, found, part, share) for k, found in enumerate(explained) for part, share in found.shares.items()]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.barh(range(len(bars)), [bar[3] for bar in bars], color=[COLOURS[bar[0] % len(COLOURS)] for bar in bars])
        labels = [f"{found.test_id} on {short_name(found.fails)}: {part}" for _, found, part, _ in bars]
        axes.set_yticks(range(len(bars)), labels)
        axes.set(ylim=(len(bars) - 0.5, -0.5), xlabel="share of the failure")
        axes.grid(visible=False, axis="y")

    return draw_figure(WIDTH, 80 + 26 * len(bars), draw)
