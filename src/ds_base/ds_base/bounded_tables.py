# SPDX-License-Identifier: Apache-2.0
"""Tables that a stranger may have sent: CSV, compressed too, and Parquet, bounded in what they become in memory."""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import lzma
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from ds_base.bounded_file import FileError, open_regular
from ds_base.bounded_memory import limited_memory

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

LARGEST_TABLE = 2**29
"""Bytes of the text or of the values, decompressed, dictionaries expanded; chosen: some 25 for each value."""
MOST_ROWS = 2_000_000
"""Rows; chosen: ten times the largest published study."""
MOST_VALUES = 20_000_000
"""Rows times columns; chosen: ten columns of the most rows."""
MOST_COLUMNS = 10_000
"""Columns; chosen: a hundred times those of a wide table."""
TABLE_MEMORY = 4 * 2**30
"""Bytes that a library may map while it reads a table; chosen: a table at its limits, as text and as values."""
_PACKED: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
_COMMA = r"\s*[+-]?\d+(,\d+)?([eE][+-]?\d+)?\s*"
"""A number with or without a decimal comma."""
_LONGEST_HEADER = 2**20
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters at which a spreadsheet computes a cell of text (OWASP, CSV Injection)."""


def too_large(what: str) -> FileError:
    """The error of a table beyond a limit, which the words name."""
    return FileError(f"more than {what}, the limit for a table: take a part of it")


@contextmanager
def _table_memory() -> Iterator[None]:
    try:
        with limited_memory(TABLE_MEMORY):
            yield
    except MemoryError:
        raise too_large(f"{TABLE_MEMORY // 2**30} GiB of memory") from None


class _Counted(io.RawIOBase):
    """Text of a table, counted while it is read; a reader takes memory for lines and values, not for bytes alone."""

    def __init__(self, file: BinaryIO, separator: str) -> None:
        self._file, self._separator = file, separator.encode()
        self._size = self._lines = self._separators = 0

    def readable(self) -> bool:
        """Whether it can be read."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read the next bytes."""
        content = self._file.read(len(buffer))
        buffer[: len(content)] = content
        self._size += len(content)
        self._lines += max(content.count(b"\n"), content.count(b"\r"))
        self._separators += content.count(self._separator)
        for count, most, what in (
            (self._size, LARGEST_TABLE, f"{LARGEST_TABLE // 2**20} MiB of text"),
            (self._lines, MOST_ROWS + 1, f"{MOST_ROWS} lines"),
            (self._separators + self._lines, MOST_VALUES, f"{MOST_VALUES} values"),
        ):
            if count > most:
                raise too_large(what)
        return len(content)


@contextmanager
def _text_of(path: Path) -> Iterator[BinaryIO]:
    """Open a CSV file, and decompress it by its suffix."""
    with open_regular(path) as file:
        packed = _PACKED.get(path.suffix.lower())
        yield file if packed is None else cast(BinaryIO, packed(file))


