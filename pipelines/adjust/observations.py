"""Observations of an SfM model as arrays: fixes, control points and attitudes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.alignment import mean_rotation
from pipelines.adjust.similarity_fit import Correspondences, RotationPrior
from pipelines.core.sentences import listed
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import MarkRays, RayErrors, intersect_marks, mark_angles, mark_rays
from pipelines.survey.survey import Survey

_CONTRADICTION_SIGMAS = 6.0
_CONTRADICTION_RAD = np.radians(15.0)  # lower limit, because the σ of attitudes are often optimistic
_WIDE_RAD = 1.0
_TINY = 1e-9  # σ of exact values, where a covariance must be regular


@dataclass(frozen=True)
class RecordedRotations:
    """Recorded attitudes of k registered images.

    Attributes:
        image: (k,) index into the model's images.
        geo_from_cam: (k, 3, 3).
        sigma_rad: (k,) per axis.
        contradicting: names of further images whose attitudes contradict the SfM model.
    """

    image: IntArray
    geo_from_cam: FloatArray
    sigma_rad: FloatArray
    contradicting: tuple[str, ...] = ()

    def geo_from_local(self, model: SparseModel) -> FloatArray:
        """Return the rotation geo ← local (k, 3, 3) that each attitude gives to a model."""
        return np.asarray(self.geo_from_cam @ model.rotation_cam_from_local[self.image])


@dataclass(frozen=True)
class UnusedControlPoint:
    """Control point that its marks do not determine.

    Attributes:
        name: as in the survey.
        unregistered: names of the images with marks that are not in the SfM model.
        registered: names of the images with usable marks.
        residual_px: angles between these marks and the point that most of them agree on, else their least-squares
            point, in pixels; infinite: the rays are parallel.
    """

    name: str
    unregistered: tuple[str, ...]
    registered: tuple[str, ...]
    residual_px: tuple[float, ...] = ()

    @property
    def sentence(self) -> str:
        """Reason for people: images that are missing, or marks that do not meet."""
        missing = f" ({listed(self.unregistered)} not registered)" if self.unregistered else ""
        if len(self.registered) < 2:
            return f"control point {self.name}: marked in fewer than 2 registered images{missing}, not used"
        marks = sorted(zip(self.residual_px, self.registered, strict=True), reverse=True)
        rays = f"control point {self.name}: its {len(marks)} marks do not meet in one point"
        if not np.isfinite(self.residual_px).all():
            return f"{rays}: their rays are parallel ({listed(self.registered)}), not used; check the marks"
        rms = float(np.sqrt(np.mean(np.square(self.residual_px))))
        worst = listed(tuple(f"{image} {residual:.1f} px" for residual, image in marks))
        return f"{rays}: up to {marks[0][0]:.1f} px off, RMS {rms:.1f} px ({worst}), not used; check the marks"


def fix_correspondences(survey: Survey, model: SparseModel) -> Correspondences:
    """Return the camera centres of registered images with their fixes.

    SfM's own error of a centre is not known at this point (zero covariance). The adjustment measures it as excess
    scatter.
    """
    fixes = {image.name: image.fix for image in survey.images if image.fix is not None}
    fixed = [(index, name) for index, name in enumerate(model.image_name) if name in fixes]
    return Correspondences(
        name=tuple(name for _, name in fixed),
        control=np.zeros(len(fixed), dtype=bool),
        in_local=model.cam_center_in_local[[index for index, _ in fixed]].reshape(-1, 3),
        cov_in_local=np.zeros((len(fixed), 3, 3)),
        in_geo=np.array([fixes[name].position_in_geo for _, name in fixed]).reshape(-1, 3),
        cov_in_geo=np.array([fixes[name].cov_in_geo for _, name in fixed]).reshape(-1, 3, 3),
    )


def control_correspondences(
    survey: Survey, model: SparseModel
) -> tuple[Correspondences, tuple[UnusedControlPoint, ...]]:
    """Return the control points, intersected in local from their marks, with their survey; and those left out.

    A point that its marks do not determine is left out. The covariance in local is that of the marks
    alone. The model's own error is not known at this point: the adjustment measures it as excess scatter.
    """
    points = survey.control_points
    rays = mark_rays(points, model)
    marked = rays.marks_of_point >= 2
    position, cov, meets = _intersect_in_local(model, rays.of_points(marked))
    used = marked.copy()
    used[marked] = meets
    meeting = [point for point, is_used in zip(points, used, strict=True) if is_used]
    return Correspondences(
        name=tuple(point.name for point in meeting),
        control=np.ones(len(meeting), dtype=bool),
        in_local=position[meets],
        cov_in_local=cov[meets],
        in_geo=np.array([point.position_in_geo for point in meeting]).reshape(-1, 3),
        cov_in_geo=np.array([point.cov_in_geo for point in meeting]).reshape(-1, 3, 3),
    ), _unused(survey, model, rays.of_points(~used))


def positions_in_use(
    survey: Survey, model: SparseModel, data: Correspondences, unused: tuple[UnusedControlPoint, ...]
) -> str:
    """Return how many fixes and control points there are, how many are used, and why the others are not."""
    fixes, control = int((~data.control).sum()), int(data.control.sum())
    counts = (
        f"{len(model.image_name)} of {len(survey.images)} images are registered; in use are {fixes} of "
        f"{sum(image.fix is not None for image in survey.images)} fixes and {control} of "
        f"{len(survey.control_points)} control points"
    )
    return "; ".join([counts, *(point.sentence for point in unused)])


def _unused(survey: Survey, model: SparseModel, rays: MarkRays) -> tuple[UnusedControlPoint, ...]:
    """Return the record of each point of `rays`, with the residuals of its marks."""
    position, *_ = _intersect_in_local(model, rays)
    # Where the rays contradict each other, none is left: within a wide σ they meet in the least-squares point.
    wide = RayErrors(_TINY, _TINY, _WIDE_RAD)
    compromise = intersect_marks(rays, model.rotation_cam_from_local, model.cam_center_in_local, wide)
    position = np.where(np.isfinite(position), position, compromise.position_in_geo)
    angle = mark_angles(rays, position, model.rotation_cam_from_local, model.cam_center_in_local)
    residual_px = np.nan_to_num(angle * rays.sigma_px / rays.sigma_rad, nan=np.inf)
    marks = {point.name: point.marks for point in survey.control_points}
    registered = model.image_index()
    return tuple(
        UnusedControlPoint(
            name=name,
            unregistered=tuple(mark.image for mark in marks[name] if mark.image not in registered),
            registered=tuple(model.image_name[camera] for camera in rays.camera[rays.point == index]),
            residual_px=tuple(residual_px[rays.point == index].tolist()),
        )
        for index, name in enumerate(rays.point_name)
    )


def _intersect_in_local(model: SparseModel, rays: MarkRays) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the position (J, 3), covariance (J, 3, 3) and success (J,) of points in local from their marks."""
    # The test of the marks' agreement includes the model's own error, because no lens is modelled to 0.1 px.
    own_px = float(np.nanmedian(model.point_error_px)) if np.isfinite(model.point_error_px).any() else 0.0
    own_rad = own_px * rays.sigma_rad / rays.sigma_px
    center = model.cam_center_in_local
    errors = RayErrors(_TINY * float(np.ptp(center, axis=0).max()), _TINY, own_rad)
    solved = intersect_marks(rays, model.rotation_cam_from_local, center, errors)
    of_marks, of_all = (
        np.bincount(rays.point, squared, len(rays.point_name))
        for squared in (rays.sigma_rad**2, rays.sigma_rad**2 + own_rad**2)
    )
    return solved.position_in_geo, solved.cov_in_geo * (of_marks / of_all)[:, None, None], solved.consistent


