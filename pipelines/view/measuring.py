"""Measuring in a trained model: points of its surface, their coordinates in a CRS, and σ of what they make up."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field
from scipy.linalg import block_diag

from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import InputError
from pipelines.core.products import is_checked, load_json
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.formats.geotiff import sampled_raster
from pipelines.surface.picking import SurfacePoint, SurfaceReader
from pipelines.surface.plan_heights import cameras_of, heights_in_plan
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.marks import MarkRays, triangulated_points
from pipelines.survey.options import CrsOptions
from pipelines.survey.saved_measurements import Quantity
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, usable_crs
from pipelines.view import quantities
from pipelines.view.pictures import ViewerCamera, ViewFrame

# Rasters of the workspace that may be the base of a volume, with those of their σ.
BASE_RASTERS = {"dtm.tif": "sigma_dtm.tif", "dsm.tif": "sigma_v.tif"}
_JOINT_SAMPLES = 40  # of the surface in a polygon, that enter the joint covariance
_LEAST_SPACING_PX = 4.0  # between samples: closer ones would show the surface's noise, not its shape
_PROFILE_REACH_PX = 1.5  # around a place of a profile
_LEAST_COVERED = 0.9  # of a polygon, by a base
# σ of a click along both axes of the page: of a hand that is off by a pixel at most, or by one as its own σ.
SIGMA_PX = 0.8
_STEP_PX = 2.0  # to both sides of a click, at which the surface is looked at
_STEEPEST = 6.0  # length on the surface over that across the line of sight, from which it is another surface


@dataclass(frozen=True)
class WantedBase:
    """Base of a volume, as pages ask for it: of the polygon's rim, a height in the CRS, or a raster."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    kind: Literal["plane", "mean", "lowest", "height", "raster"] = "plane"
    height: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    raster: Annotated[str, Field(max_length=60)] = ""


@dataclass(frozen=True)
class Fineness:
    """Number of places and of views that read each; `advance` is called with the share that is done."""

    places: int = 2000
    views: int = 12
    advance: Callable[[float], None] = lambda _share: None


ESTIMATE = Fineness(300, 3)  # a first answer in a second