def read_csv(path: Path) -> pd.DataFrame:
    """Read comma-, semicolon- or tab-separated values, also of `.gz`, `.bz2` and `.xz`; the index is the line.

    Where commas separate nothing and no number has a decimal point, numbers may have decimal commas. What is no such
    table, has a column twice or is beyond a limit is a FileError of one line, a file that cannot be opened an OSError.
    """
    import pandas as pd

    try:
        with _text_of(path) as file:
            header = file.readline(_LONGEST_HEADER).decode()
        separator = next((one for one in ";\t" if "," not in header and one in header), ",")
        _check_names(next(csv.reader([header], delimiter=separator), []))
        with _text_of(path) as file, _table_memory(), warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # rows that are longer than the header
            text = io.BufferedReader(_Counted(file, separator), 2**18)
            frame = pd.read_csv(text, sep=separator, index_col=False, skip_blank_lines=False)
    except FileError:
        raise
    except (EOFError, OSError, ValueError, Warning, csv.Error, zlib.error, lzma.LZMAError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise FileError(f"not CSV ({_line(error)}): expected a table with a header") from None
    for name in (one for one in frame if pd.api.types.is_object_dtype(frame[one])):
        frame[name] = frame[name].map(_bounded_integer)
    if separator != "," and not any((frame[name] % 1).any() for name in frame.select_dtypes("float")):
        for name in (one for one in frame if frame[one].dtype.kind == "O"):
            if frame[name].dropna().astype(str).str.fullmatch(_COMMA).all():
                frame[name] = frame[name].str.replace(",", ".").astype(float)
    frame.index = pd.RangeIndex(2, 2 + len(frame), name="line")  # the first has the names
    return frame.dropna(how="all")


def _bounded_integer(value: object) -> object:
    """A value of a column; an integer beyond 64 bits as text, which no reader takes for a number."""
    return str(value) if isinstance(value, int) and abs(value) >= 2**63 else value


def read_parquet(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read columns of a flat Parquet file, all if None, with the metadata of its schema; dictionaries are expanded.

    Errors are those of `read_csv`; nested columns are refused, too.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with open_regular(path) as file, _table_memory():
            parquet = pq.ParquetFile(file)
            schema, about = parquet.schema_arrow, parquet.metadata
            names = schema.names if columns is None else list(columns)
            _check_names(schema.names)
            groups = [about.row_group(k).total_byte_size for k in range(about.num_row_groups)]
            for count, most, what in (
                (about.num_rows, MOST_ROWS, "rows"),
                (about.num_rows * len(names), MOST_VALUES, "values"),
                (sum(groups) if min(groups, default=0) >= 0 else LARGEST_TABLE + 1, LARGEST_TABLE, "bytes"),
            ):
                if count > most:
                    raise too_large(f"{most} {what}")
            texts = [name for name in schema.names if _is_text(schema.field(name))]
            # A dictionary of a few bytes may stand for terabytes, so it is measured before it is expanded.
            parquet = pq.ParquetFile(file, metadata=about, read_dictionary=texts)
            left, parts = LARGEST_TABLE, []
            for name in names:
                column = parquet.read([name], use_threads=False).column(0)
                if pa.types.is_dictionary(column.type):
                    left -= sum(_expanded(chunk, name in texts) for chunk in column.chunks)
                    if left < 0:
                        raise too_large(f"{LARGEST_TABLE // 2**20} MiB of values")
                    column = column.cast(column.type.value_type)
                left -= 0 if name in texts else column.nbytes
                parts.append(column)
            table = pa.table(parts, names=names).replace_schema_metadata(schema.metadata)
            table.validate(full=True)
            return table
    except (FileError, FileNotFoundError, PermissionError):
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise FileError(f"not Parquet ({_line(error)}): expected a table") from None


def _is_text(field: pa.Field[Any]) -> bool:
    """Whether a column has values of any length; nested ones are refused, as few bytes may stand for any number."""
    from pyarrow import types

    kind = field.type.value_type if types.is_dictionary(field.type) else field.type
    if types.is_nested(kind) or types.is_fixed_size_binary(kind):
        raise FileError(f"the column {field.name!r:.60} has {kind!s:.60}, expected numbers or text")
    checks = types.is_string, types.is_large_string, types.is_binary, types.is_large_binary
    return any(check(kind) for check in checks)


def _expanded(chunk: pa.DictionaryArray[Any], text: bool) -> int:
    """Bytes of a part of a column without its dictionary."""
    import pyarrow.compute as pc

    lengths = pc.cast(pc.binary_length(chunk.dictionary), "int64").take(chunk.indices) if text else None
    return 16 * len(chunk) + (0 if lengths is None else int(pc.sum(lengths).as_py() or 0))


def _check_names(names: Iterable[str]) -> None:
    counts = Counter(names)
    if counts.total() > MOST_COLUMNS:
        raise too_large(f"{MOST_COLUMNS} columns")
    if twice := [name for name, count in counts.items() if count > 1 and name]:
        raise FileError(f"line 1: the column {twice[0]!r:.60} comes twice: rename one")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:150] or type(error).__name__


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Format rows as comma-separated values, with a `'` before text that a spreadsheet would compute.

    Examples:
        >>> from ds_base.bounded_tables import csv_text
        >>> print(csv_text([("name", "value"), ("=1+1", -1.5)]), end="")
        name,value
        '=1+1,-1.5
    """
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([plain_cell(value) for value in row] for row in rows)
    return out.getvalue()


def plain_cell(value: object) -> object:
    """A cell that no spreadsheet computes: text that begins like a formula, and is no number, after a `'`."""
    if not isinstance(value, str) or not value.startswith(_FORMULA) or len(value) == 1:
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
