"""Place of the survey on Earth, with coordinates as text."""

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geodesy.operations import Operation
from pipelines.report.page import Picture, picture_of_png
from pipelines.report.plots.plans import MapCoordinates, NamedPlaces, site_plan
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs

Texts = tuple[str, str, str]


def axis_names(crs: TargetCrs) -> Texts:
    """Return the names of the three coordinates, easting or longitude first."""
    first, second = crs.axes
    return first, second, "z" if crs.origin is None else f"height ({crs.crs.vertical.name})"


def map_coordinates(crs: TargetCrs) -> MapCoordinates:
    """Return the coordinates that the axes of a map state, at the height of the origin."""
    return MapCoordinates(
        crs.crs.name if crs.origin is not None else "local frame",
        crs.axes,
        crs.crs.short_units[0],
        lambda place: crs.xyz_from_geo(np.column_stack([place, np.zeros(len(place))]))[:, :2],
    )


def heads_of(crs: TargetCrs) -> Texts:
    """Return the heads of the three coordinates' columns: axis and unit."""
    axes = zip(axis_names(crs), crs.crs.short_units, strict=True)
    first, second, third = (f"{axis} in {unit}" for axis, unit in axes)
    return first, second, third


def texts_of(crs: TargetCrs, point_in_geo: FloatArray) -> list[Texts]:
    """Return coordinates of points (N, 3) in `geo` as text; an InputError: one is outside the domain of the CRS."""
    if not len(point_in_geo):
        return []
    first, second, third = crs.crs.short_units
    return [
        (coordinate(x, first), coordinate(y, second), coordinate(z, third))
        for x, y, z in crs.xyz_from_geo(point_in_geo).tolist()
    ]


def coordinate(value: float, unit: str) -> str:
    """Return a coordinate as text: 1e-7° is 1 cm, other units have three decimals."""
    return f"{value:.{7 if unit == '°' else 3}f}".replace("-", "−")


_MOST_DOTS = 12_000


@dataclass(frozen=True)
class AxisExtent:
    """Extent of the survey along one axis of a CRS."""

    name: str
    low: str
    high: str
    unit: str


@dataclass(frozen=True)
class PlaceFacts:
    """Place of a survey; its extent is that of scene and cameras, on the WGS84 ellipsoid and in the CRS.

    In a local metric frame, the extent on the ellipsoid is empty.

    The operation is that between WGS84 and the CRS; the ground size is that of the scene along east and north.
    """

    survey: Survey
    crs: TargetCrs
    operation: Operation
    plan: Picture
    geographic: tuple[AxisExtent, ...]
    projected: tuple[AxisExtent, ...]
    ground_size_m: tuple[float, float]


def place_facts(survey: Survey, solution: Solution, scene: FloatArray, crs: TargetCrs) -> PlaceFacts:
    """Return what the section on the place shows, of a scene (N, 3) in `geo`: extents, size in metres, plan."""
    center = solution.center_in_geo
    everything = np.concatenate([scene, center])
    geographic: tuple[AxisExtent, ...] = ()
    if survey.origin is not None:
        lla = lla_from_enu(everything, survey.origin)
        lla[:, 1] -= 360.0 * np.round((lla[:, 1] - lla[0, 1]) / 360.0)
        names = ("longitude", "latitude", "ellipsoidal height")
        geographic = _axes(names, ("°", "°", "m"), lla[:, [1, 0, 2]])
    xyz = crs.xyz_from_geo(everything)
    size = np.ptp(scene, axis=0).tolist() if len(scene) else [0.0, 0.0, 0.0]
    plan = site_plan(
        center[solution.indices("train"), :2],
        center[solution.indices("test"), :2],
        named_places(survey.control_points),
        named_places(survey.check_points),
        scene[:: max(1, len(scene) // _MOST_DOTS), :2],
        map_coordinates(crs),
    )
    return PlaceFacts(
        survey=survey,
        crs=crs,
        operation=crs.operation(),
        plan=picture_of_png(plan),
        geographic=geographic,
        projected=_axes(axis_names(crs), crs.crs.short_units, xyz),
        ground_size_m=(size[0], size[1]),
    )


def named_places(points: tuple[SurveyedPoint, ...]) -> NamedPlaces:
    """Return the plan positions (N, 2) of surveyed points in `geo`, in metres, with their names."""
    plan = np.array([point.position_in_geo for point in points]).reshape(-1, 3)[:, :2]
    return NamedPlaces(plan, [point.name for point in points])


def _axes(names: tuple[str, ...], units: tuple[str, ...], values: FloatArray) -> tuple[AxisExtent, ...]:
    low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
    return tuple(
        AxisExtent(name, coordinate(first, unit), coordinate(last, unit), unit)
        for name, unit, first, last in zip(names, units, low, high, strict=True)
    )