class MeasuringModel:
    """Trained model of a workspace, to measure in.

    Attributes:
        posterior: covariances of the model; None: none are stated.
        without_sigma: why no σ is stated; empty: it is.

    Raises:
        MissingProductError: the model was stored without its covariances.
        InputError: a product is damaged, or the CRS cannot be used here.
    """

    def __init__(self, workspace: Workspace, survey: Survey, renderer: ModelRenderer, crs: CrsOptions) -> None:
        self._workspace, self.survey, self.solution = workspace, survey, renderer.model
        self.reader, self._center_in_geo = SurfaceReader(renderer), renderer.model.center_in_geo
        self.target: TargetCrs = usable_crs(crs, survey.origin, self._center_in_geo, survey.vertical)
        is_stated = is_checked(self.solution.cautions)
        self.posterior = posterior_of(workspace, self.solution, renderer.sfm) if is_stated else None
        self.without_sigma = "" if self.posterior is not None else "nothing checks the σ of the positions"

    def triangulated(self, rays: MarkRays) -> tuple[FloatArray, FloatArray | None]:
        """Return the intersection (3,) in `geo` of the marks of one point, and its covariance (3, 3) in m².

        The intersection is NaN with fewer than two marks; the covariance is None where none is stated.
        """
        position = triangulated_points(self.solution, rays)
        if self.posterior is None or not np.isfinite(position).all():
            return position[0], None
        absolute = self.posterior.datum - self.posterior.datum_against_points
        return position[0], self.posterior.of_marked_points(position, rays)[0] + absolute

    def coordinates(self, point: SurfacePoint) -> tuple[FloatArray, FloatArray | None]:
        """Return a point (3,) in the CRS, easting or longitude first, and its σ (3,) east, north, up in metres.

        σ is that of georeference, cameras, lens and surface; None: not known.
        """
        joint = self.jointly([point])
        sigma_m = None if joint.cov_in_geo is None else np.sqrt(np.diag(joint.cov_in_geo))
        return self.target.xyz_from_geo(point.position_in_geo[None])[0], sigma_m

    def jointly(self, points: Sequence[SurfacePoint]) -> quantities.PickedPoints:
        position = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
        cov = self._joint_covariance([*position], [point.cameras for point in points])
        cov = None if cov is None else cov + block_diag(*(point.cov_of_surface for point in points))
        height_m = np.asarray(self.target.xyz_from_geo(position)[:, 2] * self.target.crs.height_unit_m)
        return quantities.PickedPoints(position, cov, height_m)

    def area(self, corners: Sequence[SurfacePoint], fineness: Fineness) -> tuple[Quantity, ...]:
        """Return the area of a polygon, in plan and on the surface."""
        sampled = self._sampled(corners, fineness)
        if sampled is None:
            return (quantities.plan_area(self.jointly(corners)),)
        surface, coverage = sampled
        return quantities.plan_area(surface.corners), quantities.surface_area(surface), coverage

    def volume(self, corners: Sequence[SurfacePoint], base: WantedBase, fineness: Fineness) -> tuple[Quantity, ...]:
        """Return the volume between the surface within a polygon and a base; nothing where there is no surface.

        Raises:
            InputError: the raster of the base cannot be read, or does not cover the polygon.
        """
        sampled = self._sampled(corners, fineness)
        if sampled is None:
            return ()
        surface, coverage = sampled
        return (*quantities.volumes(surface, self._base(base, surface)), coverage)

    def profile(self, corners: Sequence[SurfacePoint], fineness: Fineness) -> quantities.Profile:
        """Return the surface along a line."""
        positions = np.array([point.position_in_geo for point in corners])
        pixel_m = self._pixel_m(corners)
        length_m = float(np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1).sum())
        plan, along_m = quantities.along_line(positions[:, :2], max(length_m / fineness.places, pixel_m))
        reach_m = max(float(along_m[1]) / 2, _PROFILE_REACH_PX * pixel_m)
        surface = heights_in_plan(
            self.reader.renderer, plan, float(np.median(positions[:, 2])), reach_m,
            most_views=fineness.views, advance=fineness.advance,
        )  # fmt: skip
        in_geo = np.column_stack([plan, np.where(surface.known, surface.height_m, np.median(positions[:, 2]))])
        xyz = self.target.xyz_from_geo(in_geo)
        sigma_m = np.full(len(plan), np.nan)
        if self.posterior is not None and self.posterior.grid is not None:
            sigma_m = np.hypot(np.sqrt(self.posterior.grid.cov_at(in_geo)[:, 2, 2]), surface.sigma_m)
        return quantities.Profile(along_m, np.where(surface.known, xyz[:, 2], np.nan), sigma_m, xyz[:, :2])

    def rasters(self) -> list[str]:
        """Return the rasters of heights in the workspace that may be the base of a volume."""
        return [name for name in BASE_RASTERS if (self._workspace.root / "raster" / name).is_file()]

    def _base(self, base: WantedBase, surface: quantities.SampledSurface) -> quantities.VolumeBase:
        places, corners = surface.samples, surface.corners.position_in_geo
        if base.kind in ("plane", "mean", "lowest"):
            return quantities.rim_base(base.kind, corners, places[:, :2])
        none = np.zeros((len(places), len(corners)))
        level = self.target.xyz_from_geo(places)[:, 2]
        if base.kind == "height":
            wanted, sigma_m = np.full(len(places), base.height), 0.0
        else:
            wanted, sigma_m = self._raster_heights(base.raster, places)
        # `geo` departs from heights of the CRS by the same at a place's surface and at its base.
        below_m = (level - wanted) * self.target.crs.height_unit_m
        return quantities.VolumeBase(places[:, 2] - below_m, none, sigma_m)

    def _raster_heights(self, name: str, places: FloatArray) -> tuple[FloatArray, float]:
        """Return heights (N,) of a raster below places (N, 3) in `geo`, in the viewer's CRS, and their mean σ."""
        path = self._workspace.root / "raster" / name
        if name not in BASE_RASTERS or not path.is_file():
            raise InputError(
                "no-base-raster", f"There is no raster/{name}.", remedy="Make it with `georef export-raster`."
            )
        sidecar = load_json(CrsSidecar, sidecar_path(path))
        other = usable_crs(
            CrsOptions(crs=sidecar.crs if sidecar.crs_wkt else None),
            self.survey.origin,
            places,
            self.survey.vertical,
        )
        xyz = other.xyz_from_geo(places)
        height, sigma = (sampled_raster(path.with_name(file), xyz[:, :2]) for file in (name, BASE_RASTERS[name]))
        known = np.isfinite(height)
        if known.mean() < _LEAST_COVERED:
            raise InputError(
                "base-not-covered",
                f"raster/{name} does not cover the polygon.",
                remedy="Draw it inside the raster.",
            )
        height[~known] = np.median(height[known])
        in_geo = other.geo_from_xyz(np.column_stack([xyz[:, :2], height]))
        return self.target.xyz_from_geo(in_geo)[:, 2], float(np.nan_to_num(np.nanmean(sigma)))

    def _joint_covariance(self, positions: Sequence[FloatArray], cameras: Sequence[IntArray]) -> FloatArray | None:
        """Return the joint covariance (3 J, 3 J) of J points, seen by cameras, without the surface's own."""
        if self.posterior is None or not positions:
            return None
        number = np.repeat(np.arange(len(positions)), [len(each) for each in cameras])
        cov = self.posterior.jointly_of_scene(np.array(positions), number, np.concatenate(cameras))
        return cov if np.isfinite(cov).all() else None

    def _sampled(
        self, corners: Sequence[SurfacePoint], fineness: Fineness
    ) -> tuple[quantities.SampledSurface, Quantity] | None:
        """Return the surface in a polygon, and how densely it was read; None: there is none."""
        joint = self.jointly(corners)
        area, pixel_m = quantities.plan_area(joint).value, self._pixel_m(corners)
        spacing = max(float(np.sqrt(area / fineness.places)), _LEAST_SPACING_PX * pixel_m)
        grid = quantities.grid_in_polygon(joint.position_in_geo[:, :2], spacing)
        if not len(grid):
            return None
        heights = heights_in_plan(
            self.reader.renderer, grid, float(np.median(joint.position_in_geo[:, 2])), spacing / np.sqrt(2),
            most_views=fineness.views, advance=fineness.advance,
        )  # fmt: skip
        rows = np.flatnonzero(heights.known)
        if not len(rows):
            return None
        samples = np.column_stack([grid[rows], heights.height_m[rows]])
        chosen = np.unique(np.linspace(0, len(rows) - 1, _JOINT_SAMPLES).astype(np.int64))
        shared = self._joint_covariance(
            [*(point.position_in_geo for point in corners), *samples[chosen]],
            [*(point.cameras for point in corners), *cameras_of(heights, rows[chosen])],
        )
        if shared is not None:
            cov_of_corners = [point.cov_of_surface for point in corners]
            shared = shared + block_diag(*cov_of_corners, *[np.zeros((3, 3))] * len(chosen))
        surface = quantities.SampledSurface(
            corners=joint, samples=samples, sigma_up_m=heights.sigma_m[rows], cov_in_geo=shared, chosen=chosen,
            pixel_m=pixel_m,
        )  # fmt: skip
        share = 100 * (len(rows) / len(grid))
        return surface, Quantity(f"measured every {spacing:.2f} m, on", share, None, "% of the area")

    def _pixel_m(self, points: Sequence[SurfacePoint]) -> float:
        """Return the mean width of a training pixel at points."""
        centers = self._center_in_geo
        widths = [
            float(np.linalg.norm(centers[camera] - point.position_in_geo)) / self.reader.focal_px(int(camera))
            for point in points
            for camera in point.cameras
        ]
        return float(np.mean(widths))


