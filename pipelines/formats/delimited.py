"""Tables of text with separators, where a header may stand, or stand in a comment."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.formats.text import number

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
