"""Puts the sensitivities of several networks side by side, as a Markdown table.

`python -m benchmarks.conditions.sensitivity_networks DIR...` reads what `ds sensitivity --out DIR` wrote for each
network on the same simulators. A cell is the value at which the twin's median road first fails, then the earliest of
the siblings'; `-` stands for no failure in the whole range, `x` for a simulator on which the gates exclude the test
before the network fails. Conditions under which no network fails anywhere are named below the table, and so is how
often the twin fails before all siblings, with one of them, or after.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

TWIN = "donkey"
NEVER, EXCLUDED = "-", "x"


@dataclass(frozen=True, kw_only=True)
class First:
    """Where one simulator's median road first fails under one condition.

    Attributes:
        share: of the condition's range; infinite if it never fails there.
        text: the value, `NEVER` or `EXCLUDED`.
    """

    share: float
    text: str


End = tuple[str, float]
"""Condition and its hardest value."""
Sensitivity = Mapping[End, Mapping[str, First]]


def read(folder: Path) -> tuple[str, Sensitivity]:
    """Read one network's name, and per end and simulator where it first fails."""
    name = str(json.loads((folder / "sensitivity.json").read_text("utf-8"))["driver"])
    found: dict[End, dict[str, First]] = {}
    with (folder / "sensitivity_values.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["first fails"]:
                value = float(f"{float(row['first fails']):.3g}")
                first = First(share=float(row["share of range"]), text=f"{value:g}")
            else:
                first = First(share=float("inf"), text=EXCLUDED if row["excluded from"] else NEVER)
            found.setdefault((row["condition"], float(row["hardest"])), {})[row["simulator"]] = first
    return name, found


def earliest(of: Mapping[str, First]) -> First:
    """The sibling that fails first; if none fails, whether one was excluded."""
    return min((first for name, first in of.items() if name != TWIN), key=lambda f: (f.share, f.text != EXCLUDED))


def order(of: Mapping[str, First]) -> str:
    """Whether the twin fails before all siblings."""
    twin, sibling = of[TWIN], earliest(of)
    if EXCLUDED in (twin.text, sibling.text):
        return "excluded somewhere"
    if twin.share == sibling.share:
        return "neither" if twin.text == NEVER else "with the first sibling"
    return "before all siblings" if twin.share < sibling.share else "after a sibling"


def markdown(networks: Sequence[tuple[str, Sensitivity]]) -> str:
    """Tabulate all networks, the conditions in the order of the first one's table."""
    ends = list(networks[0][1])
    fails = [end for end in ends if any(f.share < float("inf") for _, of in networks for f in of[end].values())]
    lines = [
        "| condition | " + " | ".join(f"`{name}`: twin, siblings" for name, _ in networks) + " |",
        "|---" * (1 + len(networks)) + "|",
    ]
    for end in fails:
        cells = [f"{of[end][TWIN].text}, {earliest(of[end]).text}" for _, of in networks]
        lines.append(f"| `{end[0]}` to {end[1]:g} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "No failure: "
        + ", ".join(f"`{name}` to {hardest:g}" for name, hardest in ends if (name, hardest) not in fails),
    ]
    for name, of in networks:
        counts = Counter(order(of[end]) for end in ends)
        lines.append(f"`{name}`: " + ", ".join(f"{what} {count}" for what, count in counts.most_common()))
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    print(markdown([read(folder) for folder in parser.parse_args().folders]))


if __name__ == "__main__":
    main()