def pointing_covariance(
    reader: SurfaceReader, frame: ViewFrame, camera: ViewerCamera, pixel: tuple[float, float]
) -> FloatArray:
    """Return the covariance (3, 3) in m² that a click of `SIGMA_PX` gives a point of the surface.

    Nobody points better than to about a pixel of the page, and pixels widen with the distance.

    The point moves on the surface, as the renders beside the pixel show it. At an edge, beside which lies another
    surface, it moves across the line of sight.
    """
    columns = []
    for axis in np.eye(2):
        ends, across_m = [], 0.0
        for sign in (-1.0, 1.0):
            sight = frame.sight(camera, *(np.array(pixel) + sign * _STEP_PX * axis))
            distance = reader.rendered_distance(sight)
            if distance is not None:
                ends.append(reader.renderer.geo_from_model.apply(sight.at(distance)[None])[0])
                across_m = distance * sight.pixel_rad * reader.renderer.geo_from_model.scale
        if len(ends) < 2 and not across_m:
            return np.zeros((3, 3))
        along = (ends[1] - ends[0]) / (2 * _STEP_PX) if len(ends) == 2 else np.full(3, np.inf)
        if not np.linalg.norm(along) <= _STEEPEST * across_m:
            along = across_m * (camera.rotation.T @ np.append(axis, 0.0))
        columns.append(along)
    turned = np.array(columns).T
    return np.asarray(SIGMA_PX**2 * turned @ turned.T)
