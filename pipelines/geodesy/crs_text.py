"""Texts of a CRS that would open files: refused before PROJ sees them.

PROJ strings, WKT and PROJJSON may name files of grids, triangulations and definitions, and PROJ opens any path. A
grid that PROJ finds by its bare name, in its own folders, is accepted.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

_BARE_NAME = re.compile(r"[\w.-]+")
_GRIDS = re.compile(r'(?<!\w)\w*grids?\s*=\s*"?([^\s"]*)', re.IGNORECASE)
_FILES = re.compile(r"(?<!\w)(?:init|file|catalog)\s*=", re.IGNORECASE)
_PIPELINE = re.compile(r"(?<!\w)(?:proj\s*=\s*pipeline|\+step)(?!\w)", re.IGNORECASE)
_WKT_FILE = re.compile(r"PARAMETERFILE", re.IGNORECASE)
_WKT_FILE_NAME = re.compile(r'PARAMETERFILE\s*[\[(]\s*"[^"]*"\s*,\s*"([^"]*)"', re.IGNORECASE)


def file_in(text: str) -> str | None:
    """Return the part of a CRS text that would open a file outside PROJ's own folders; None if there is none."""
    forbidden = _FILES.search(text) or _PIPELINE.search(text)
    if forbidden:
        return forbidden[0]
    for grids in _GRIDS.finditer(text):
        if not all(_is_bare(name) for name in grids[1].split(",")):
            return grids[0]
    names = _WKT_FILE_NAME.findall(text)
    if len(names) != len(_WKT_FILE.findall(text)):
        return "PARAMETERFILE"
    if text.lstrip().startswith("{"):
        names += _values(text)
    return next((name for name in names if not _is_bare(name)), None)


def _is_bare(name: str) -> bool:
    return _BARE_NAME.fullmatch(name.removeprefix("@")) is not None  # @ marks an optional grid


def _values(text: str) -> Iterator[str]:
    """Yield the texts that stand for values of parameters in PROJJSON."""
    try:
        pending: list[Any] = [json.loads(text)]
    except (ValueError, RecursionError):
        return  # PROJ refuses it, too
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            if isinstance(item.get("value"), str):
                yield item["value"]
            pending += item.values()
        elif isinstance(item, list):
            pending += item
