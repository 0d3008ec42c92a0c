"""Tables of text, as people and spreadsheets write them: named columns, units in headers, decimal commas, comments.

A reader of a kind of file states its columns and their meaning. Limits of size, byte order marks, line ends, and
the file, line and column of each error are here.

Tables are also written here. People open them in spreadsheets, where `=`, `+`, `-`, `@`, tab and carriage return
begin formulas (OWASP, CSV injection), and names of points and photographs come from other people: such a text
begins with an apostrophe. Numbers stay as they are. `plain_text` gives names back as they were.
"""

import codecs
import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats import column_names

# Sign, degrees, minutes, seconds and hemisphere: at least one mark makes it one.
_SEXAGESIMAL = re.compile(
    r"([+-]?)\s*(\d{1,3}(?:\.\d+)?)\s*(?:°|º|deg\w*|d|(?=\s*[NSEW]$))\s*"
    r"(?:(\d{1,2}(?:\.\d+)?)\s*['′’m]\s*(?:(\d{1,2}(?:\.\d+)?)\s*(?:[\"″”s]|'')\s*)?)?([NSEW]?)",
    re.IGNORECASE,
)
_FORMULA = re.compile(r"'*[=+\-@\t\r]")  # those of names that begin with apostrophes, too: nothing is ambiguous
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_NO_UTF8 = re.compile("[\udc80-\udcff]")  # what `surrogateescape` makes of such bytes
_BEGINNING_BYTES = 64 * 1024
# A line becomes a kilobyte of cells: these bound the memory of a table to about a gibibyte.
MAX_BYTES, MOST_LINES, LONGEST_LINE = 128 * 1024 * 1024, 1_000_000, 64 * 1024
_SEPARATORS = ";\t,"
_NAMES = frozenset({"image", "label"})  # columns that hold names, of which a table may have several
_AROUND_TAB = re.compile(r"[,;] *\t|\t *[,;]")


def table_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells as the text of a table."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(map(_cell, row) for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, str) and _FORMULA.match(value) and not _NUMBER.fullmatch(value):
        return f"'{value}"
    return value


def plain_text(cell: str) -> str:
    """Return the text that `table_text` was given for a cell."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def read_lines(path: Path) -> list[str]:
    r"""Return the lines of a text file, without byte order mark and line ends (LF, CRLF or CR).

    The text is UTF-8, or UTF-16 where its byte order mark says so, as spreadsheets save "Unicode text".

    Raises:
        InputError: missing, a folder, larger than 128 MiB, of more than a million lines, with a line of more than
            64 KiB, empty, or not UTF-8.

    Examples:
        >>> _ = Path("points.txt").write_text("P1;10\r\nP2;20\r\n", encoding="utf-16")
        >>> read_lines(Path("points.txt"))
        ['P1;10', 'P2;20']
    """
    lines: list[str] = []
    file_size(path, limit_bytes=MAX_BYTES, kind="text table")
    try:
        with reading(path), path.open(encoding=_encoding(path), errors="surrogateescape") as handle:
            while text := handle.readline(LONGEST_LINE + 1):
                _check_line(text, path, len(lines) + 1)
                lines.append(text.removesuffix("\n"))
    except UnicodeDecodeError as error:  # of UTF-16; what is no UTF-8 is found line by line
        message = "The file begins as UTF-16 does, and is none."
        remedy = "Save it as UTF-8."
        raise InputError("not-text", message, path=path, remedy=remedy) from error
    if not any(map(str.strip, lines)):
        raise InputError("file-empty", "The file is empty.", path=path)
    return lines


def _check_line(text: str, path: Path, line: int) -> None:
    if line > MOST_LINES:
        raise InputError("too-many-lines", f"The table has more than {MOST_LINES} lines, the limit.", path=path)
    if len(text) > LONGEST_LINE:
        message = f"The line is longer than {LONGEST_LINE} characters, the limit."
        raise InputError("line-too-long", message, path=path, line=line)
    if _NO_UTF8.search(text):
        raise InputError(
            "not-utf8", "The text is not UTF-8.", path=path, line=line, remedy="Save the file as UTF-8."
        )
    if "\x00" in text:
        message = "The file contains zero bytes: it is not text, or it is UTF-16."
        remedy = "Save it as UTF-8."
        raise InputError("not-text", message, path=path, remedy=remedy)


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines that are not blank, without spaces around them, and their numbers; see `read_lines`."""
    return [(at, text.strip()) for at, text in enumerate(read_lines(path), start=1) if text.strip()]


def beginning(path: Path) -> str:
    """Return the first 64 KiB of a file as text, to see what it is; bytes that are no UTF-8 are replaced.

    Raises:
        InputError: it cannot be read.
    """
    file_size(path)
    with reading(path), path.open("rb") as handle:
        return handle.read(_BEGINNING_BYTES).decode(_encoding(path), "replace")


