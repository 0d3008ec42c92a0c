"""Predicted covariance of points of a trained survey, from the covariances of its measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix, eye, kron

from pipelines.adjust.intersection_jacobian import IntersectionJacobian, intersection_jacobian
from pipelines.adjust.networks import control_rays, mean_focal_px, network_of_points
from pipelines.adjust.posterior import FreeLens
from pipelines.adjust.solved_survey import SolvedSurvey
from pipelines.adjust.survey_posterior import survey_posterior
from pipelines.core.cautions import Caution
from pipelines.core.types import FloatArray, IntArray
from pipelines.scene.marks import MarkRays


class AccuracyPrediction:
    """Prediction of the covariance at any point, from the joint posterior of similarity, cameras and lens.

    Args:
        solved: the survey, with its measurements solved.

    Raises:
        DegenerateGeometryError: the measurements do not determine the similarity.
    """

    def __init__(self, solved: SolvedSurvey) -> None:
        self._solved = solved
        self._has_lens = len(solved.problem.cameras.lens()) > 0
        self._posterior = survey_posterior(solved.problem, _free_lens(solved) if self._has_lens else None)

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Limits of the prediction: assumptions that this training does not meet."""
        limits, options = {}, self._solved.options
        if self.holds_cameras:
            limits["prediction-holds-cameras"] = (
                "The cameras were held: the prediction leaves out their own error, and is too good."
            )
        if not options.geo_loss:
            limits["prediction-of-initial-similarity"] = (
                "Trained without geographic losses: the prediction is that of the initial similarity."
            )
        elif options.weighting != "whitened":
            limits["prediction-of-whitened-residuals"] = (
                f"Trained with --weighting {options.weighting}: the prediction is that of whitened residuals."
            )
        return tuple(Caution(code=code, sentence=sentence) for code, sentence in limits.items())

    def of_marked_points(self, point_in_geo: FloatArray, rays: MarkRays) -> FloatArray:
        """Return covariances (J, 3, 3) in m² of points intersected from their marks, errors of the marks included.

        NaN for a point that is NaN, or that its marks do not determine.

        Args:
            point_in_geo: (J, 3) metres.
            rays: of the marks.
        """
        rays = rays.part(np.flatnonzero(np.isfinite(point_in_geo[rays.point]).all(axis=1)))
        position = np.nan_to_num(point_in_geo)
        jacobian = jacobian_of_points(self._solved, position, rays.point, rays.camera, rays.sigma_px)
        cov = self._covariance(position, jacobian) + self._cov_of_marks(jacobian)
        cov[rays.marks_of_point < 2] = np.nan
        return cov

    def jointly_of_marked_points(self, point_in_geo: FloatArray, rays: MarkRays) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points intersected from their marks.

        The points share the errors of similarity, cameras and lens. Those of the marks are independent.

        Args:
            point_in_geo: (J, 3) metres; all are determined by their marks.
            rays: of the marks.
        """
        jacobian = jacobian_of_points(self._solved, point_in_geo, rays.point, rays.camera, rays.sigma_px)
        joint = self._posterior.jointly_at(point_in_geo, *self._derivatives(jacobian))
        return np.asarray(joint + block_diag(*self._cov_of_marks(jacobian)))

    def of_scene(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Return the covariance (J, 3, 3) in m² of points of the scene, without errors of marks.

        Args:
            point_in_geo: (J, 3) metres.
            point: (K,) index into the points, of each ray.
            camera: (K,) index of the camera that sees the point.
        """
        return self._covariance(point_in_geo, self._jacobian_of_scene(point_in_geo, point, camera))

    def jointly_of_scene(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points of the scene, without errors of marks.

        Args:
            point_in_geo: (J, 3) metres.
            point: (K,) index into the points, of each ray.
            camera: (K,) index of the camera that sees the point.
        """
        jacobian = self._jacobian_of_scene(point_in_geo, point, camera)
        return np.asarray(self._posterior.jointly_at(point_in_geo, *self._derivatives(jacobian)))

    def of_cameras(self) -> FloatArray:
        """Return the covariance (n, 6, 6) of (δθ [rad], δc [m]) of the trained cameras, along the axes of `geo`.

        If the cameras were held, this is that of the similarity alone.
        """
        trained = self._solved.trained
        center = trained.geo_from_model.apply(trained.poses.cam_center_in_model)
        return self._posterior.of_cameras(center, trained.geo_from_model)

    def of_lens(self) -> FloatArray | None:
        """Return the covariance (L, L) of the lens parameters, in the order of `geometry.lens.Lenses`.

        None if the cameras were held, and the lens with them.
        """
        return self._posterior.of_lens() if self._has_lens else None

    @property
    def holds_cameras(self) -> bool:
        """Whether the training held the cameras, so that their own errors are not predicted."""
        return not self._solved.problem.corrects_cameras

    def _jacobian_of_scene(
        self, point_in_geo: FloatArray, point: IntArray, camera: IntArray
    ) -> IntersectionJacobian:
        sigma_px = mean_focal_px(self._solved.scene.sparse, camera)  # all rays have the same angular σ
        return jacobian_of_points(self._solved, point_in_geo, point, camera, sigma_px)

    def _covariance(self, point_in_geo: FloatArray, jacobian: IntersectionJacobian) -> FloatArray:
        return self._posterior.at(point_in_geo, *self._derivatives(jacobian))

    def _derivatives(self, jacobian: IntersectionJacobian) -> tuple[csr_matrix, FloatArray]:
        """Return the derivatives of points in geo by the cameras' corrections, and by the lens."""
        axes = _geo_by_model(self._solved)
        turned = kron(eye(len(jacobian.by_lens)), axes, format="csr")
        return csr_matrix(turned @ jacobian.by_poses), axes @ jacobian.by_lens

    def _cov_of_marks(self, jacobian: IntersectionJacobian) -> FloatArray:
        axes = _geo_by_model(self._solved)
        return axes @ jacobian.cov_of_marks @ axes.T


def jacobian_of_points(
    solved: SolvedSurvey, point_in_geo: FloatArray, point: IntArray, camera: IntArray, sigma_px: FloatArray
) -> IntersectionJacobian:
    """Return the derivatives, in metres of `model`, of points by the trained cameras that see them.

    Args:
        solved: the survey, with the trained cameras.
        point_in_geo: (J, 3) metres.
        point: (K,) index into the points, of each ray.
        camera: (K,) index into the images.
        sigma_px: (K,) σ of each ray on its image.
    """
    trained = solved.trained
    position = trained.geo_from_model.inverse().apply(point_in_geo)
    marks = replace(
        network_of_points(solved.scene.network, position, point, camera),
        cameras=trained.sparse.cameras,
        cam_from_world=trained.poses.cam_from_model,
        cam_center_in_world=trained.poses.cam_center_in_model,
    )
    return intersection_jacobian(marks, sigma_px)


def _free_lens(solved: SolvedSurvey) -> FreeLens:
    lens_cov, control = solved.scene.bundle.lens_cov, solved.problem.control
    by_control = np.zeros((0, 3, len(lens_cov)))
    if control is not None:
        rays, position = control_rays(solved), control.position_in_geo.cpu().numpy()
        jacobian = jacobian_of_points(solved, position, rays.point, rays.camera, rays.sigma_px)
        by_control = _geo_by_model(solved) @ jacobian.by_lens
    return FreeLens(lens_cov, by_control)


def _geo_by_model(solved: SolvedSurvey) -> FloatArray:
    """Return the derivative (3, 3) of positions in `geo` by positions in `model`."""
    geo_from_model = solved.trained.geo_from_model
    return geo_from_model.scale * geo_from_model.rotation
