"""Tables of text with separators, where a header may stand, or stand in a comment.

Tables as CSV, which people open in spreadsheets: a name that would be a formula there begins with an apostrophe.

`=`, `+`, `-`, `@`, tab and carriage return begin formulas (OWASP, CSV injection). Names of points and photographs
come from files of other people. Numbers stay as they are. `plain_text` gives names back as they were.

Reading of text from people and spreadsheets: byte order marks, line ends, decimal commas, limits.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, replace_text

_FORMULA = re.compile(r"'*[=+\-@\t\r]")  # those of names that begin with apostrophes, too: nothing is ambiguous
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def write_table(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write rows of cells; the file appears whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    replace_text(path, table_text(rows))


def table_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells as the text of a table."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(map(_cell, row) for row in rows)
    return text.getvalue()


def plain_text(cell: str) -> str:
    """Return the text that `write_table` was given for a cell."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def _cell(value: object) -> object:
    if isinstance(value, str) and _FORMULA.match(value) and not _NUMBER.fullmatch(value):
        return f"'{value}"
    return value


_NO_UTF8 = re.compile("[\udc80-\udcff]")  # what `surrogateescape` makes of such bytes
_BEGINNING_BYTES = 64 * 1024
# A line becomes a kilobyte of cells: these bound the memory of a table to about a gibibyte.
MAX_BYTES, MOST_LINES, LONGEST_LINE = 128 * 1024 * 1024, 1_000_000, 64 * 1024


def read_lines(path: Path) -> list[str]:
    """Return the lines of a UTF-8 text file, without byte order mark and line ends (LF, CRLF or CR).

    Raises:
        InputError: missing, a folder, larger than 128 MiB, of more than a million lines, with a line of more than
            64 KiB, empty, or not UTF-8.
    """
    lines: list[str] = []
    try:
        file_size(path, limit_bytes=MAX_BYTES, kind="text table")
        with path.open(encoding="utf-8-sig", errors="surrogateescape") as handle:
            while text := handle.readline(LONGEST_LINE + 1):
                lines.append(_checked(text, path, len(lines) + 1))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    if not any(map(str.strip, lines)):
        raise InputError("is empty", path=path)
    return lines


def _checked(text: str, path: Path, line: int) -> str:
    """Return a line without its end.

    Raises:
        InputError: see `read_lines`.
    """
    if line > MOST_LINES:
        raise InputError(f"has more than {MOST_LINES} lines, the limit for a text table", path=path)
    if len(text) > LONGEST_LINE:
        raise InputError(f"is longer than {LONGEST_LINE} characters, the limit for a line", path=path, line=line)
    if _NO_UTF8.search(text):
        raise InputError("not UTF-8 text: save the file as UTF-8", path=path, line=line)
    if "\x00" in text:
        raise InputError("contains zero bytes: not a text file, or UTF-16; save it as UTF-8", path=path)
    return text.removesuffix("\n")


def beginning(path: Path) -> str:
    """Return the first 64 KiB of a file as text, to see what it is; bytes that are no UTF-8 are replaced.

    Raises:
        InputError: it cannot be read.
    """
    try:
        file_size(path)
        with path.open("rb") as handle:
            return handle.read(_BEGINNING_BYTES).decode("utf-8-sig", "replace")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error


def number(text: str, *, path: Path, line: int, field: str, decimal_comma: bool = False) -> float:
    """Return a number as a person writes it; `nan`, `inf` and an empty cell are NaN.

    Args:
        text: the cell.
        path: for errors.
        line: for errors.
        field: for errors.
        decimal_comma: whether `46,02` is a number, because commas do not separate cells.

    Raises:
        InputError: not a number.
    """
    cell = text.strip()
    if not cell:
        return math.nan
    if decimal_comma and "." not in cell:
        cell = cell.replace(",", ".", 1)
    try:
        if "_" in cell:  # Python's own digit grouping, which tables do not have
            raise ValueError(cell)
        value = float(cell)
    except ValueError:
        hint = ": write decimals with a point" if "," in cell else ""
        raise InputError(f"{text.strip()[:40]!r} is no number{hint}", path=path, line=line, field=field) from None
    return value if math.isfinite(value) else math.nan


_SEPARATORS = ";\t,"
_LONGEST_NAME = 100  # of a column that means something


@dataclass(frozen=True, slots=True)
class Row:
    """Line of a table: its cells by position, with the names of the columns that are known."""

    path: Path
    line: int
    cells: list[str]
    columns: Mapping[str, int]
    decimal_comma: bool

    def text(self, column: str) -> str:
        """Return a cell, without spaces around it; empty if the row is too short."""
        at = self.columns[column]
        return self.cells[at].strip() if at < len(self.cells) else ""

    def number(self, column: str) -> float:
        """Return the number of a cell; NaN if it is empty or there is no such column.

        Raises:
            InputError: not a number.
        """
        if column not in self.columns:
            return math.nan
        return number(
            self.text(column), path=self.path, line=self.line, field=column, decimal_comma=self.decimal_comma
        )

    def finite(self, column: str) -> float:
        """Return the number of a cell.

        Raises:
            InputError: not a number, or empty.
        """
        value = self.number(column)
        if math.isnan(value):
            raise InputError("is not a number", path=self.path, line=self.line, field=column)
        return value

    def sigma_m(self, column: str) -> float | None:
        """Return the σ of a cell; None if it is empty, zero, or there is no such column.

        Raises:
            InputError: not a number, or negative.
        """
        value = self.number(column)
        if value < 0:
            raise InputError(
                f"{value:g} is no σ: it must be above zero", path=self.path, line=self.line, field=column
            )
        return value if value > 0 else None


def separator_of(line: str) -> str | None:
    """Return the separator of a line: the most frequent of semicolon, tab and comma; None: spaces, or one cell."""
    best = max(_SEPARATORS, key=line.count)
    return best if best in line else None


def split(text: str, separator: str | None, *, path: Path, line: int) -> list[str]:
    """Return the cells of a line; without separator, spaces separate them.

    Raises:
        InputError: the line is no CSV.
    """
    if separator is None:
        return text.split()
    try:
        return next(csv.reader([text], delimiter=separator), [])
    except csv.Error as error:
        raise InputError(f"is no CSV: {error}", path=path, line=line) from error


def rows(
    path: Path, lines: Sequence[tuple[int, str]], separator: str | None, columns: Mapping[str, int]
) -> Iterator[Row]:
    """Yield the rows of numbered lines.

    Raises:
        InputError: a line is no CSV.
    """
    for line, text in lines:
        cells = split(text, separator, path=path, line=line)
        yield Row(path, line, cells, columns, separator not in (",", None))


def named_columns(
    header: Sequence[str], aliases: Mapping[str, str], path: Path, line: int
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Return the place of each column by its canonical name, and the names that mean nothing here.

    Case, units in brackets, spaces and underscores do not matter.

    Raises:
        InputError: two columns have one meaning.
    """
    columns: dict[str, int] = {}
    unknown = []
    for at, text in enumerate(header):
        name = re.sub(r"[(\[][^)\]]*[)\]]|[\s_#]", "", text[:_LONGEST_NAME]).lower()
        key = aliases.get(name)
        if key is None:
            unknown += [text.strip()] if name else []
        elif key in columns:
            raise InputError(f"two columns for {key}: {header[columns[key]]}, {text}", path=path, line=line)
        else:
            columns[key] = at
    return columns, tuple(unknown)


def is_number(text: str) -> bool:
    """Return whether a cell is a number, with decimal point or comma."""
    try:
        float(text.strip().replace(",", ".", 1))
    except ValueError:
        return False
    return True
