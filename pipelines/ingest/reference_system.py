"""Reference systems of the input files: which one a file's coordinates are in, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.ground_points import GroundPoints
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.operations import WGS84
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions


def crs_of_table(table: PoseTable, options: IngestOptions, notes: Notes) -> PointCrs:
    """Return the CRS of a table of poses: its own, else that of `--crs`, else the one of its kind of file.

    Raises:
        InputError: no CRS for x,y,z columns, heights above a geoid that nobody names, or options that contradict
            the table or each other.
    """
    path = table.path
    if table.crs_text is not None:
        crs = parse_crs(table.crs_text, vertical=options.vertical, path=path, line=table.crs_line)
        _note_own_heights(crs, path, options, notes)
        return crs
    if options.crs is not None:
        crs = parse_crs(options.crs, vertical=options.vertical, field="--crs")
        if table.geographic and not crs.is_geographic:
            raise InputError(
                "todo-has-latitude-longitude-but",
                f"{path.name} has latitude and longitude, but {crs.name} has none",
                field="--crs",
            )
        if _contradicts(crs, options):
            message = f"contradicts --crs {crs.name}, whose heights are {crs.vertical.name}"
            raise InputError("todo-x", message, field="--vertical")
        return crs
    if table.heights_above_geoid and options.vertical is None:
        message = "its heights are above a geoid that it does not name (geodetic): name it, e.g. EGM96"
        raise InputError("todo-x", message, path=path, field="--vertical")
    assumed = table.assumed_crs or (WGS84 if table.geographic else None)
    if assumed is None:
        raise InputError(
            "todo-columns-need-their-crs",
            "columns x,y,z need their CRS: give --crs, e.g. --crs EPSG:32632",
            path=path,
        )
    what = "latitude and longitude" if table.geographic else "coordinates"
    notes.assume("todo-wgs", f"{what} in {path.name} are WGS84 ({assumed})")
    crs = parse_crs(assumed, vertical=options.vertical)
    _note_own_heights(crs, path, options, notes)
    return crs


def crs_of_points(listed: GroundPoints, options: IngestOptions, notes: Notes) -> PointCrs:
    """Return the CRS of ground points: that of their file, else `--gcp-crs`, else WGS84 for latitude and longitude.

    Raises:
        InputError: the CRS is none, or none is named.
    """
    path = listed.path
    if listed.crs_text is not None:
        if options.gcp_crs is not None:
            notes.assume("todo-states-its-crs-gcp", f"{path.name} states its CRS; --gcp-crs does not apply to it")
        crs = parse_crs(listed.crs_text, vertical=options.vertical, path=path, line=listed.crs_line)
        _note_own_heights(crs, path, options, notes)
        return crs
    if options.gcp_crs is not None:
        crs = parse_crs(options.gcp_crs, vertical=options.vertical, field="--gcp-crs")
    elif listed.geographic:
        notes.assume("todo-latitude-longitude-wgs", f"latitude and longitude in {path.name} are WGS84 ({WGS84})")
        crs = parse_crs(WGS84, vertical=options.vertical)
    else:
        raise InputError(
            "todo-states-no-crs-give",
            f"{path.name} states no CRS: give it, e.g. EPSG:32632 or EPSG:4326",
            field="--gcp-crs",
        )
    if listed.geographic and not crs.is_geographic:
        raise InputError(
            "todo-has-latitude-longitude-but",
            f"{path.name} has latitude and longitude, but {crs.name} has none",
            field="--gcp-crs",
        )
    return crs


def east_first(listed: GroundPoints, crs: PointCrs, notes: Notes) -> FloatArray:
    """Return coordinates (J, 3) with the easting or longitude first; the order that was assumed is noted."""
    xyz = np.array([point.xyz for point in listed.points]).reshape(-1, 3)
    first, second = ("latitude", "longitude") if crs.is_geographic else ("northing", "easting")
    if listed.in_order_of_crs:
        order = (first, second) if crs.northing_first else (second, first)
        notes.assume(
            "todo-has-no-header-stands",
            f"{listed.path.name} has no header: the {order[0]} stands before the {order[1]}, as in the definition "
            f"of {crs.name}",
        )
        return xyz[:, [1, 0, 2]] if crs.northing_first else xyz
    if crs.northing_first and not listed.geographic and not crs.is_geographic:
        notes.assume(
            "todo-easting-although-has-northing",
            f"x in {listed.path.name} is the easting, although {crs.name} has the northing first",
        )
    return xyz


def note_operation(crs: PointCrs, lla: FloatArray, notes: Notes) -> None:
    """Record how well the way from a CRS to WGS84 is known at points `lla` (N, 3), where that may matter."""
    if not len(lla):
        return
    operation = crs.operation(lla)
    if operation.accuracy_m is None or operation.accuracy_m >= 0.5:
        accuracy = "an unknown accuracy" if operation.accuracy_m is None else f"{operation.accuracy_m:g} m"
        notes.assume(
            "todo-brought-wgs-by-published",
            f"{crs.name} is brought to WGS84 by “{operation.name}”, published with {accuracy}",
        )
    if operation.missing_grids:
        notes.warn(
            "todo-better-way-wgs-needs",
            f"{crs.name}: a better way to WGS84 needs the PROJ grid {', '.join(operation.missing_grids)}",
        )
    if crs.height_unit != "metre":
        notes.assume("todo-heights", f"heights of {crs.name} are in {crs.height_unit}")


def _note_own_heights(crs: PointCrs, path: Path, options: IngestOptions, notes: Notes) -> None:
    if _contradicts(crs, options):
        notes.assume(
            "todo-heights-its-crs-says",
            f"heights of {path.name} are {crs.vertical.name}, as its CRS says; --vertical does not apply to them",
        )


def _contradicts(crs: PointCrs, options: IngestOptions) -> bool:
    """Return whether a CRS states another vertical datum than `--vertical`."""
    vertical = options.vertical
    return vertical is not None and crs.states_vertical and crs.vertical.name != vertical.name
