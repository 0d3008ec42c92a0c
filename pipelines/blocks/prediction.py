"""How well points of a trained survey are known: predicted from its covariances, and the bound on any estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.blocks.points import Sights
from pipelines.blocks.restored import Restored
from pipelines.errors import DegenerateGeometryError
from pipelines.geometry.bound import Anchors, CameraInformation
from pipelines.geometry.bundle import IntArray, Network
from pipelines.geometry.following import Following, follow
from pipelines.geometry.similarity import Similarity
from pipelines.georef.posterior import LeftOut, LensDoubt, leave_one_out, posterior
from pipelines.products import FloatArray


class Prediction:
    """Covariance at any point of the scene, from the joint posterior of similarity, cameras and lens.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """

    def __init__(self, restored: Restored) -> None:
        trained, problem = restored.trained, restored.problem
        self._trained, self._network = trained, restored.scene.network
        self._basis = problem.cameras.basis.cpu().numpy()
        found = restored.scene.correction_basis if self._basis.shape[2] else None
        doubt = None
        if found is not None:
            by_control = np.zeros((0, 3, len(found.lens_cov)))
            if problem.marks is not None:
                position = trained.geo_from_model.inverse().apply(problem.marks.position_in_geo.cpu().numpy())
                seen = (problem.marks.point.cpu().numpy(), problem.marks.camera.cpu().numpy())
                by_control = self._turn() @ self._follow(position, *seen).by_lens
            doubt = LensDoubt(found.lens_matrix, found.lens_cov, by_control)
        self.posterior, self._lens = posterior(problem, doubt), doubt

    def of_sights(self, point_in_geo: FloatArray, seen: Sights) -> FloatArray:
        """Covariance (J, 3, 3) in m² of points (J, 3) that are intersected from their marks, these included.

        NaN for a point that is NaN or that its marks do not determine.
        """
        good = np.isfinite(point_in_geo[seen.point]).all(axis=1)
        focal = np.array([self._trained.sparse.camera_of(int(i)).params[0] for i in seen.camera])
        sigma_px = (seen.sigma * focal)[good]
        position = self._trained.geo_from_model.inverse().apply(np.nan_to_num(point_in_geo))
        following = self._follow(position, seen.point[good], seen.camera[good], sigma_px)
        turn = self._turn()
        cov = self._of(np.nan_to_num(point_in_geo), following) + turn @ following.cov_of_marks @ turn.T
        cov[np.bincount(seen.point[good], minlength=len(cov)) < 2] = np.nan
        return cov

    def of_scene(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Covariance (J, 3, 3) in m² of points (J, 3) of the scene that cameras see (pairs of point and camera)."""
        position = self._trained.geo_from_model.inverse().apply(point_in_geo)
        return self._of(point_in_geo, self._follow(position, point, camera))

    def _of(self, point_in_geo: FloatArray, following: Following) -> FloatArray:
        turn = self._turn()
        by_lens = turn @ following.by_lens if self._lens is not None else np.zeros((len(point_in_geo), 3, 0))
        return self.posterior.at(point_in_geo, turn @ following.by(self._basis), by_lens)

    def _follow(
        self, position: FloatArray, point: IntArray, camera: IntArray, sigma_px: FloatArray | None = None
    ) -> Following:
        poses = self._trained.poses
        marks = replace(
            _marked(self._network, position, point, camera),
            cam_from_world=poses.cam_from_model,
            cam_center_in_world=poses.cam_center_in_model,
        )
        return follow(marks, np.ones(len(point)) if sigma_px is None else sigma_px)

    def _turn(self) -> FloatArray:
        geo_from_model = self._trained.geo_from_model
        return geo_from_model.scale * geo_from_model.rotation


def cramer_rao(restored: Restored, seen: Sights) -> FloatArray:
    """Least covariance (J, 3, 3) in m² of the check points, from all measurements with the σ that they state.

    Raises:
        DegenerateGeometryError: there is none: too many cameras, or too little measured.
    """
    scene, problem, trained = restored.scene, restored.problem, restored.trained
    if scene.correction_basis is None:
        raise DegenerateGeometryError(f"{len(scene.sparse.image_name)} cameras are too many for the bound")
    network = in_geo(scene.network, trained.geo_from_model)
    camera, cov_fix = np.empty(0, dtype=np.int64), np.empty((0, 3, 3))
    if problem.fixes is not None:
        root = problem.fixes.root_information.cpu().numpy()
        camera, cov_fix = problem.fixes.camera.cpu().numpy(), np.linalg.inv(np.swapaxes(root, 1, 2) @ root)
    anchors = Anchors(camera, cov_fix)
    if problem.marks is not None:
        position = problem.marks.position_in_geo.cpu().numpy()
        surveyed = {point.position_in_geo: point.cov_in_geo for point in trained.survey.control_points}
        point, camera = problem.marks.point.cpu().numpy(), problem.marks.camera.cpu().numpy()
        focal = np.array([scene.sparse.camera_of(int(i)).params[0] for i in camera])
        anchors = replace(
            anchors,
            control=_marked(network, position, point, camera),
            control_sigma_px=problem.marks.sigma_rad.cpu().numpy() * focal,
            cov_control=np.array([surveyed[tuple(row)] for row in position.tolist()]),
        )
    information = CameraInformation(network, scene.correction_basis.sigma_px, anchors)
    position = np.array([point.position_in_geo for point in trained.survey.check_points]).reshape(-1, 3)
    focal = np.array([scene.sparse.camera_of(int(i)).params[0] for i in seen.camera])
    return information.bound(_marked(network, position, seen.point, seen.camera), seen.sigma * focal)


def left_out(restored: Restored) -> LeftOut:
    """Each control point of the survey (J) measured without it; NaN for one that entered no solution.

    The covariance is that of the solution and the marks: the survey's own is taken off again.
    """
    points, marks = restored.trained.survey.control_points, restored.problem.marks
    error, cov = np.full((len(points), 3), np.nan), np.full((len(points), 3, 3), np.nan)
    if marks is None:
        return LeftOut(error, cov)
    found = leave_one_out(restored.problem)
    used, row = [tuple(position) for position in marks.position_in_geo.tolist()], 0
    for j, point in enumerate(points):  # the used ones are in the survey's order
        if row < len(used) and used[row] == point.position_in_geo:
            error[j], cov[j] = found.error_in_geo[row], found.cov_in_geo[row] - np.array(point.cov_in_geo)
            row += 1
    return LeftOut(error, cov)


def in_geo(network: Network, geo_from_model: Similarity) -> Network:
    """A network in another frame."""
    return replace(
        network,
        cam_from_world=network.cam_from_world @ geo_from_model.rotation.T,
        cam_center_in_world=geo_from_model.apply(network.cam_center_in_world),
        point_in_world=geo_from_model.apply(network.point_in_world),
    )


def _marked(network: Network, position: FloatArray, point: IntArray, camera: IntArray) -> Network:
    """The cameras of a network with other points (J, 3), seen where the cameras show them."""
    return replace(
        network, point_in_world=position, obs_point=point, obs_image=camera, obs_xy_px=np.zeros((len(point), 2))
    )
