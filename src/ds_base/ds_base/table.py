# SPDX-License-Identifier: Apache-2.0
"""Tables of results: on a terminal, as CSV with every digit, and as LaTeX for a paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import rich.box
import rich.table
from pydantic import Field, TypeAdapter, ValidationError
from rich.console import Console
from rich.text import Text

from ds_base.bounded_file import read_regular
from ds_base.bounded_tables import csv_text
from ds_base.errors import InputError
from ds_base.folder_files import write_json, write_whole

Number = Annotated[float, Field(allow_inf_nan=False)]
Value = str | Number | Annotated[int, Field(ge=-(2**53), le=2**53)] | tuple[Number, Number] | None
"""None is a missing number, a pair an interval."""
Style = Literal["text", "count", "number", "small", "p"]
"""number: three digits after the point; small: five."""
WIDTH = 130
"""Characters of a table that is not shown on a terminal; chosen: the widest one fits."""
_SMALLEST_P = 1e-300
"""Smaller p-values are below this in LaTeX: SciPy underflows to 0 soon after, which no p-value is."""
_DIGITS = {"number": 3, "small": 5}
_TEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}"}
_TEX |= {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}"}


class TableError(InputError):
    """Stored tables that cannot be read."""


@dataclass(frozen=True)
class Column:
    """Column of a table: heading and style of its values."""

    name: str
    style: Style = "text"


def styled(style: Style, *names: str) -> list[Column]:
    """Columns of one style."""
    return [Column(name, style) for name in names]


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of results, whose name is the stem of its files, with sentences below it.

    Examples:
        >>> from ds_base.table import Column, Table
        >>> columns = [Column("simulator"), Column("failures")]
        >>> table = Table(name="failures", title="Failures", columns=columns, rows=[("bullet", 3)])
        >>> print(table.csv(), end="")
        simulator,failures
        bullet,3
    """

    name: str
    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Value]]
    notes: Sequence[str] = field(default=())

    def texts(self) -> list[list[str]]:
        """Format the rows for reading."""
        return [[shown(v, c.style) for v, c in zip(row, self.columns, strict=True)] for row in self.rows]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        names = [c.name for c in self.columns]
        rows = [
            dict(zip(names, (list(v) if isinstance(v, tuple) else v for v in row), strict=True)) for row in self.rows
        ]
        return {"name": self.name, "title": self.title, "rows": rows, "notes": list(self.notes)}

    def csv(self) -> str:
        """Format as CSV; an interval takes two columns, a missing value is empty, a formula gets a `'`."""
        wide = [any(isinstance(row[k], tuple) for row in self.rows) for k in range(len(self.columns))]
        heads: list[str] = []
        for column, pair in zip(self.columns, wide, strict=True):
            heads += [f"{column.name}, low", f"{column.name}, high"] if pair else [column.name]
        rows = [heads]
        for row in self.rows:
            values: list[str] = []
            for value, pair in zip(row, wide, strict=True):
                parts = value if isinstance(value, tuple) else (value, None) if pair else (value,)
                values += ["" if part is None else str(part) for part in parts]
            rows.append(values)
        return csv_text(rows)

    def latex(self) -> str:
        """Format as LaTeX `table` with `tabular`; needs the package booktabs."""
        lines = [
            r"\begin{table}[ht]",
            r"\centering",
            rf"\caption{{{tex(self.title)}}}",
            rf"\label{{table:{self.name}}}",
            rf"\begin{{tabular}}{{{''.join('l' if c.style == 'text' else 'r' for c in self.columns)}}}",
            r"\toprule",
            " & ".join(tex(c.name) for c in self.columns) + r" \\",
            r"\midrule",
            *(
                " & ".join(_tex_value(v, c.style) for v, c in zip(row, self.columns, strict=True)) + r" \\"
                for row in self.rows
            ),
            r"\bottomrule",
            r"\end{tabular}",
            *(rf"\par {tex(note)}" for note in self.notes),
            r"\end{table}",
        ]
        return "\n".join(lines) + "\n"

    def show(self, console: Console) -> None:
        """Print the table; at least `WIDTH` characters wide if not on a terminal."""
        table = rich.table.Table(title=self.title, title_justify="left", caption="\n".join(self.notes) or None)
        table.box, table.caption_justify, table.padding = rich.box.SIMPLE_HEAD, "left", (0, 0)
        for column in self.columns:
            table.add_column(column.name, justify="left" if column.style == "text" else "right", overflow="fold")
        last = ""
        for first, *others in self.texts():
            table.add_row("" if first == last else first, *(Text(text) for text in others))
            last = first
        if not console.is_terminal:
            console.width = max(console.width, WIDTH)
        console.print(table)


_KEPT = TypeAdapter(list[Table])


def shown(value: Value, style: Style) -> str:
    """Format a value for reading; "" if it is missing."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if isinstance(value, tuple):
        return "[" + ", ".join(shown(part, style) for part in value) + "]"
    if style == "p":
        return f"{value:.3f}" if value >= 0.001 else "< 0.001"
    return f"{value:z.{_DIGITS[style]}f}" if style in _DIGITS else str(value)


def p_in_words(p: float) -> str:
    """Format a p-value for a sentence: `p = 0.012`, `p < 0.001`."""
    text = shown(p, "p")
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def tex(text: str) -> str:
    """Escape LaTeX's special characters."""
    return "".join(_TEX.get(c, c) for c in text)


def _tex_value(value: Value, style: Style) -> str:
    if value is None:
        return "--"
    if style == "p" and isinstance(value, float) and value < 0.001:
        mantissa, _, exponent = f"{max(value, _SMALLEST_P):.0e}".partition("e")
        if value < _SMALLEST_P:
            return rf"$< 10^{{{int(exponent)}}}$"
        return rf"${mantissa} \cdot 10^{{{int(exponent)}}}$"
    if isinstance(value, str):
        return tex(value)
    if isinstance(value, tuple):
        return "[" + ", ".join(f"${shown(part, style)}$" for part in value) + "]"
    text = shown(value, style)
    return f"${text}$" if text.startswith("-") else text


def write_tables(tables: Sequence[Table], folder: Path) -> None:
    """Write `<name>.csv` and `<name>.tex` of every table into a folder, created if missing."""
    for table in tables:
        write_whole(folder / f"{table.name}.csv", table.csv())
        write_whole(folder / f"{table.name}.tex", table.latex())


def keep_tables(tables: Sequence[Table], path: Path) -> None:
    """Write tables for `read_tables`; the folder is created if missing."""
    rows = [{**asdict(table), "rows": [list(row) for row in table.rows]} for table in tables]
    write_json(path, rows)


def read_tables(path: Path) -> list[Table]:
    """Read what `keep_tables` wrote, or raise `TableError`; empty if there is no such file."""
    try:
        tables = _KEPT.validate_json(read_regular(path, follow_links=False))
        if any(len(row) != len(table.columns) for table in tables for row in table.rows):
            raise ValueError("a row has another length than the columns")
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise TableError(f"{path} cannot be read ({reason}): remove it, or give `ds evaluate` --data again") from None
    return tables
