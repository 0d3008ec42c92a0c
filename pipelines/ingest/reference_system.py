"""Reference systems of the input files: which one a file's coordinates are in, and what is said of it."""

from __future__ import annotations

from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.operations import WGS84
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions


def stated_crs(text: str, path: Path, options: IngestOptions, notes: Notes, *, line: int = 1) -> PointCrs:
    """Return the CRS that a line of a file states, and note where `--vertical` does not apply to it.

    Raises:
        InputError: it is none.
    """
    crs = parse_crs(text, vertical=options.vertical, path=path, line=line)
    _note_own_heights(crs, path, options, notes)
    return crs


def crs_of_table(table: PoseTable, options: IngestOptions, notes: Notes) -> PointCrs:
    """Return the CRS of a table of poses: its own, else that of `--crs`, else the one of its kind of file.

    Raises:
        InputError: no CRS for x,y,z columns, heights above a geoid that nobody names, or options that contradict
            the table or each other.
    """
    if table.crs_text is not None:
        return stated_crs(table.crs_text, table.path, options, notes, line=table.crs_line)
    if table.heights_above_geoid and options.vertical is None and options.crs is None:
        message = "its heights are above a geoid that it does not name (geodetic): name it, e.g. EGM96"
        raise InputError(message, path=table.path, field="--vertical")
    if options.crs is None:
        assumed = table.assumed_crs or (WGS84 if table.geographic else None)
        if assumed is None:
            raise InputError("columns x,y,z need their CRS: give --crs, e.g. --crs EPSG:32632", path=table.path)
        what = "latitude and longitude" if table.geographic else "coordinates"
        notes.assume(f"{what} in {table.path.name} are WGS84 ({assumed})")
        crs = parse_crs(assumed, vertical=options.vertical)
        _note_own_heights(crs, table.path, options, notes)
        return crs
    crs = parse_crs(options.crs, vertical=options.vertical, field="--crs")
    if table.geographic and not crs.is_geographic:
        message = f"{table.path.name} has latitude and longitude, but {crs.name} has none"
        raise InputError(message, field="--crs")
    if _contradicts(crs, options):
        message = f"contradicts --crs {crs.name}, whose heights are {crs.vertical.name}"
        raise InputError(message, field="--vertical")
    return crs


def note_operation(crs: PointCrs, lla: FloatArray, notes: Notes) -> None:
    """Record how well the way from a CRS to WGS84 is known at points `lla` (N, 3), where that may matter."""
    if not len(lla):
        return
    operation = crs.operation(lla)
    if operation.accuracy_m is None or operation.accuracy_m >= 0.5:
        accuracy = "an unknown accuracy" if operation.accuracy_m is None else f"{operation.accuracy_m:g} m"
        notes.assume(f"{crs.name} is brought to WGS84 by “{operation.name}”, published with {accuracy}")
    if operation.missing_grids:
        notes.warn(f"{crs.name}: a better way to WGS84 needs the PROJ grid {', '.join(operation.missing_grids)}")
    if crs.height_unit != "metre":
        notes.assume(f"heights of {crs.name} are in {crs.height_unit}")


def _note_own_heights(crs: PointCrs, path: Path, options: IngestOptions, notes: Notes) -> None:
    if _contradicts(crs, options):
        notes.assume(
            f"heights of {path.name} are {crs.vertical.name}, as its CRS says; --vertical does not apply to them"
        )


def _contradicts(crs: PointCrs, options: IngestOptions) -> bool:
    """Return whether a CRS states another vertical datum than `--vertical`."""
    vertical = options.vertical
    return vertical is not None and crs.states_vertical and crs.vertical.name != vertical.name