def _encoding(path: Path) -> str:
    """Return the encoding of a text by its byte order mark."""
    with path.open("rb") as handle:
        return "utf-16" if handle.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def cell_number(text: str, *, path: Path, line: int, field: str, decimal_comma: bool = False) -> float:
    """Return the number in a cell as a person writes it; `nan`, `inf` and an empty cell are NaN.

    With `decimal_comma`, `46,02` is a number, because commas do not separate cells.

    Raises:
        InputError: not a number; names path, line and field.
    """
    cell = text.strip()
    if not cell:
        return math.nan
    if decimal_comma:
        cell = with_decimal_point(cell)
    try:
        if "_" in cell:  # Python's own digit grouping, which tables do not have
            raise ValueError(cell)
        value = float(cell)
    except ValueError:
        hint = ": write decimals with a point" if "," in cell else ""
        message = f"{text.strip()[:40]!r} is not a number{hint}"
        raise InputError("not-a-number", message, path=path, line=line, field=field) from None
    return value if math.isfinite(value) else math.nan


def with_decimal_point(text: str) -> str:
    """Return the text of a number whose first comma is a point, unless it has a point: `46,02` is `46.02`."""
    return text if "." in text else text.replace(",", ".", 1)


def is_number(text: str, *, decimal_comma: bool = True) -> bool:
    """Return whether a cell is one number, `nan` and `inf` among them; with `decimal_comma`, `46,02` is one."""
    try:
        float(with_decimal_point(text) if decimal_comma else text)
    except ValueError:
        return False
    return True


@dataclass(frozen=True, slots=True)
class Row:
    """Line of a table: its cells by position, with the places of the columns that are known.

    What is no number or no name is refused by an `InputError` with file, line and column.
    """

    path: Path
    line: int
    cells: list[str]
    columns: Mapping[str, int]
    decimal_comma: bool = False
    units: Mapping[str, str] = field(default_factory=dict)  # that the header states, of the columns

    def fault(self, code: str, message: str, column: str | None = None, *, remedy: str = "") -> InputError:
        """Return the error of this line."""
        return InputError(code, message, path=self.path, line=self.line, field=column, remedy=remedy)

    def text(self, column: str) -> str:
        """Return a cell, without spaces around it; empty if the row is too short."""
        at = self.columns[column]
        return self.cells[at].strip() if at < len(self.cells) else ""

    def named(self, column: str) -> str:
        """Return a cell that is not empty."""
        text = self.text(column)
        if not text:
            raise self.fault("name-missing", "the name is missing", column)
        return text

    def number(self, column: str) -> float:
        """Return the number of a cell; NaN if it is empty or there is no such column."""
        if column not in self.columns:
            return math.nan
        text, comma = self.text(column), self.decimal_comma
        return cell_number(text, path=self.path, line=self.line, field=column, decimal_comma=comma)

    def finite(self, column: str) -> float:
        """Return the number of a cell that is not empty."""
        value = self.number(column)
        if math.isnan(value):
            raise self.fault("number-missing", "the number is missing or not finite", column)
        return value

    def degrees(self, column: str) -> float:
        """Return the angle of a cell in degrees; NaN if it is empty or there is no such column.

        Degrees, minutes and seconds are read (`46°48'36.0"N`, `46 deg 48' 36.00" S`, `9.41 W`), and a column
        `…_ref` with S or W makes the angle negative.
        """
        text = self.text(column) if column in self.columns else ""
        if parts := _SEXAGESIMAL.fullmatch(text):
            sign = -1.0 if parts[1] == "-" or (parts[5] or "").upper() in ("S", "W") else 1.0
            value = sign * math.fsum(float(parts[at] or 0) / 60 ** (at - 2) for at in (2, 3, 4))
        else:
            value = self.number(column) * column_names.ANGLES_DEG.get(self.units.get(column, "deg"), 1.0)
        hemisphere = self.text(f"{column}_ref")[:1].upper() if f"{column}_ref" in self.columns else ""
        return -abs(value) if hemisphere in ("S", "W") else value

    def sigma_m(self, column: str) -> float | None:
        """Return the σ of a cell, not negative; None if it is empty, zero, or there is no such column."""
        value = self.number(column) * column_names.LENGTHS_M.get(self.units.get(column, "m"), 1.0)
        if value < 0:
            raise self.fault("sigma-not-positive", f"the σ of {value:g} is not above zero", column)
        return value if value > 0 else None


@dataclass(frozen=True)
class Table:
    """Rows of a file, with its header: line (None: it has none), known columns, and names that mean nothing here.

    `crs_text` is the CRS that a line of the file states; None: it states none.
    """

    path: Path
    header_line: int | None
    columns: Mapping[str, int]
    unknown: tuple[str, ...]
    rows: list[Row]
    crs_text: str | None = None
    crs_line: int = 1
    units: Mapping[str, str] = field(default_factory=dict)  # that the header states, of the columns

    @property
    def lines(self) -> IntArray:
        """(N,) line of each row."""
        return np.array([row.line for row in self.rows], dtype=np.int64)

    def has(self, columns: Sequence[str]) -> bool:
        """Return whether a group of columns is there: all of them, or none; an InputError: a part of them."""
        present = any(name in self.columns for name in columns)
        if present:
            require_columns(self.columns, columns, self.path, self.header_line)
        return present

    def numbers(self, columns: Sequence[str]) -> FloatArray:
        """Return the numbers of columns (N, K); NaN where empty."""
        return np.stack([[row.number(column) for row in self.rows] for column in columns], axis=-1)


