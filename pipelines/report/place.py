"""Place of the survey on Earth: plan, origin, extent, CRS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray, Vector3
from pipelines.geodesy.enu import ecef_from_enu, lla_from_ecef
from pipelines.pages.pictures import Picture, picture_of_png
from pipelines.plots.survey_plans import NamedPlaces, site_plan
from pipelines.report.coordinates import axes_of, coordinate, units_of
from pipelines.report.evaluated import EvaluatedSurvey
from pipelines.scene.survey import SurveyedPoint

_MOST_DOTS = 12_000


@dataclass(frozen=True)
class Axis:
    """Extent of the survey along one axis of a CRS."""

    name: str
    low: str
    high: str
    unit: str


@dataclass(frozen=True)
class PlaceFacts:
    """Place of a survey.

    Attributes:
        plan: of photographs and surveyed points.
        origin: latitude and longitude in degrees, ellipsoidal height in metres, of the frame `geo`.
        geographic: extent of scene and cameras on the WGS84 ellipsoid.
        projected: the same in the CRS of the report.
        crs, heights: names of CRS and vertical datum.
        operation: between WGS84 and the CRS, with its accuracy where that is published.
        operation_accuracy_m: None: not known.
        recorded_crs, recorded_heights: of the survey's input.
        heights_stated: whether the input stated its datum.
        assumed: what nobody stated of the CRS of the report.
        ground_size_m: extent of the scene along east and north.
    """

    plan: Picture
    origin: Vector3
    geographic: tuple[Axis, ...]
    projected: tuple[Axis, ...]
    crs: str
    heights: str
    operation: str
    operation_accuracy_m: float | None
    recorded_crs: str
    recorded_heights: str
    heights_stated: bool
    assumed: tuple[str, ...]
    ground_size_m: tuple[float, float]


def place_facts(evaluated: EvaluatedSurvey) -> PlaceFacts:
    """Return the place of an evaluated survey.

    Raises:
        InputError: the survey lies outside the domain of the CRS.
    """
    survey, crs = evaluated.solved.survey, evaluated.crs
    everything = np.concatenate([evaluated.scene_in_geo, evaluated.center_in_geo])
    lla = lla_from_ecef(ecef_from_enu(everything, survey.origin))
    lla[:, 1] -= 360.0 * np.round((lla[:, 1] - lla[0, 1]) / 360.0)
    xyz = crs.xyz_from_geo(everything)
    operation = crs.crs.operation(crs.lla)
    size = np.ptp(evaluated.scene_in_geo, axis=0).tolist() if len(evaluated.scene_in_geo) else [0.0, 0.0, 0.0]
    return PlaceFacts(
        plan=_plan(evaluated),
        origin=(survey.origin.lat_deg, survey.origin.lon_deg, survey.origin.alt_m),
        geographic=_axes(("longitude", "latitude", "ellipsoidal height"), ("°", "°", "m"), lla[:, [1, 0, 2]]),
        projected=_axes(axes_of(crs), units_of(crs), xyz),
        crs=crs.crs.name,
        heights=crs.crs.vertical.name,
        operation=operation.name,
        operation_accuracy_m=operation.accuracy_m,
        recorded_crs=survey.source_crs,
        recorded_heights=survey.vertical.name,
        heights_stated=survey.vertical.stated,
        assumed=crs.assumed,
        ground_size_m=(size[0], size[1]),
    )


def _plan(evaluated: EvaluatedSurvey) -> Picture:
    solved, center = evaluated.solved, evaluated.center_in_geo[:, :2]
    scene = evaluated.scene_in_geo
    step = max(1, len(scene) // _MOST_DOTS)
    png = site_plan(
        center[solved.indices("train")],
        center[solved.indices("test")],
        named_places(solved.survey.control_points),
        named_places(solved.survey.check_points),
        scene[::step, :2],
    )
    return picture_of_png(png)


def named_places(points: tuple[SurveyedPoint, ...]) -> NamedPlaces:
    """Return names and plan coordinates of surveyed points."""
    place = np.array([point.position_in_geo for point in points]).reshape(-1, 3)[:, :2]
    return NamedPlaces([point.name for point in points], place)


def _axes(names: tuple[str, ...], units: tuple[str, ...], values: FloatArray) -> tuple[Axis, ...]:
    low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
    return tuple(
        Axis(name, coordinate(first, unit), coordinate(last, unit), unit)
        for name, unit, first, last in zip(names, units, low, high, strict=True)
    )
