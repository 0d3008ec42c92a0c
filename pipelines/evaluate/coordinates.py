"""Positions of the report in a CRS that the user names: ENU → ECEF → CRS, point by point."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray, Vector3
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import ecef_from_enu, lla_from_ecef, lla_of
from pipelines.scene.report import CheckPointErrors, CheckPoints, Coordinates, PointCoordinates
from pipelines.scene.survey import Survey


def target_crs(text: str, survey: Survey) -> PointCrs:
    """Return the CRS in which to list positions of a survey.

    Args:
        text: name of the CRS, such as EPSG:32632.
        survey: its origin must lie within the area of the CRS.

    Raises:
        InputError: the text is not a CRS, the CRS is not for this place, or a grid that it needs is not installed.
    """
    crs = parse_crs(text, field="--crs")
    crs.xyz_from_lla(lla_of(survey.origin))
    return crs


def coordinates_in(crs: PointCrs, checkpoints: CheckPoints, survey: Survey) -> Coordinates:
    """Return each check point as surveyed and as measured, and the origin of `geo`, in a CRS.

    Args:
        crs: from `target_crs`.
        checkpoints: errors of the check points.
        survey: has the same check points, and the origin.

    Raises:
        InputError: a point lies outside the CRS's domain.
    """
    surveyed = np.array([point.position_in_geo for point in survey.check_points]).reshape(-1, 3)
    by_camera, by_model = (surveyed + _errors(way, surveyed) for way in (checkpoints.camera, checkpoints.model))
    # One call for all points, so that one operation transforms them all.
    in_geo = np.concatenate([np.zeros((1, 3)), surveyed, by_camera, by_model])
    known = np.isfinite(in_geo).all(axis=1)
    lla = lla_from_ecef(ecef_from_enu(in_geo[known], survey.origin))
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
        origin=_vector(xyz[0]),
        points=tuple(
            PointCoordinates(
                name=point.name,
                surveyed=_vector(surveyed_xyz),
                camera=_measured(camera_xyz),
                model=_measured(model_xyz),
            )
            for point, (surveyed_xyz, camera_xyz, model_xyz) in zip(survey.check_points, by_point, strict=True)
        ),
    )


def _errors(checkpoints: CheckPointErrors | None, surveyed: FloatArray) -> FloatArray:
    """Return the errors (J, 3), measured minus surveyed, in metres; NaN: not measured."""
    if checkpoints is None:
        return np.full_like(surveyed, np.nan)
    errors = [(row.de_m, row.dn_m, row.du_m) for row in checkpoints.points]
    return np.array(errors, dtype=np.float64).reshape(-1, 3)  # None becomes NaN


def _measured(xyz: FloatArray) -> Vector3 | None:
    return _vector(xyz) if np.isfinite(xyz).all() else None


def _vector(xyz: FloatArray) -> Vector3:
    x, y, z = xyz.tolist()
    return x, y, z