def separator_of(line: str) -> str | None:
    """Return the separator of a line: a tab between cells, else the more frequent of semicolon and comma.

    None: spaces, or one cell.
    """
    if "\t" in line.strip() and not _AROUND_TAB.search(line):
        return "\t"
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
        raise InputError("not-csv", f"The line is not CSV: {error}", path=path, line=line) from error


def table_rows(
    path: Path,
    lines: Sequence[tuple[int, str]],
    separator: str | None,
    columns: Mapping[str, int],
    units: Mapping[str, str] | None = None,
) -> list[Row]:
    """Return the rows of numbered lines; see `split`."""
    comma, units = separator not in (",", None), units or {}
    return [
        Row(path, line, split(text, separator, path=path, line=line), columns, comma, units) for line, text in lines
    ]


def named_columns(
    header: Sequence[str], vocabulary: Mapping[str, str], path: Path, line: int
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Return the place of each column by its canonical name, and the names that mean nothing here.

    `vocabulary` has the canonical name of each plain one. Of two names of an image or a point, the one that stands
    first in it counts; of two coordinates the one whose name says nothing else (`altitude` before `gps_altitude`).

    Raises:
        InputError: two columns have one meaning.
    """
    order = {name: rank for rank, name in enumerate(vocabulary)}
    columns: dict[str, int] = {}
    ranks: dict[str, int] = {}
    unknown: dict[int, str] = {}
    for at, text in enumerate(header):
        key, plain = column_names.meaning_of(text, vocabulary), column_names.plain_name(text)
        if key is None:
            unknown[at] = text.strip()
            continue
        rank = order.get(plain, len(order)) if key in _NAMES else int(plain not in vocabulary)
        if key in columns and rank == ranks[key]:
            message = f"Two columns are {key}: {header[columns[key]].strip()}, {text.strip()}."
            raise InputError("column-twice", message, path=path, line=line)
        if key in columns and rank > ranks[key]:
            unknown[at] = text.strip()
            continue
        if key in columns:
            unknown[columns[key]] = header[columns[key]].strip()
        columns[key], ranks[key] = at, rank
    return columns, tuple(unknown[at] for at in sorted(unknown))


def units_of(header: Sequence[str], columns: Mapping[str, int]) -> dict[str, str]:
    """Return the units that the names of columns state, by canonical name."""
    units = {name: column_names.unit_of(header[at]) for name, at in columns.items() if at < len(header)}
    return {name: unit for name, unit in units.items() if unit is not None}


def unknown_header(
    header: Sequence[str],
    vocabulary: Mapping[str, str],
    needed: str,
    *,
    path: Path,
    line: int | None,
    missing: Iterable[str] = (),
) -> InputError:
    """Return the error of a header without the columns that are needed: what was found, and what is near."""
    lacks, near = ", ".join(missing), column_names.nearest_columns(header, vocabulary)
    columns = column_names.listed_columns(header)
    known = any(column_names.meaning_of(text, vocabulary) for text in header)
    message = (
        f"The header has no column {lacks}. It has {columns}" if lacks else f"The header has the columns {columns}"
    )
    code = "column-missing" if known else "header-missing"
    return InputError(code, f"{message}; needed are {needed}.{near}", path=path, line=line)


def require_columns(columns: Mapping[str, int], needed: Iterable[str], path: Path, line: int | None) -> None:
    """Raise an InputError that names the needed columns which the header does not have."""
    missing = [name for name in needed if name not in columns]
    if missing:
        message = f"The header has no column {', '.join(missing)}."
        raise InputError("column-missing", message, path=path, line=line)


def require_rows(rows: Sequence[object], path: Path) -> None:
    """Raise an InputError for a table without rows."""
    if not rows:
        raise InputError("no-rows", "The table has no rows of data.", path=path)


def refuse_first(
    bad: BoolArray,
    code: str,
    message: Callable[[int], str],
    *,
    path: Path,
    lines: Sequence[int] | IntArray,
    field: str,
) -> None:
    """Raise an InputError for the first row that is bad (N,), with the message on it and its line (N,)."""
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(code, message(row), path=path, line=int(lines[row]), field=field)


def require_range(
    values: FloatArray, low: float, high: float, *, path: Path, lines: Sequence[int] | IntArray, field: str
) -> None:
    """Raise an InputError for the first of values (N,) outside a range; NaN passes."""

    def message(row: int) -> str:
        return f"{values[row]:g} is out of range {low:g} … {high:g}"

    out = (values < low) | (values > high)
    refuse_first(out, "value-out-of-range", message, path=path, lines=lines, field=field)
