"""Reference systems of the input files: which one a file's coordinates are in, and what is said of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.ground_points import GroundPoints
from pipelines.formats.tables import refuse_first
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import HEIGHT_REMEDY, impossible_heights
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks
from pipelines.survey.survey import UsedTransformation

_LEAST_SIGMA_M = 0.02  # from which the accuracy of a transformation is a caution

_ALIKE_UNITS = 1e-5  # the foot and the US survey foot are 2e-6 apart, and headers do not tell them apart


def crs_of_table(table: PoseTable, options: IngestOptions, remarks: Remarks) -> PointCrs:
    """Return the CRS of a table of poses: its own, else that of `--crs`, else the one of its kind of file.

    Raises:
        InputError: no CRS for x,y,z columns, heights above a geoid that nobody names, or options that do
            not fit the table or each other.
    """
    path = table.path
    if table.crs_text is not None:
        crs = parse_crs(table.crs_text, vertical=options.vertical, path=path, line=table.crs_line)
        return _crs_of_file(crs, path, options, remarks)
    if options.crs is not None:
        crs = _given(options.crs, "--crs", table, options)
        if _excludes(crs, options):
            raise InputError(
                "vertical-against-crs",
                f"--vertical {options.vertical} does not fit --crs {crs.name}, whose heights are "
                f"{crs.vertical.name}.",
                field="--vertical",
            )
        _require_geoid(table, crs, options)
        return crs
    _require_geoid(table, None, options)
    assumed = table.assumed_crs or (WGS84 if table.geographic else None)
    if assumed is None:
        raise InputError(
            "crs-missing",
            "The columns x,y,z need a CRS.",
            path=path,
            remedy="Give it with --crs, e.g. --crs EPSG:32632.",
        )
    what = "latitude and longitude" if table.geographic else "coordinates"
    remarks.assume("crs-assumed", f"The {what} in {path.name} are WGS84 ({assumed}).")
    return _crs_of_file(parse_crs(assumed, vertical=options.vertical), path, options, remarks)


def crs_of_points(listed: GroundPoints, options: IngestOptions, remarks: Remarks) -> PointCrs:
    """Return the CRS of ground points: that of their file, else `--gcp-crs`, else WGS84 for latitude and longitude.

    Raises:
        InputError: the CRS is none, or none is named.
    """
    path = listed.path
    if listed.crs_text is not None:
        if options.gcp_crs is not None:
            remarks.assume("gcp-crs-unused", f"{path.name} states its CRS.", "--gcp-crs does not apply to it.")
        crs = parse_crs(listed.crs_text, vertical=options.vertical, path=path, line=listed.crs_line)
        return _crs_of_file(crs, path, options, remarks)
    if options.gcp_crs is not None:
        crs = _given(options.gcp_crs, "--gcp-crs", listed, options)
        _require_geoid(listed, crs, options)
        return crs
    if not listed.geographic:
        message = f"{path.name} states no CRS."
        remedy = "Give it, e.g. --gcp-crs EPSG:32632 or --gcp-crs EPSG:4326."
        raise InputError("crs-missing", message, field="--gcp-crs", remedy=remedy)
    _require_geoid(listed, None, options)
    assumed = listed.assumed_crs or WGS84
    remarks.assume("crs-assumed", f"The latitude and longitude in {path.name} are WGS84 ({assumed}).")
    return _crs_of_file(parse_crs(assumed, vertical=options.vertical), path, options, remarks)


def is_projected(text: str | None, flag: str) -> bool:
    """Return whether an option names a CRS with eastings and northings."""
    return text is not None and not parse_crs(text, field=flag).is_geographic


def note_unread(listed: PoseTable | GroundPoints, remarks: Remarks) -> None:
    """Note the columns of coordinates that are not read, since others of the table say the same."""
    if listed.unread_columns:
        remarks.assume(
            "columns-unread",
            f"{listed.path.name} states places more than once: {', '.join(listed.unread_columns)} are not read.",
        )


def in_units_of(crs: PointCrs, xyz: FloatArray, listed: PoseTable | GroundPoints) -> FloatArray:
    """Return coordinates (N, 3) with the heights in the unit of the CRS, where the header states another one.

    Raises:
        InputError: the header states another unit of x and y than the CRS has.
    """
    crs_unit_m = None if crs.is_geographic or crs.is_geocentric else crs.horizontal_unit
    if (
        listed.plan_unit_m is not None
        and crs_unit_m is not None
        and abs(listed.plan_unit_m / crs_unit_m - 1.0) > _ALIKE_UNITS
    ):
        raise InputError(
            "unit-against-crs",
            (
                f"The header says that x and y are in units of {listed.plan_unit_m:g} m, but {crs.name} counts "
                f"in {crs.units[0]} ({crs_unit_m:g} m)."
            ),
            path=listed.path,
            remedy="Correct the header, or name the right CRS.",
        )
    if listed.height_unit_m is None:
        return xyz
    return np.asarray(xyz * np.array([1.0, 1.0, listed.height_unit_m / crs.height_unit_m]))


def _require_geoid(listed: PoseTable | GroundPoints, crs: PointCrs | None, options: IngestOptions) -> None:
    """Refuse heights above a geoid that neither the file nor its CRS nor an option names."""
    if listed.heights_above_geoid and options.vertical is None and not (crs is not None and crs.states_vertical):
        raise InputError(
            "geoid-not-named",
            "The heights are above a geoid that the file does not name (geodetic, orthometric).",
            path=listed.path,
            field="--vertical",
            remedy="Name it, e.g. --vertical EGM96.",
        )


def _given(text: str, flag: str, listed: PoseTable | GroundPoints, options: IngestOptions) -> PointCrs:
    crs = parse_crs(text, vertical=options.vertical, field=flag)
    if listed.geographic and not crs.is_geographic:
        message = f"{listed.path.name} has latitude and longitude, but {crs.name} has none."
        raise InputError("crs-not-geographic", message, field=flag)
    return crs


def east_first(listed: GroundPoints, crs: PointCrs, remarks: Remarks) -> FloatArray:
    """Return coordinates (J, 3) with the easting or longitude first; the order that was assumed is noted."""
    xyz = np.array([point.xyz for point in listed.points]).reshape(-1, 3)
    first, second = ("latitude", "longitude") if crs.is_geographic else ("northing", "easting")
    if listed.in_order_of_crs:
        order = (first, second) if crs.northing_first else (second, first)
        remarks.assume(
            "axis-order",
            f"{listed.path.name} has no header: the {order[0]} stands before the {order[1]}, as in the definition "
            f"of {crs.name}.",
        )
        return xyz[:, [1, 0, 2]] if crs.northing_first else xyz
    if crs.northing_first and not listed.geographic and not crs.is_geographic:
        remarks.assume(
            "axis-order", f"The x in {listed.path.name} is the easting, although {crs.name} has the northing first."
        )
    return xyz


def require_heights(lla: FloatArray, path: Path, lines: Sequence[int]) -> None:
    """Raise an InputError for the first of points `lla` (N, 3) that is higher or lower than anybody flies."""

    def message(row: int) -> str:
        return f"The height of {lla[row, 2]:.0f} m is impossible: {HEIGHT_REMEDY}"

    refuse_first(
        impossible_heights(lla[:, 2]), "height-impossible", message, path=path, lines=lines, field="height"
    )


def note_operation(
    crs: PointCrs,
    lla: FloatArray,
    path: Path,
    of: Literal["positions", "control points", "check points"],
    remarks: Remarks,
) -> None:
    """Record the way from a CRS to WGS84 at points `lla` (N, 3) of a file, and how well it is known.

    An accuracy that enters the σ is a caution, which names the grid that would do better.
    """
    if not len(lla):
        return
    operation = crs.operation(lla)
    remarks.transformations.append(
        UsedTransformation(
            of=of,
            file=path.name,
            crs=crs.name,
            operation=operation.name,
            accuracy_m=operation.accuracy_m,
            sigma_m=operation.sigma_m,
            missing_grids=operation.missing_grids,
        )
    )
    if operation.sigma_m >= _LEAST_SIGMA_M:
        grids = ", ".join(operation.missing_grids)
        better = f" A better one needs the PROJ grid {grids}." if grids else ""
        remarks.caution(
            "transformation-accuracy",
            f"The {of} of {path.name} come from {crs.name} to WGS84 by “{operation.name}”, published with an "
            f"accuracy of {operation.accuracy_m:g} m: an error common to all of them, which the σ include, and "
            f"which points of the same CRS do not show.{better}",
            "`pyproj sync --file NAME` installs it." if grids else "",
        )
    if operation.accuracy_m is None or operation.accuracy_m >= 0.5:
        accuracy = (
            "an unknown accuracy" if operation.accuracy_m is None else f"an accuracy of {operation.accuracy_m:g} m"
        )
        remarks.assume(
            "crs-transformation",
            f"{crs.name} is transformed to WGS84 by “{operation.name}”, published with {accuracy}.",
        )
    if operation.missing_grids:
        remarks.warn(
            "better-grid-missing",
            f"A better transformation of {crs.name} to WGS84 needs the PROJ grid "
            f"{', '.join(operation.missing_grids)}.",
            "`pyproj sync --file NAME` installs it.",
        )
    if crs.height_unit != "metre":
        remarks.assume("height-unit", f"Heights of {crs.name} are in {crs.height_unit}.")


def _crs_of_file(crs: PointCrs, path: Path, options: IngestOptions, remarks: Remarks) -> PointCrs:
    """Return the CRS that a file has; what its name is read as, and an unused `--vertical`, are noted."""
    if crs.read_as is not None:
        remarks.assume("crs-by-name", f"The CRS {crs.name!r} of {path.name} is read as {crs.read_as}.")
    if _excludes(crs, options):
        remarks.assume(
            "vertical-unused",
            f"Heights of {path.name} are {crs.vertical.name}, as its CRS says.",
            "--vertical does not apply to them.",
        )
    return crs


def _excludes(crs: PointCrs, options: IngestOptions) -> bool:
    """Return whether a CRS states another vertical datum than `--vertical`."""
    vertical = options.vertical
    return vertical is not None and crs.states_vertical and crs.vertical.name != vertical.name
