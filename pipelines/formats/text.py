"""Reading of text from people and spreadsheets: byte order marks, line ends, decimal commas, limits."""

from __future__ import annotations

import math
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.files import file_size

_BEGINNING_BYTES = 64 * 1024
MAX_BYTES = 128 * 1024 * 1024


def read_lines(path: Path) -> list[str]:
    """Return the lines of a UTF-8 text file, without byte order mark and line ends (LF, CRLF or CR).

    Raises:
        InputError: missing, a folder, larger than 128 MiB, empty, or not UTF-8.
    """
    try:
        file_size(path, limit_bytes=MAX_BYTES, kind="text table")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError("not UTF-8 text: save the file as UTF-8", path=path, line=line) from error
    if "\x00" in text:
        raise InputError("contains zero bytes: not a text file, or UTF-16; save it as UTF-8", path=path)
    if not text.strip():
        raise InputError("is empty", path=path)
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


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
