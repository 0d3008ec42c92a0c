"""How well points of a trained survey are known: predicted from its covariances, and the bound on any estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray
from pipelines.evaluate.cramer_rao import Anchors, CameraInformation
from pipelines.evaluate.following import Following, follow
from pipelines.evaluate.points import Sights
from pipelines.geometry.bundle import Network
from pipelines.geometry.similarity import Similarity
from pipelines.georef.posterior import FreeLens, LeftOut, leave_one_out, posterior
from pipelines.scene.restored import Restored


class Prediction:
    """Covariance at any point of the scene, from the joint posterior of similarity, cameras and lens.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """

    def __init__(self, restored: Restored) -> None:
        self._restored = restored
        cameras = restored.problem.cameras
        self._basis, self._lens_basis = cameras.basis.cpu().numpy(), cameras.lens_basis.cpu().numpy()
        self._lens = _free_lens(restored) if len(self._lens_basis) else None
        self._posterior = posterior(restored.problem, self._lens)

    @property
    def cautions(self) -> tuple[str, ...]:
        """Where the prediction is not that of this training."""
        found, options = [], self._restored.options
        if not self._basis.shape[2]:
            found.append("the cameras were held: the prediction leaves out their own error, and is too good")
        if not options.geo_loss:
            found.append("trained without geographic losses: the prediction is that of the initial similarity")
        elif options.weighting != "whitened":
            found.append(
                f"trained with --weighting {options.weighting}: the prediction is that of whitened residuals"
            )
        return tuple(found)

    def of_sights(self, point_in_geo: FloatArray, seen: Sights) -> FloatArray:
        """Covariance (J, 3, 3) in m² of points (J, 3) that are intersected from their marks, these included.

        NaN for a point that is NaN or that its marks do not determine.
        """
        good = np.isfinite(point_in_geo[seen.point]).all(axis=1)
        position, seen = np.nan_to_num(point_in_geo), seen.part(np.flatnonzero(good))
        moved = following(self._restored, position, seen)
        turn = _turn(self._restored)
        cov = self._of(position, moved) + turn @ moved.cov_of_marks @ turn.T
        cov[np.bincount(seen.point, minlength=len(cov)) < 2] = np.nan
        return cov

    def of_scene(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Covariance (J, 3, 3) in m² of points (J, 3) of the scene that cameras see (pairs of point and camera)."""
        seen = Sights(point, camera, np.zeros((len(point), 2)), np.ones(len(point)))
        return self._of(point_in_geo, following(self._restored, point_in_geo, seen))

    def _of(self, point_in_geo: FloatArray, moved: Following) -> FloatArray:
        turn = _turn(self._restored)
        by_lens = turn @ moved.by_lens[:, :, : len(self._lens_basis)]
        by_cameras = turn @ moved.by(self._basis) + by_lens @ self._lens_basis
        return self._posterior.at(point_in_geo, by_cameras, by_lens)


def following(restored: Restored, point_in_geo: FloatArray, seen: Sights) -> Following:
    """How points (J, 3), intersected from their marks, follow the trained cameras; in metres of `model`."""
    poses = restored.trained.poses
    position = restored.trained.geo_from_model.inverse().apply(point_in_geo)
    marks = replace(
        _marked(restored.scene.network, position, seen),
        cameras=restored.trained.sparse.cameras,
        cam_from_world=poses.cam_from_model,
        cam_center_in_world=poses.cam_center_in_model,
    )
    return follow(marks, _sigma_px(restored, seen))


def control_sights(restored: Restored) -> Sights:
    """The marks of the control points that entered the training, through its lens; none without these."""
    marks = restored.problem.control
    if marks is None:
        return Sights(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty(0))
    bearing = marks.bearings(trained_lens(restored)).cpu().numpy()
    return Sights(
        marks.point.cpu().numpy(),
        marks.camera.cpu().numpy(),
        bearing[:, :2] / bearing[:, 2:],
        marks.sigma_rad.cpu().numpy(),
    )


def trained_lens(restored: Restored) -> Tensor:
    """Change (L,) of the lens parameters that training made, in the order of `geometry.lens.Lenses`."""
    return torch.from_numpy(restored.trained.sfm.lenses.change_to(restored.trained.sparse.lenses))


def _free_lens(restored: Restored) -> FreeLens | None:
    found, marks = restored.scene.correction_basis, restored.problem.control
    if found is None:
        return None
    by_control = np.zeros((0, 3, len(found.lens_cov)))
    if marks is not None:
        moved = following(restored, marks.position_in_geo.cpu().numpy(), control_sights(restored))
        by_control = _turn(restored) @ moved.by_lens
    return FreeLens(found.lens_cov, by_control)


def _turn(restored: Restored) -> FloatArray:
    """Metres of `geo` by metres of `model` (3, 3)."""
    geo_from_model = restored.trained.geo_from_model
    return geo_from_model.scale * geo_from_model.rotation


def _sigma_px(restored: Restored, seen: Sights) -> FloatArray:
    focal = [restored.scene.sparse.camera_of(int(index)).params[0] for index in seen.camera]
    return np.asarray(seen.sigma * np.array(focal).reshape(-1))


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
    if problem.control is not None:
        position = problem.control.position_in_geo.cpu().numpy()
        surveyed = {point.position_in_geo: point.cov_in_geo for point in trained.survey.control_points}
        control = control_sights(restored)
        anchors = replace(
            anchors,
            control=_marked(network, position, control),
            control_sigma_px=_sigma_px(restored, control),
            cov_control=np.array([surveyed[tuple(row)] for row in position.tolist()]),
        )
    information = CameraInformation(network, scene.correction_basis.sigma_px, anchors)
    position = np.array([point.position_in_geo for point in trained.survey.check_points]).reshape(-1, 3)
    return information.bound(_marked(network, position, seen), _sigma_px(restored, seen))


def left_out(restored: Restored) -> LeftOut:
    """Each control point of the survey (J) measured without it; NaN for one that entered no solution.

    The covariance is that of the solution and the marks: the survey's own is taken off again.
    """
    points, marks = restored.trained.survey.control_points, restored.problem.control
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


def _marked(network: Network, position: FloatArray, seen: Sights) -> Network:
    """The cameras of a network with other points (J, 3), seen where the cameras show them."""
    return replace(
        network,
        point_in_world=position,
        obs_point=seen.point,
        obs_image=seen.camera,
        obs_xy_px=np.zeros((len(seen.point), 2)),
    )
