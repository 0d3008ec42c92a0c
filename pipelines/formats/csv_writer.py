"""Tables as CSV, which people open in spreadsheets: a name that would be a formula there begins with an apostrophe.

`=`, `+`, `-`, `@`, tab and carriage return begin formulas (OWASP, CSV injection). Names of points and photographs
come from files of other people. Numbers stay as they are. `plain_text` gives names back as they were.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from pathlib import Path

from pipelines.core.durable import replace_text

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
