"""Which rows of a table of poses count, and what is said of the others."""

from __future__ import annotations

import numpy as np

from pipelines.core.errors import InputError
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.ingest.notes import Notes


def usable_rows(table: PoseTable, notes: Notes) -> PoseTable:
    """Return the rows that have a position, without repeats of a moment where rows have no names.

    The rows that are left out are noted, and so are unknown columns and times without a zone. A row of `geo.txt`
    may lack its height.

    Raises:
        InputError: no row has a position.
    """
    notes.warn_counted(
        [f"{table.path.name}:{table.header_line} ({name or 'unnamed'})" for name in table.unknown_columns],
        "column is unknown and was ignored",
        "columns are unknown and were ignored",
    )
    if table.zoneless_times:
        notes.assume(f"times without a zone in {table.path.name} are UTC")
    return _without_repeats(_with_positions(table, notes), notes)


def _with_positions(table: PoseTable, notes: Notes) -> PoseTable:
    needed, gaps = (2, "NaN") if table.source == "geo.txt" else (3, "empty or NaN")
    located = complete(table.xyz[:, :needed])
    places = [f"{table.path.name}:{line}" for line in table.lines[~located]]
    notes.warn_counted(places, f"row has no position ({gaps})", f"rows have no position ({gaps})")
    if not located.any():
        raise InputError("no row has a position", path=table.path)
    return table.take(located)


def _without_repeats(table: PoseTable, notes: Notes) -> PoseTable:
    if table.names is not None or table.time_s is None:
        return table
    _, first = np.unique(table.time_s, return_index=True)
    repeated = np.setdiff1d(np.arange(len(table)), first)
    places = [f"{table.path.name}:{line}" for line in table.lines[repeated]]
    notes.warn_counted(
        places, "row repeats an earlier time and was left out", "rows repeat earlier times and were left out"
    )
    return table.take(np.sort(first))
