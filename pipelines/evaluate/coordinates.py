"""Positions of the report in a CRS that the user names, and its tables of points and cameras for other programs."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.core.files import replace_text
from pipelines.core.types import FloatArray, Vector3, vector3
from pipelines.formats.tables import table_text
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import lla_from_enu, lla_of
from pipelines.survey.headline import PointLine, point_lines
from pipelines.survey.report import CheckPoints, Coordinates, EvaluationReport, PointCoordinates, PointResidual
from pipelines.survey.survey import Survey


def report_crs(text: str, survey: Survey) -> PointCrs:
    """Return the CRS, such as EPSG:32632, in which to list positions of a survey.

    Raises:
        InputError: the text is not a CRS, the CRS is not for this place, or a grid that it needs is not installed.
    """
    crs = parse_crs(text, field="--crs")
    crs.xyz_from_lla(lla_of(survey.origin_on_earth))
    return crs


def coordinates_in(crs: PointCrs, checkpoints: CheckPoints, survey: Survey) -> Coordinates:
    """Return each check point as surveyed and as measured, and the origin of `geo`, in a CRS.

    Raises:
        InputError: a point lies outside the CRS's domain.
    """
    surveyed = np.array([point.position_in_geo for point in survey.check_points]).reshape(-1, 3)
    unmeasured = np.full_like(surveyed, np.nan)
    ways = (checkpoints.triangulated, checkpoints.surface)
    measured = [surveyed + (unmeasured if way is None else error_array(way.points)) for way in ways]
    # One call for all points, so that one operation transforms them all.
    in_geo = np.concatenate([np.zeros((1, 3)), surveyed, *measured])
    known = np.isfinite(in_geo).all(axis=1)
    lla = lla_from_enu(in_geo[known], survey.origin_on_earth)
    xyz = np.full(in_geo.shape, np.nan)
    xyz[known] = crs.xyz_from_lla(lla)
    operation = crs.operation(lla)
    by_point = np.swapaxes(xyz[1:].reshape(3, len(surveyed), 3), 0, 1)
    return Coordinates(
        crs=crs.name,
        units=crs.units,
        heights=crs.vertical.name,
        operation=operation.name,
        operation_accuracy_m=operation.accuracy_m,
        origin=vector3(xyz[0]),
        points=tuple(
            PointCoordinates(
                name=point.name,
                surveyed=vector3(surveyed_xyz),
                triangulated=_measured(triangulated_xyz),
                surface=_measured(surface_xyz),
            )
            for point, (surveyed_xyz, triangulated_xyz, surface_xyz) in zip(
                survey.check_points, by_point, strict=True
            )
        ),
    )


def error_array(rows: Sequence[PointResidual]) -> FloatArray:
    """Return errors (J, 3), measured minus surveyed, in metres; NaN: not measured."""
    errors = [(row.de_m, row.dn_m, row.du_m) for row in rows]
    return np.array(errors, dtype=np.float64).reshape(-1, 3)  # None becomes NaN


def _measured(xyz: FloatArray) -> Vector3 | None:
    return vector3(xyz) if np.isfinite(xyz).all() else None


_NAME = ("name", "use", "measured", "rays")
_PLACE = ("latitude_deg", "longitude_deg", "ellipsoidal_height_m", "east_m", "north_m", "up_m")
_ERROR = ("de_m", "dn_m", "du_m", "dh_m", "d3_m", "sigma_e_m", "sigma_n_m", "sigma_u_m", "blunder")
_IN_CRS = ("crs", "x", "y", "z", "x_measured", "y_measured", "z_measured")


def write_point_table(path: Path, report: EvaluationReport, survey: Survey) -> None:
    """Write one line for each point and way in which it was measured; what is not known stays empty.

    Columns latitude to up have the surveyed position. With `--crs`, check points have coordinates in it too.
    """
    points, in_crs = (*survey.control_points, *survey.check_points), report.coordinates
    in_geo = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    lla = lla_from_enu(in_geo, survey.origin_on_earth) if points else in_geo
    place = {
        point.name: (f"{lat:.9f}", f"{lon:.9f}", f"{alt:.4f}", *(f"{value:.4f}" for value in enu))
        for point, (lat, lon, alt), enu in zip(points, lla.tolist(), in_geo.tolist(), strict=True)
    }
    header = (*_NAME, *_PLACE, *_ERROR, *(_IN_CRS if in_crs is not None else ()))
    rows = (
        (row.name, line.use, line.way, row.rays, *place[row.name], *_error(line), *_crs_cells(in_crs, line))
        for line in point_lines(report)
        for row in (line.row,)
    )
    replace_text(path, table_text((header, *rows)))


def write_camera_sigma(path: Path, names: Sequence[str], cov: FloatArray) -> None:
    """Write one line for each camera: σ of its position and of its rotations, along east, north and up.

    The covariance (n, 6, 6) is of (δθ [rad], δc [m]).
    """
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    header = ("name", *(f"sigma_{axis}_m" for axis in "enu"), *(f"sigma_rotation_{axis}_deg" for axis in "enu"))
    rows = (
        (name, *(f"{value:.5f}" for value in (*of_camera[3:], *np.degrees(of_camera[:3]))))
        for name, of_camera in zip(names, sigma, strict=True)
    )
    replace_text(path, table_text((header, *rows)))


def _error(line: PointLine) -> list[str]:
    error, sigma = line.row.error_m, line.sigma_m
    lengths = () if error is None else (*error, math.hypot(*error[:2]), math.hypot(*error))
    cells = [f"{value:.4f}" for value in lengths] or [""] * 5
    cells += [""] * 3 if sigma is None else [f"{value:.4f}" for value in sigma]
    return [*cells, "" if line.way == "fit" else str(int(line.is_blunder))]


def _crs_cells(coordinates: Coordinates | None, line: PointLine) -> list[str]:
    """Return the cells of a point in the CRS; empty for a point that the report does not list there."""
    if coordinates is None:
        return []
    point = next((point for point in coordinates.points if point.name == line.row.name), None)
    if point is None or line.use != "check":
        return [""] * len(_IN_CRS)
    measured = point.triangulated if line.way == "triangulated" else point.surface
    texts = coordinates.texts(point.surveyed), coordinates.texts(measured)
    return [coordinates.crs, *texts[0], *texts[1]]
