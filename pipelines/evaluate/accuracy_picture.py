"""Picture of the predicted accuracy, with the errors of the surveyed points as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import Origin, ecef_from_enu, lla_from_ecef
from pipelines.plots.accuracy_map import MapPoints, NamedPlaces, SigmaRaster, write_accuracy_map
from pipelines.plots.map_marks import MapCoordinates
from pipelines.scene.report import EvaluationReport, PointResidual
from pipelines.scene.survey import SurveyedPoint
from pipelines.scene.trained_survey import SolvedSurvey


def draw_accuracy(
    grid: AccuracyGrid, solved: SolvedSurvey, report: EvaluationReport, crs: PointCrs | None, path: Path
) -> None:
    """Write a map of the predicted accuracy, with cameras, control and check points, errors and coordinates.

    Args:
        grid: predicted σ.
        solved: the survey.
        report: errors of triangulated points, and residuals of control points.
        crs: of the coordinates beside the map; None: longitude and latitude.
        path: of the picture.
    """
    survey = solved.survey
    raster = SigmaRaster(grid.raster(grid.sigma_h_m), grid.raster(grid.sigma_v_m), grid.corner_in_geo, grid.size_m)
    points = MapPoints(
        cameras=solved.geo_from_model.apply(solved.poses.cam_center_in_model)[:, :2],
        control=_named(survey.control_points, report.fit.gcp.points),
        check=_named(survey.check_points, report.checkpoints.camera.points),
    )
    write_accuracy_map(path, raster, points, _coordinates(survey.origin, crs))


def _named(points: Sequence[SurveyedPoint], rows: Sequence[PointResidual]) -> NamedPlaces:
    place = np.array([point.position_in_geo for point in points]).reshape(-1, 3)[:, :2]
    errors = np.array([(row.de_m, row.dn_m, row.du_m) for row in rows], dtype=np.float64)  # None becomes NaN
    return NamedPlaces(place, tuple(point.name for point in points), errors.reshape(-1, 3))


def _coordinates(origin: Origin, crs: PointCrs | None) -> MapCoordinates:
    """Return the coordinates of places at the height of the origin."""

    def lla(place: FloatArray) -> FloatArray:
        return lla_from_ecef(ecef_from_enu(np.column_stack([place, np.zeros(len(place))]), origin))

    if crs is None or crs.is_geocentric:
        return MapCoordinates("WGS84", ("longitude", "latitude"), "°", lambda place: lla(place)[:, [1, 0]])
    names = ("longitude", "latitude") if crs.is_geographic else ("easting", "northing")
    unit = "°" if crs.units[0] == "degree" else {"metre": "m"}.get(crs.units[0], crs.units[0])
    return MapCoordinates(crs.name, names, unit, lambda place: crs.xyz_from_lla(lla(place))[:, :2])
