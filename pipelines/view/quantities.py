"""Quantities of measured points with their σ, from the joint covariance of the points.

Points share the errors of similarity, cameras and lens. In a difference, what shifts both points cancels: only a
joint covariance gives the σ of a distance.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from scipy.spatial import Delaunay

from pipelines.core.types import FloatArray, IntArray
from pipelines.survey.saved_measurements import Quantity

RimBase = Literal["plane", "mean", "lowest"]


@dataclass(frozen=True)
class PickedPoints:
    """J measured points."""

    position_in_geo: FloatArray  # (J, 3) metres
    cov_in_geo: FloatArray | None  # (3 J, 3 J) m², joint; None: nothing states it
    # (J,) heights in the vertical datum of the CRS, in metres. Those of `geo` depart from them by d²/2R, 8 cm at a
    # distance of 1 km
    height_m: FloatArray


def distances(points: PickedPoints) -> tuple[Quantity, ...]:
    """Return distance in space, horizontal distance and height difference from the first point to the second."""
    line = points.position_in_geo[1] - points.position_in_geo[0]
    rise = float(points.height_m[1] - points.height_m[0])
    plan, up = np.array([*line[:2], 0.0]), np.array([0.0, 0.0, 1.0])
    lengths = (
        ("distance", float(np.linalg.norm(line)), _unit(line)),
        ("horizontal distance", float(np.linalg.norm(plan)), _unit(plan)),
        ("height difference", rise, up),
    )
    return tuple(
        Quantity(name, value, propagated(np.stack([-along, along]), points.cov_in_geo), "m")
        for name, value, along in lengths
    )


def length(points: PickedPoints) -> tuple[Quantity, ...]:
    """Return the length of the line through the points, in space and in plan."""
    legs, cov = np.diff(points.position_in_geo, axis=0), points.cov_in_geo
    in_plan = legs * [1.0, 1.0, 0.0]
    whole, plan = (float(np.linalg.norm(each, axis=1).sum()) for each in (legs, legs[:, :2]))
    return (
        Quantity("length", whole, propagated(_along(legs), cov), "m"),
        Quantity("horizontal length", plan, propagated(_along(in_plan), cov), "m"),
    )


def plan_area(points: PickedPoints) -> Quantity:
    """Return the horizontal area of the polygon of the points, in either direction."""
    area, gradient = _area(points)
    return Quantity("horizontal area", area, propagated(gradient, points.cov_in_geo), "m²")


def propagated(gradient: FloatArray, cov: FloatArray | None) -> float | None:
    """Return σ of a quantity with a gradient (J, 3), from a joint covariance (3 J, 3 J); None without one."""
    if cov is None:
        return None
    flat = gradient.ravel()
    return float(np.sqrt(max(float(flat @ cov @ flat), 0.0)))


def _along(legs: FloatArray) -> FloatArray:
    """Return the derivative (J, 3) of the sum of the lengths of legs (J − 1, 3)."""
    size = np.linalg.norm(legs, axis=1, keepdims=True)
    unit = np.divide(legs, size, out=np.zeros_like(legs), where=size > 0)
    gradient = np.zeros((len(legs) + 1, 3))
    gradient[:-1] -= unit
    gradient[1:] += unit
    return gradient


def _unit(vector: FloatArray) -> FloatArray:
    size = float(np.linalg.norm(vector))
    return np.asarray(vector / size if size > 0 else np.zeros_like(vector))


@dataclass(frozen=True)
class SampledSurface:
    """Surface within a polygon, sampled on a grid in plan."""

    corners: PickedPoints  # of the polygon
    samples: FloatArray  # N points of the surface, without covariance
    sigma_up_m: FloatArray  # (N,) σ of the samples' own heights, independent of each other
    # (3 (J + M), 3 (J + M)) m², joint, of the corners and of those M samples that `chosen` names, without the
    # samples' own errors; None: nothing states it
    cov_in_geo: FloatArray | None
    chosen: IntArray  # (M,) rows of the samples in that covariance
    pixel_m: float  # width of a training pixel


def surface_area(surface: SampledSurface) -> Quantity:
    """Return the area of the surface within the polygon, as smooth as the spacing of its samples.

    Its part above the horizontal area is the mean of sec(slope) over the triangles of neighbouring samples. Its
    relative σ is that of the horizontal area.
    """
    plan, samples, stretch = plan_area(surface.corners), surface.samples, 1.0
    if len(samples) >= 3:
        triangles = samples[Delaunay(samples[:, :2]).simplices]
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        stretch = float(np.linalg.norm(normal, axis=1).sum() / np.abs(normal[:, 2]).sum())
    sigma = None if plan.sigma is None else plan.sigma * stretch
    return Quantity("area on the surface", plan.value * stretch, sigma, "m²")


@dataclass(frozen=True)
class VolumeBase:
    """Base of a volume at N samples, as heights in `geo`.

    Attributes:
        height_m: (N,) heights; NaN: the base is not known there.
        by_corner: (N, J) their derivatives by the heights of the corners.
        sigma_m: σ that all of these heights share, beside that of the corners.
    """

    height_m: FloatArray
    by_corner: FloatArray
    sigma_m: float = 0.0


def rim_base(kind: RimBase, corners: FloatArray, places: FloatArray) -> VolumeBase:
    """Return the base that the corners (J, 3) of a polygon give at places (N, 2), east and north."""
    if kind == "plane":
        middle = corners[:, :2].mean(axis=0)
        design = np.column_stack([np.ones(len(corners)), corners[:, :2] - middle])
        by_corner = np.column_stack([np.ones(len(places)), places - middle]) @ np.linalg.pinv(design)
    else:
        share = np.full(len(corners), 1 / len(corners))
        if kind == "lowest":
            share = np.eye(len(corners))[int(np.argmin(corners[:, 2]))]
        by_corner = np.tile(share, (len(places), 1))
    return VolumeBase(by_corner @ corners[:, 2], by_corner)


# Training pixels by which the surface as a whole may stand too high or too low, by a simulated flight (clicks.py).
_SURFACE_BIAS_PX = 0.02


def volumes(surface: SampledSurface, base: VolumeBase) -> tuple[Quantity, ...]:
    """Return the volume between surface and base: above, below, and their difference.

    σ is that of corners and samples jointly, of the surface as a whole, and of the sampling: half the difference
    between the volumes of the white and of the black samples of the grid, if that is a chequerboard. Of the parts,
    only samples on their side of the base count.
    """
    area, area_gradient = _area(surface.corners)
    above = surface.samples[:, 2] - base.height_m
    columns, rows = (np.unique(axis, return_inverse=True)[1] for axis in np.round(surface.samples[:, :2].T, 3))
    white = (columns + rows) % 2 == 0
    corners = len(surface.corners.position_in_geo)

    def quantity(name: str, part: FloatArray, sign: float) -> Quantity:
        """Return the volume of the samples of which `part` is the share (N,) that counts, with its σ."""
        heights = sign * above * part
        value = area * float(heights.mean())
        gradient = np.zeros((corners + len(surface.chosen), 3))
        gradient[:corners, 2] = -sign * area * (base.by_corner * part[:, None]).mean(axis=0)
        gradient[:corners] += area_gradient * float(heights.mean())
        gradient[corners:, 2] = sign * area / len(surface.chosen) * part[surface.chosen]
        of_points = propagated(gradient, surface.cov_in_geo)
        if of_points is None:
            return Quantity(name, value, None, "m³")
        of_noise = area / len(above) * float(np.linalg.norm(surface.sigma_up_m * part))
        of_whole = area * float(part.mean()) * float(np.hypot(_SURFACE_BIAS_PX * surface.pixel_m, base.sigma_m))
        of_sampling = 0.0
        if white.any() and not white.all():
            of_sampling = area * abs(float(heights[white].mean() - heights[~white].mean())) / 2
        return Quantity(
            name, value, float(np.sqrt(of_points**2 + of_noise**2 + of_whole**2 + of_sampling**2)), "m³"
        )

    return (
        quantity("volume above the base", (above > 0).astype(np.float64), 1.0),
        quantity("volume below the base", (above < 0).astype(np.float64), -1.0),
        quantity("volume", np.ones(len(above)), 1.0),
    )


@dataclass(frozen=True)
class Profile:
    """Surface along a line: N places from its beginning on.

    Attributes:
        along_m: (N,) distance in plan from the beginning.
        height: (N,) in the unit of the CRS's heights; NaN: not measured.
        sigma_m: (N,) of georeference and surface; NaN: not known.
        xy: (N, 2) in the CRS.
    """

    along_m: FloatArray
    height: FloatArray
    sigma_m: FloatArray
    xy: FloatArray


def along_line(corners: FloatArray, spacing_m: float) -> tuple[FloatArray, FloatArray]:
    """Return places (N, 2) on a line through corners (J, 2), and their distance (N,) from its beginning."""
    legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    end = np.concatenate([[0.0], np.cumsum(legs)])
    along = np.linspace(0.0, end[-1], max(round(float(end[-1]) / spacing_m), 1) + 1)
    return np.column_stack([np.interp(along, end, axis) for axis in corners.T]), along


def grid_in_polygon(corners: FloatArray, spacing: float) -> FloatArray:
    """Return the points (N, 2) of a grid that lie in a polygon (J, 2), which has either direction."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    count = np.maximum(np.ceil((high - low) / spacing).astype(int), 1)
    axes = [low[k] + (np.arange(count[k]) + 0.5) * (high[k] - low[k]) / count[k] for k in (0, 1)]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    return np.asarray(places[shapely.contains_xy(shapely.Polygon(corners), places)])


def _area(points: PickedPoints) -> tuple[float, FloatArray]:
    """Return the horizontal area of a polygon, and its derivative (J, 3) by the points."""
    east, north = (points.position_in_geo[:, axis] - points.position_in_geo[:, axis].mean() for axis in (0, 1))
    twice = float(east @ np.roll(north, -1) - north @ np.roll(east, -1))
    gradient = np.zeros((len(east), 3))
    gradient[:, 0] = (np.roll(north, -1) - np.roll(north, 1)) / 2
    gradient[:, 1] = (np.roll(east, 1) - np.roll(east, -1)) / 2
    return abs(twice) / 2, np.asarray(gradient * np.sign(twice))
