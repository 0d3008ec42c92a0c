"""Reading of text from people and spreadsheets: byte order marks, line ends, decimal commas, limits."""

from __future__ import annotations

import math
import re
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.files import file_size

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
