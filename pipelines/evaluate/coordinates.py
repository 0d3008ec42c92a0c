"""The report's positions in a CRS of the user's: ENU → ECEF → CRS, point by point."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import ecef_from_enu, lla_from_ecef, lla_of
from pipelines.scene.survey import Survey

_WAYS = ("camera", "model")


def target_crs(text: str, survey: Survey) -> PointCrs:
    """The CRS in which to list positions of a survey.

    Raises:
        InputError: not a CRS, one that is not for this place, or one that needs a grid that is not installed.
    """
    crs = parse_crs(text, field="--crs")
    crs.xyz_from_lla(lla_of(survey.origin))
    return crs


def in_crs(checkpoints: dict[str, Any], survey: Survey, crs: PointCrs) -> dict[str, Any]:
    """Each check point as surveyed and as measured, and the origin of `geo`, as easting, northing, height of `crs`.

    Args:
        checkpoints: of the report: `de_m`, `dn_m`, `du_m` of each point by camera and by model, null where it was
            not measured.
        survey: whose check points they are.
        crs: from `target_crs`.

    Raises:
        InputError: a point outside the CRS's domain.
    """
    surveyed = np.array([point.position_in_geo for point in survey.check_points]).reshape(-1, 3)
    found = {way: surveyed + _errors(checkpoints[way]["points"]) for way in _WAYS}
    # One call for all: one operation serves them all.
    in_geo = np.concatenate([np.zeros((1, 3)), surveyed, *found.values()])
    known = np.isfinite(in_geo).all(axis=1)
    lla = lla_from_ecef(ecef_from_enu(in_geo[known], survey.origin))
    xyz = np.full(in_geo.shape, np.nan)
    xyz[known] = crs.xyz_from_lla(lla)
    operation = crs.operation(lla)
    rows = dict(zip(("surveyed", *_WAYS), xyz[1:].reshape(-1, len(surveyed), 3), strict=True))
    return {
        "crs": crs.name,
        "units": list(crs.units),
        "heights": crs.vertical.name,
        "operation": operation.name,
        "operation_accuracy_m": operation.accuracy_m,
        "origin": _listed(xyz[0]),
        "points": [
            {"name": point.name, **{kind: _listed(rows[kind][j]) for kind in rows}}
            for j, point in enumerate(survey.check_points)
        ],
    }


def _errors(rows: list[dict[str, Any]]) -> FloatArray:
    """(J, 3) measured minus surveyed in metres; NaN where not measured."""
    values = [[np.nan if row[key] is None else row[key] for key in ("de_m", "dn_m", "du_m")] for row in rows]
    return np.array(values, dtype=np.float64).reshape(-1, 3)


def _listed(xyz: FloatArray) -> list[float] | None:
    return xyz.tolist() if np.isfinite(xyz).all() else None
