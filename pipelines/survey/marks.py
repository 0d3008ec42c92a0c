"""Image marks of surveyed points as rays. Only here does a mark become a ray, and its σ an angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray, rows_of
from pipelines.geometry.cameras import bearings
from pipelines.geometry.intersection import Intersections, Rays, UncertainCameras, intersect_rays
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.survey import SurveyedPoint


@dataclass(frozen=True)
class MarkRays:
    """K image marks of J surveyed points, in registered images."""

    point_name: tuple[str, ...]  # (J,) as in the survey
    point: IntArray  # (K,) index into the points, ascending
    camera: IntArray  # (K,) index into the images of the SfM model
    xy_px: FloatArray  # (K, 2) pixels of the photograph
    bearing_in_cam: FloatArray  # (K, 3) unit vectors
    sigma_px: FloatArray  # (K,) σ of a mark in pixels
    sigma_rad: FloatArray  # (K,) σ of a mark as an angle: `sigma_px` over the mean focal length

    @property
    def xy(self) -> FloatArray:
        """Ratios x/z and y/z (K, 2) of the rays in the camera."""
        return np.asarray(self.bearing_in_cam[:, :2] / self.bearing_in_cam[:, 2:])

    @property
    def marks_of_point(self) -> IntArray:
        """Number of marks (J,) of each point; no two are in one image."""
        return np.bincount(self.point, minlength=len(self.point_name)).astype(np.int64)

    def of_points(self, chosen: BoolArray) -> MarkRays:
        """Return the marks of the points chosen by a mask (J,); the points are numbered anew."""
        rays = rows_of(self, chosen[self.point])
        names = tuple(name for name, keep in zip(self.point_name, chosen, strict=True) if keep)
        return replace(rays, point_name=names, point=(np.cumsum(chosen) - 1)[rays.point])


def mark_rays(points: Sequence[SurveyedPoint], sparse: SparseModel) -> MarkRays:
    """Return the rays of all marks of J points, in their order, in registered images.

    A mark is left out if the lens maps no ray to its pixel.
    """
    index = sparse.image_index()
    rows = [
        (j, index[mark.image], mark.x_px, mark.y_px, mark.sigma_px)
        for j, point in enumerate(points)
        for mark in point.marks
        if mark.image in index
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    point, camera = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    bearing, focal_px = np.full((len(table), 3), np.nan), np.ones(len(table))
    for image in np.unique(camera):
        mine = camera == image
        lens = sparse.camera_of(int(image))
        bearing[mine], focal_px[mine] = bearings(lens, table[mine, 2:4]), lens.mean_focal_px
    rays = MarkRays(
        tuple(point.name for point in points),
        point,
        camera,
        table[:, 2:4],
        bearing,
        table[:, 4],
        table[:, 4] / focal_px,
    )
    return rows_of(rays, np.isfinite(bearing).all(axis=1))


@dataclass(frozen=True)
class RayErrors:
    """Errors of K rays, apart from those of their marks."""

    sigma_center: float  # σ of a projection centre along each axis, in units of the cameras' frame
    sigma_attitude_rad: float  # σ of a camera's attitude about each axis
    sigma_lens_rad: FloatArray | float = 0.0  # (K,) or scalar; added in quadrature to the σ of the marks


def intersect_marks(
    rays: MarkRays, cam_from_frame: FloatArray, center_in_frame: FloatArray, errors: RayErrors
) -> Intersections:
    """Intersect the rays of each of the J points, in the frame of all cameras (n, 3, 3) with centres (n, 3)."""
    count = len(rays.point)
    # One view for each mark, because marks of one image may have different σ.
    views = UncertainCameras(
        center_in_geo=center_in_frame[rays.camera],
        rotation_geo_from_cam=np.swapaxes(cam_from_frame[rays.camera], 1, 2),
        cov_center_in_geo=np.tile(np.eye(3) * errors.sigma_center**2, (count, 1, 1)),
        sigma_attitude_rad=np.full(count, errors.sigma_attitude_rad),
        sigma_ray=np.hypot(rays.sigma_rad, errors.sigma_lens_rad),
    )
    return intersect_rays(Rays(rays.point, np.arange(count), rays.xy), views, len(rays.point_name))


def mark_angles(
    rays: MarkRays, position_in_frame: FloatArray, cam_from_frame: FloatArray, center_in_frame: FloatArray
) -> FloatArray:
    """Return the angles (K,) in radians between marks and their points (J, 3); NaN for a point without position.

    The frame is that of all cameras, of rotations (n, 3, 3) and centres (n, 3).
    """
    arm = position_in_frame[rays.point] - center_in_frame[rays.camera]
    in_cam = np.einsum("kij,kj->ki", cam_from_frame[rays.camera], arm)
    across = np.linalg.norm(np.cross(rays.bearing_in_cam, in_cam), axis=1)
    along = np.einsum("ki,ki->k", rays.bearing_in_cam, in_cam)
    return np.asarray(np.arctan2(across, along))
