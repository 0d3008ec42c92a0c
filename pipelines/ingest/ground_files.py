"""Files of ground points, each read as what its content shows it to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats import metashape_markers, metashape_reference, odm, pix4d
from pipelines.formats.delimited import is_number, separator_of, split
from pipelines.formats.ground_points import GroundPoints
from pipelines.formats.text import beginning
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.operations import WGS84
from pipelines.ingest.notes import Notes, shortened
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.reference_system import stated_crs


def read_ground_points(path: Path, notes: Notes) -> GroundPoints:
    """Read ground points; the kind of the file follows from its content, and is noted.

    1. XML: Metashape's markers.
    2. A line that begins with `#Label`: Metashape's reference.
    3. A first line of four or more cells between commas, semicolons or tabs: PIX4D's table of points.
    4. Anything else: OpenDroneMap's `gcp_list.txt`.

    Raises:
        InputError: the file cannot be read as what it seems to be.
    """
    head = beginning(path)
    lines = [line.strip() for line in head.splitlines() if line.strip()]
    if head.lstrip().startswith("<"):
        listed = metashape_markers.read_markers_xml(path)
    elif any(metashape_reference.HEADER.match(line) for line in lines):
        listed = metashape_reference.read_markers(path)
    elif _begins_a_table([line for line in lines if not line.startswith("#")], path):
        listed = pix4d.read_point_table(path)
    else:
        return odm.read_ground_points(path)
    notes.assume(f"{path.name} is read as {listed.kind}")
    notes.warn_counted(
        [f"{path.name} ({name})" for name in listed.unknown_columns],
        "column is unknown and was ignored",
        "columns are unknown and were ignored",
    )
    notes.warn_counted(
        list(listed.left_out),
        "mark is not pinned, so placed by Metashape itself, and was left out",
        "marks are not pinned, so placed by Metashape itself, and were left out",
    )
    checks = [point.name for point in listed.points if point.is_check]
    if checks:
        notes.assume(f"points that are not enabled in {path.name} are check points: {shortened(checks)}")
    return listed


def crs_of_points(listed: GroundPoints, options: IngestOptions, notes: Notes) -> PointCrs:
    """Return the CRS of ground points: that of their file, else `--gcp-crs`, else WGS84 for latitude and longitude.

    Raises:
        InputError: the CRS is none, or none is named.
    """
    path = listed.path
    if listed.crs_text is not None:
        if options.gcp_crs is not None:
            notes.assume(f"{path.name} states its CRS; --gcp-crs does not apply to it")
        return stated_crs(listed.crs_text, path, options, notes, line=listed.crs_line)
    if options.gcp_crs is not None:
        crs = parse_crs(options.gcp_crs, vertical=options.vertical, field="--gcp-crs")
    elif listed.geographic:
        notes.assume(f"latitude and longitude in {path.name} are WGS84 ({WGS84})")
        crs = parse_crs(WGS84, vertical=options.vertical)
    else:
        raise InputError(f"{path.name} states no CRS: give it, e.g. EPSG:32632 or EPSG:4326", field="--gcp-crs")
    if listed.geographic and not crs.is_geographic:
        raise InputError(f"{path.name} has latitude and longitude, but {crs.name} has none", field="--gcp-crs")
    return crs


def east_first(listed: GroundPoints, crs: PointCrs, notes: Notes) -> FloatArray:
    """Return coordinates (J, 3) with the easting or longitude first; the order that was assumed is noted."""
    xyz = np.array([point.xyz for point in listed.points]).reshape(-1, 3)
    first, second = ("latitude", "longitude") if crs.is_geographic else ("northing", "easting")
    if listed.in_order_of_crs:
        order = (first, second) if crs.northing_first else (second, first)
        notes.assume(
            f"{listed.path.name} has no header: the {order[0]} stands before the {order[1]}, as in the definition "
            f"of {crs.name}"
        )
        return xyz[:, [1, 0, 2]] if crs.northing_first else xyz
    if crs.northing_first and not listed.geographic and not crs.is_geographic:
        notes.assume(f"x in {listed.path.name} is the easting, although {crs.name} has the northing first")
    return xyz


def _begins_a_table(lines: list[str], path: Path) -> bool:
    """Return whether the first line is a row or header of a table, and not a CRS, which may have commas too."""
    if not lines or any(sign in lines[0] for sign in '["=+'):
        return False
    separator = separator_of(lines[0])
    cells = [] if separator is None else split(lines[0], separator, path=path, line=1)
    return len(cells) >= 4 and (all(map(is_number, cells[1:4])) or not any(map(is_number, cells)))
