"""Image marks of surveyed points as rays. Only here does a mark become a ray, and its σ an angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pipelines.core.products import Remark
from pipelines.core.types import BoolArray, FloatArray, IntArray, rows_of
from pipelines.geometry.cameras import bearings
from pipelines.geometry.intersection import (
    Intersections,
    Rays,
    UncertainCameras,
    across_rays,
    intersect_rays,
    meeting_points,
)
from pipelines.geometry.rolling_shutter import depths_at, in_global_shutter
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.solution import Solution
from pipelines.survey.survey import PointMarks

_LEAST_MARKS = 4  # of a point: fewer cannot tell which of them is wrong
_MOST_PAIRS = 200  # of a point's rays
_LEAST_OFF_PX, _FAR_OFF = 3.0, 5.0  # least distance of a wrong mark, and in the scatter of marks and in its σ
_RIDGE = 1e-9  # of parallel rays, which meet nowhere


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


@dataclass(frozen=True)
class WrongMark:
    """Mark that the other marks of its point show to be wrong, and how far off it is."""

    point: str
    image: str
    off_px: float


def mark_rays(points: Sequence[PointMarks], sparse: SparseModel, *, wrong: bool = False) -> MarkRays:
    """Return the rays of the marks of J points, in their order, in registered images.

    A mark is left out if the lens maps no ray to its pixel, or, without `wrong`, if the point's other marks show it
    to be wrong.
    """
    rays = _all_rays(points, sparse)
    return rays if wrong else rows_of(rays, _off_px(rays, sparse) == 0)


def wrong_marks(points: Sequence[PointMarks], sparse: SparseModel) -> tuple[WrongMark, ...]:
    """Return the marks that `mark_rays` leaves out because others of their point do not meet them."""
    rays = _all_rays(points, sparse)
    off_px = _off_px(rays, sparse)
    return tuple(
        WrongMark(rays.point_name[rays.point[row]], sparse.image_name[rays.camera[row]], float(off_px[row]))
        for row in np.flatnonzero(off_px)
    )


def of_wrong_marks(wrong: Sequence[WrongMark]) -> tuple[Remark, ...]:
    """Return the warning that names them; none without."""
    if not wrong:
        return ()
    worst = [f"{mark.image} of point {mark.point} ({mark.off_px:.0f} px)" for mark in wrong]
    sentence = (
        f"Marks that do not meet the others of their point are left out: {', '.join(worst)}. Mark them again."
    )
    return (Remark(code="wrong-marks", sentence=sentence),)


def _off_px(rays: MarkRays, sparse: SparseModel) -> FloatArray:
    """Return how far off (K,) in pixels the wrong marks are in the SfM model, and 0 for all others.

    Of the places where two rays of a point meet, the one counts that the better half of its other marks shows best
    (least median of squares, doi 10.1080/01621459.1984.10477105). The scatter of these over all points tells what
    is far off. Three marks cannot tell which of them is wrong, nor can half of a point's marks.
    """
    rotation, center = sparse.rotation_cam_from_local, sparse.cam_center_in_local
    direction = np.einsum("kji,kj->ki", rotation[rays.camera], rays.bearing_in_cam)
    across, center_of_ray = across_rays(direction), center[rays.camera]
    per_rad = rays.sigma_px / rays.sigma_rad
    rows_of_point = [np.flatnonzero(rays.point == j) for j in np.flatnonzero(rays.marks_of_point >= _LEAST_MARKS)]

    def residuals_px(place: FloatArray, rows: IntArray) -> FloatArray:
        arm = place[:, None] - center[rays.camera[rows]]
        far = np.linalg.norm(np.cross(direction[rows], arm), axis=2)
        return np.asarray(per_rad[rows] * np.arctan2(far, np.einsum("kj,pkj->pk", direction[rows], arm)))

    best, scatter = [], []
    for rows in rows_of_point:
        pairs = rows[np.array(list(combinations(range(len(rows)), 2))[:_MOST_PAIRS])]
        both, pair_of = pairs.ravel(), np.repeat(np.arange(len(pairs)), 2)
        place = meeting_points(pair_of, center_of_ray[both], across[both], len(pairs), ridge=_RIDGE)
        residual = residuals_px(place, rows)
        others = np.where((rows == pairs[:, :1]) | (rows == pairs[:, 1:]), np.inf, residual)
        score = np.sort(others, axis=1)[:, (len(rows) - 3) // 2]
        best.append(residual[score.argmin()])
        scatter.append(score.min())
    off = np.zeros(len(rays.point))
    limit_px = max(_LEAST_OFF_PX, _FAR_OFF * float(np.median(scatter))) if scatter else 0.0
    for rows, residual in zip(rows_of_point, best, strict=True):
        good = residual <= np.maximum(limit_px, _FAR_OFF * rays.sigma_px[rows])
        if good.all() or good.sum() < 3 or 2 * good.sum() <= len(rows):
            continue
        of_good, first = rows[good], np.zeros(int(good.sum()), dtype=np.int64)
        place = meeting_points(first, center_of_ray[of_good], across[of_good], 1)
        off[rows[~good]] = residuals_px(place, rows[~good])[0]
    return off


def bearings_at(sparse: SparseModel, image: int, xy_px: FloatArray) -> FloatArray:
    """Return unit vectors (K, 3) in the camera towards pixels (K, 2) of a photograph; NaN where no ray leads there.

    Pixels of a rolling shutter have the depth of the tie points around them.
    """
    lens = sparse.camera_of(image)
    if sparse.travel_in_cam is not None and sparse.travel_in_cam[image].any():
        depth = depths_at(sparse, image, xy_px)
        xy_px = in_global_shutter(lens, xy_px, depth, sparse.travel_in_cam[image])
    return bearings(lens, xy_px)


def _all_rays(points: Sequence[PointMarks], sparse: SparseModel) -> MarkRays:
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
        bearing[mine] = bearings_at(sparse, int(image), table[mine, 2:4])
        focal_px[mine] = sparse.camera_of(int(image)).mean_focal_px
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


# Errors of the solved cameras: rays agree within these errors and the σ of their marks.
_CAMERA_ERRORS = RayErrors(sigma_center=0.02, sigma_attitude_rad=2e-4)


def triangulated_points(solution: Solution, rays: MarkRays) -> FloatArray:
    """Return the intersections (J, 3) in `geo` of the rays of each point; NaN: marks in fewer than two images."""
    poses = solution.poses
    met = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, _CAMERA_ERRORS)
    position = met.position_in_geo.copy()  # in the frame of the cameras, `model`
    position[rays.marks_of_point < 2] = np.nan
    return solution.similarity.apply(position)
