"""Bounds of a generator that may be shipped, and the rule by which a checkpoint is chosen; fixed before any result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MAX_SHIFT = 0.0125
"""Largest median shift of the lane's lines beyond that of untranslated images, in widths of the image; chosen: 2 px of
160, some 8 cm on the road beside the car, a hundredth of the road and what an autopilot deviates on a straight."""
MAX_SHIFT_95 = 0.03
"""The same for the 95th percentile; chosen: 5 px of 160, 20 cm, a tenth of the distance at which a car is out of
bounds."""
LEAST_FOUND = 0.8
"""Least share of the rows with a line, as a share of that in held-out photographs, with dashes and wear; chosen: a
fifth less than in reality. A first version asked for 0.8 of what the simulator shows, which photographs themselves do
not have (0.74): replaced before the generators that it now judges were trained."""
LEAST_OVERLAP = 0.5
"""Least overlap with the truth, as a share of that of untranslated images times the share of rows with lines in
photographs; chosen: a line of twice the width, as the tape on real tracks is, halves it."""
MAX_FLICKER = 6.0
"""Largest flicker beyond that of untranslated images, grey levels; chosen: the noise of a poor camera."""


def broken_bounds(
    checkpoint: Mapping[str, Any], plain: Mapping[str, Any], photographs: Mapping[str, float], columns: int
) -> list[str]:
    """Name the bounds that a checkpoint breaks.

    Args:
        checkpoint: its entry of an assessment.
        plain: the same of the untranslated images.
        photographs: shares of the rows with lines, from `ds_driver.sim2real.evaluation.lane_kept.lines_of_photographs`.
        columns: columns of the images.
    """
    kept, before = checkpoint["lane"], plain["lane"]
    both = (photographs["yellow"] + photographs["white"]) / 2
    checks = (
        (kept["shift"] - before["shift"], MAX_SHIFT * columns, "lines are shifted by {0:.1f} px more"),
        (
            kept["shift_95"] - before["shift_95"],
            MAX_SHIFT_95 * columns,
            "one line in twenty is shifted by {0:.1f} px more",
        ),
        *(
            (
                -kept[f"found_{line}"],
                -LEAST_FOUND * min(photographs[line], before[f"found_{line}"]),
                f"the {line} line is found in {{1:.0%}} of its rows",
            )
            for line in ("yellow", "white")
        ),
        (-kept["overlap"], -LEAST_OVERLAP * before["overlap"] * both, "lines overlap the truth by {1:.0%}"),
        (checkpoint["flicker"] - plain["flicker"], MAX_FLICKER, "still pixels flicker by {0:.1f} grey levels more"),
    )
    return [f"{text.format(value, -value)} (bound {abs(bound):.2g})" for value, bound, text in checks if value > bound]


def choose(checkpoints: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Choose a checkpoint: of those that break no bound, the one nearest to the photographs; None if there is none.

    The distance is that of the public network's features where it was computed, else Dave-2's; the earlier wins a tie.
    """
    within = [name for name in sorted(checkpoints) if not checkpoints[name]["broken"]]

    def distance(name: str) -> float:
        found = checkpoints[name]["distance"]
        return float(found[next(iter(found))]["value"])

    return min(within, key=distance, default=None)
