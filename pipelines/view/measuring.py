"""Measuring in a trained model: points of its surface, their coordinates in a CRS, and σ of what they make up."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from pipelines.adjust.solution import posterior_of
from pipelines.core.products import is_checked
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.surface.picking import Sight, SurfacePoint, SurfaceReader
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.marks import MarkRays
from pipelines.survey.options import CrsOptions
from pipelines.survey.target_crs import TargetCrs, usable_crs
from pipelines.survey.trained_survey import triangulated_points
from pipelines.view import quantities

_MOST_SAMPLES = 400  # of the surface in a polygon: a few seconds
_JOINT_SAMPLES = 40  # of which so many enter the joint covariance
_LEAST_SPACING_PX = 4.0  # between samples: closer ones would show the surface's noise, not its shape
_ABOVE_M = 30.0  # of the start of a plumb line above the highest corner, at least
_PLUMB_PX_RAD = 1e-3


class MeasuringModel:
    """Trained model of a workspace, to measure in.

    Attributes:
        posterior: covariances of the model; None: none are stated.
        without_sigma: why no σ is stated; empty: it is.

    Raises:
        MissingProductError: the model was stored without its covariances.
        InputError: a product is damaged, or the CRS cannot be used here.
    """

    def __init__(self, workspace: Workspace, renderer: ModelRenderer, crs: CrsOptions) -> None:
        self.trained, self.reader = renderer.trained, SurfaceReader(renderer)
        survey = self.trained.survey
        centers = self.trained.geo_from_model.apply(self.trained.poses.cam_center_in_model)
        self.target: TargetCrs = usable_crs(crs, survey.origin, centers, survey.vertical)
        is_stated = is_checked(self.trained.model.cautions)
        self.posterior = posterior_of(workspace, self.trained.model, self.trained.sfm) if is_stated else None
        self.without_sigma = "" if self.posterior is not None else "nothing checks the σ of the positions"

    def triangulated(self, rays: MarkRays) -> tuple[FloatArray, FloatArray | None]:
        """Return the intersection (3,) in `geo` of the marks of one point, and its covariance (3, 3) in m².

        The intersection is NaN with fewer than two marks; the covariance is None where none is stated.
        """
        position = triangulated_points(self.trained, rays)
        if self.posterior is None or not np.isfinite(position).all():
            return position[0], None
        return position[0], self.posterior.of_marked_points(position, rays)[0]

    def place(self, point: SurfacePoint) -> tuple[FloatArray, FloatArray | None]:
        """Return a point (3,) in the CRS, easting or longitude first, and its σ (3,) east, north, up in metres.

        σ is that of georeference, cameras, lens and surface; None: not known.
        """
        joint = self.jointly([point])
        sigma_m = None if joint.cov_in_geo is None else np.sqrt(np.diag(joint.cov_in_geo))
        return self.target.xyz_from_geo(point.position_in_geo[None])[0], sigma_m

    def jointly(self, points: Sequence[SurfacePoint]) -> quantities.MeasuredPoints:
        position = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
        cov = self._joint_covariance(points)
        cov = None if cov is None else cov + block_diag(*(point.cov_of_surface for point in points))
        height_m = np.asarray(self.target.xyz_from_geo(position)[:, 2] * self.target.crs.height_unit_m)
        return quantities.MeasuredPoints(position, cov, height_m)

    def area(self, corners: Sequence[SurfacePoint]) -> tuple[quantities.Quantity, ...]:
        """Return the area of a polygon, in plan and on the surface."""
        sampled = self._sampled(corners)
        if sampled is None:
            return (quantities.plan_area(self.jointly(corners)),)
        surface, coverage = sampled
        return quantities.plan_area(surface.corners), quantities.surface_area(surface), coverage

    def volume(
        self, corners: Sequence[SurfacePoint], base: quantities.BasePlane
    ) -> tuple[quantities.Quantity, ...]:
        """Return the volume between the surface within a polygon and a base; nothing where there is no surface."""
        sampled = self._sampled(corners)
        if sampled is None:
            return ()
        surface, coverage = sampled
        lowest = int(np.argmin(surface.corners.height_m))
        return (*quantities.volumes(surface, replace(base, lowest=lowest)), coverage)

    def _joint_covariance(self, points: Sequence[SurfacePoint]) -> FloatArray | None:
        """Return the joint covariance (3 J, 3 J) of points without the surface's own."""
        if self.posterior is None or not points:
            return None
        position = np.array([point.position_in_geo for point in points])
        number = np.repeat(np.arange(len(points)), [len(point.cameras) for point in points])
        cameras = np.concatenate([point.cameras for point in points])
        cov = self.posterior.jointly_of_scene(position, number, cameras)
        return cov if np.isfinite(cov).all() else None

    def _sampled(
        self, corners: Sequence[SurfacePoint]
    ) -> tuple[quantities.SampledSurface, quantities.Quantity] | None:
        """Return the surface in a polygon, read along plumb lines, and how densely; None: there is none."""
        joint = self.jointly(corners)
        area, pixel_m = quantities.plan_area(joint).value, self._pixel_m(corners)
        spacing = max(float(np.sqrt(area / _MOST_SAMPLES)), _LEAST_SPACING_PX * pixel_m)
        grid = quantities.grid_in_polygon(joint.position_in_geo[:, :2], spacing)
        top = float(joint.position_in_geo[:, 2].max()) + _ABOVE_M + float(np.sqrt(area))
        model_from_geo = self.trained.geo_from_model.inverse()
        down = model_from_geo.rotation @ np.array([0.0, 0.0, -1.0])
        samples = []
        for east, north in grid:
            start = model_from_geo.apply(np.array([[east, north, top]]))[0]
            point = self.reader.under(Sight(start, down, _PLUMB_PX_RAD))
            if isinstance(point, SurfacePoint):
                samples.append(point)
        if not samples:
            return None
        chosen = np.unique(np.linspace(0, len(samples) - 1, _JOINT_SAMPLES).astype(np.int64))
        shared = self._joint_covariance([*corners, *(samples[row] for row in chosen)])
        if shared is not None:
            own = [point.cov_of_surface for point in corners]
            shared = shared + block_diag(*own, *[np.zeros((3, 3))] * len(chosen))
        surface = quantities.SampledSurface(
            corners=joint,
            samples=np.array([point.position_in_geo for point in samples]),
            sigma_up_m=np.sqrt([point.cov_of_surface[2, 2] for point in samples]),
            cov_in_geo=shared,
            chosen=chosen,
        )
        share = 100 * (len(samples) / len(grid))
        return surface, quantities.Quantity(f"measured every {spacing:.2f} m, on", share, None, "% of the area")

    def _pixel_m(self, points: Sequence[SurfacePoint]) -> float:
        """Return the mean width of a training pixel at points."""
        centers = self.trained.geo_from_model.apply(self.trained.poses.cam_center_in_model)
        widths = [
            float(np.linalg.norm(centers[camera] - point.position_in_geo)) / self.reader.focal_px(int(camera))
            for point in points
            for camera in point.cameras
        ]
        return float(np.mean(widths))