def recorded_rotations(survey: Survey, model: SparseModel) -> RecordedRotations:
    """Return the recorded attitudes of the registered images, without those that the SfM model contradicts.

    For example, a photograph that was turned in an image viewer keeps the attitude that the drone wrote. That
    attitude differs from the others by far more than its σ.
    """
    attitudes = {image.name: image.attitude for image in survey.images if image.attitude is not None}
    image = np.array([index for index, name in enumerate(model.image_name) if name in attitudes], dtype=np.int64)
    of_images = [attitudes[model.image_name[index]] for index in image]
    rotation = matrix_from_quat_xyzw(np.array([attitude.quat_xyzw for attitude in of_images]).reshape(-1, 4))
    sigma_rad = np.radians([attitude.sigma_deg for attitude in of_images])
    agrees = np.ones(len(image), dtype=bool)
    if len(image) > 2:
        geo_from_local = rotation @ model.rotation_cam_from_local[image]
        mean = mean_rotation(geo_from_local, sigma_rad).rotation
        turn = np.linalg.norm(log_so3(geo_from_local @ mean.T), axis=1)
        agrees = turn < np.maximum(_CONTRADICTION_SIGMAS * sigma_rad, _CONTRADICTION_RAD)
    return RecordedRotations(
        image=image[agrees],
        geo_from_cam=rotation[agrees],
        sigma_rad=sigma_rad[agrees],
        contradicting=tuple(model.image_name[index] for index in image[~agrees]),
    )


def attitude_prior(survey: Survey, model: SparseModel) -> RotationPrior | None:
    """Return the mean rotation geo ← local of the recorded attitudes, or None without any."""
    recorded = recorded_rotations(survey, model)
    if len(recorded.image) == 0:
        return None
    return mean_rotation(recorded.geo_from_local(model), recorded.sigma_rad)
