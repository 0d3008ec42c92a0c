"""Cramér–Rao bound: least covariance of a point by any unbiased estimate from the measurements and their σ.

The bound comes from the Fisher information of a Gaussian model of *all* observations: image observations of tie
points, marks of control and wanted points, fixes of camera centres, surveyed control points.

- The unknowns are every pose, every point and the lens. Their frame is that of fixes and control points, so that
  no similarity is needed.
- No observation is an outlier, no weight is robust, and no unknown has a prior.

No unbiased estimate has a smaller covariance, and a good estimate comes near (Kay, Fundamentals of Statistical
Signal Processing I, 1993, section 3.9).

The tests compare it with the inverse of the full information matrix from numerical derivatives.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_matrix, csr_matrix, diags, hstack

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.network import (
    EliminatedPoints,
    Network,
    eliminate_points,
    has_positive_depth,
    lens_slots,
    linearise_bundle,
    sparse_jacobian,
    with_positive_depths,
)
from pipelines.geometry.sparse_cholesky import SparseCholesky
from tests.bundle_scenes import SIGMA_PX, exact_network, jacobian
from tests.refusals import refused

_WORST_SCALED = 1e-10  # least pivot of the scaled normal matrix: a smaller one leaves a direction undetermined
_RIDGE = 1e-12  # small, so that it does not hide an open direction
_OPEN = "the observations leave cameras or lens open: there is no bound"


@dataclass(frozen=True)
class Anchors:
    """Observations that tie a network to the Earth.

    Attributes:
        camera: (F,) index of the camera of each fix.
        cov_fix: (F, 3, 3) m², of the fixes.
        control: control points with their marks, and the cameras of the network; None: no control points.
        control_sigma_px: (K,) σ of these marks.
        cov_control: (J, 3, 3) m², of the surveyed positions.
    """

    camera: IntArray
    cov_fix: FloatArray
    control: Network | None = None
    control_sigma_px: FloatArray | None = None
    cov_control: FloatArray | None = None


@dataclass(frozen=True)
class _Rows:
    """Derivatives of whitened image observations by cameras and lens, and by the observed points."""

    by_cameras: csr_matrix  # (2 M, 6 n + L)
    by_point: FloatArray  # (M, 2, 3)


class CameraInformation:
    """Fisher information of n poses and L lens parameters; all tie and control points are eliminated.

    Args:
        ties: bundle of the tie points, in the frame of the anchors; its pixels are not used.
        sigma_px: σ of its image observations, per coordinate.
        anchors: fixes and control points.

    Raises:
        DegenerateGeometryError: the observations do not determine cameras and lens.
    """

    def __init__(self, ties: Network, sigma_px: float, anchors: Anchors) -> None:
        sums = _eliminated(ties, np.full(len(ties.obs_point), sigma_px), None)
        if anchors.control is not None and anchors.control_sigma_px is not None and anchors.cov_control is not None:
            control = _eliminated(
                anchors.control, anchors.control_sigma_px, np.asarray(np.linalg.inv(anchors.cov_control))
            )
            sums = EliminatedPoints(*map(operator.add, vars(sums).values(), vars(control).values()))
        poses = sums.poses + _information_of_fixes(anchors, len(ties.camera_id))
        poses = (poses + diags((poses.diagonal() == 0).astype(float))).tobsr((6, 6))  # cameras without observations
        diagonal = np.concatenate([poses.diagonal(), np.diag(sums.lens)])
        self._used = np.flatnonzero(diagonal > 0)  # shorter parameter lists leave empty columns
        self._unit = 1.0 / np.sqrt(diagonal[self._used])
        n, lens = poses.shape[0], self._used[poses.shape[0] :] - poses.shape[0]
        of_poses, of_lens = self._unit[:n], self._unit[n:]
        scaled = (diags(of_poses) @ poses @ diags(of_poses)).tobsr((6, 6))
        self._cross = sums.cross[:, lens] * of_poses[:, None] * of_lens
        try:
            self._factor = SparseCholesky(scaled, ties.cam_center_in_world)
            self._response = self._factor.solve(self._cross)
            within = sums.lens[np.ix_(lens, lens)] * of_lens[:, None] * of_lens - self._cross.T @ self._response
            self._of_lens = cho_factor(within, lower=True)
        except (np.linalg.LinAlgError, DegenerateGeometryError) as error:
            raise DegenerateGeometryError("no-bound", _OPEN) from error
        least_pivot = min(np.diag(pivot.diagonal).min() for pivot in self._factor.pivots if pivot.diagonal.size)
        least = min(float(least_pivot), float(np.diag(self._of_lens[0]).min(initial=1.0)))
        if least**2 < _WORST_SCALED:
            raise DegenerateGeometryError("no-bound", _OPEN)

    def _solved(self, right: FloatArray) -> FloatArray:
        """Return the product (6 n + L, m) of the inverse scaled information and vectors of the same shape."""
        n = len(self._cross)
        poses = self._factor.solve(right[:n])
        lens = cho_solve(self._of_lens, right[n:] - self._cross.T @ poses)
        return np.concatenate([poses - self._response @ lens, lens])

    def bound(self, wanted: Network, sigma_px: FloatArray) -> FloatArray:
        """Return the least covariance (J, 3, 3) in m² of points that are observed only by their marks.

        The marks of a point inform on the cameras as well; the marks of the other points do not. NaN for a point
        that its marks do not determine.

        Args:
            wanted: the points and their K marks, with the cameras of the bundle.
            sigma_px: (K,) σ of the marks.
        """
        sigma_px, wanted = sigma_px[has_positive_depth(wanted)], with_positive_depths(wanted)
        bounds = np.full((len(wanted.point_in_world), 3, 3), np.nan)
        for j in np.unique(wanted.obs_point):
            of_point = wanted.obs_point == j
            if of_point.sum() >= 2:
                bounds[j] = self._bound_of(_only(wanted, of_point), sigma_px[of_point])
        return bounds

    def _bound_of(self, marks: Network, sigma_px: FloatArray) -> FloatArray:
        rows = _rows(marks, sigma_px)
        by_point = rows.by_point.reshape(-1, 3)
        left, value, right = np.linalg.svd(by_point)
        if value[2] < 1e-6 * value[0]:
            return np.full((3, 3), np.nan)
        by_cameras = rows.by_cameras.toarray()[:, self._used] * self._unit
        response = (right.T / value) @ left[:, :3].T @ by_cameras  # of the point to the cameras
        free = left[:, 3:].T @ by_cameras  # combinations of the marks that do not depend on the point
        solved = self._solved(np.concatenate([response, free]).T)
        of_response, of_free = solved[:, :3], solved[:, 3:]
        gain = np.linalg.solve(np.eye(len(free)) + free @ of_free, free @ of_response)
        cov = (right.T / value**2) @ right + response @ of_response - (response @ of_free) @ gain
        return np.asarray((cov + cov.T) / 2)


def _only(network: Network, of_point: BoolArray) -> Network:
    """Return the network of one point, from the mask of its marks."""
    owner = network.obs_point[of_point][:1]
    return replace(
        network,
        point_in_world=network.point_in_world[owner],
        obs_point=np.zeros(int(of_point.sum()), dtype=np.int64),
        obs_image=network.obs_image[of_point],
        obs_xy_px=network.obs_xy_px[of_point],
    )


def _rows(network: Network, sigma_px: FloatArray) -> _Rows:
    lin = linearise_bundle(network)
    whiten = 1.0 / sigma_px[:, None, None]
    poses = sparse_jacobian(lin.jacobian_pose * whiten, network.obs_image, len(network.camera_id))
    lens = sparse_jacobian(lin.jacobian_intrinsics * whiten, lens_slots(network), len(network.cameras))
    return _Rows(hstack([poses, lens], format="csr"), lin.jacobian_point * whiten)


def _eliminated(network: Network, sigma_px: FloatArray, surveyed: FloatArray | None) -> EliminatedPoints:
    """Return the information of cameras and lens, with the points eliminated.

    Args:
        network: N points and their M observations.
        sigma_px: (M,) σ of the observations.
        surveyed: (N, 3, 3) information on points that were also surveyed, 1/m²; None: they were not.
    """
    sigma_px, network = sigma_px[has_positive_depth(network)], with_positive_depths(network)
    return eliminate_points(network, 1.0 / sigma_px, surveyed, ridge=_RIDGE)


def _information_of_fixes(anchors: Anchors, cameras: int) -> bsr_matrix:
    """Return the information (6 n, 6 n) of the fixes on the poses."""
    blocks = np.zeros((cameras, 6, 6))
    np.add.at(blocks[:, 3:, 3:], anchors.camera, np.linalg.inv(anchors.cov_fix))
    return bsr_matrix((blocks, np.arange(cameras), np.arange(cameras + 1)), shape=(6 * cameras, 6 * cameras))


IMAGES, MARK_PX = 5, 0.3
FIX = np.diag([0.02, 0.02, 0.03]) ** 2
SURVEY = np.diag([0.01, 0.01, 0.015]) ** 2
CONTROL = np.array([[-6.0, -5, 0], [5, -6, 2], [1, 7, -1]])
CHECK = np.array([[3.0, 2, 1], [-7, 6, 3]])


def seen_by_all(points: np.ndarray) -> Network:
    """The cameras of the exact network with other points, each marked in all images."""
    count = len(points)
    return replace(
        exact_network(images=IMAGES, points=30),
        point_in_world=points,
        obs_point=np.repeat(np.arange(count), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), count),
        obs_xy_px=np.zeros((count * IMAGES, 2)),
    )


def full_bound(check: np.ndarray, control: np.ndarray, fixes: np.ndarray) -> np.ndarray:
    """The lower right block of the inverse of everything's information: ties, control points, one check point."""
    ties = exact_network(images=IMAGES, points=30)
    points = np.concatenate([ties.point_in_world, control, check[None]])
    design = jacobian(seen_by_all(points))
    sigma = np.repeat(np.r_[np.full(30, SIGMA_PX), np.full(len(control) + 1, MARK_PX)], 2 * IMAGES)
    information = (design / sigma[:, None] ** 2).T @ design
    for camera in fixes:
        place = slice(6 * camera + 3, 6 * camera + 6)
        information[place, place] += np.linalg.inv(FIX)
    for j in range(len(control)):
        place = slice(6 * IMAGES + 3 * (30 + j), 6 * IMAGES + 3 * (30 + j) + 3)
        information[place, place] += np.linalg.inv(SURVEY)
    unit = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * unit[:, None] * unit) * unit[:, None] * unit
    place = slice(6 * IMAGES + 3 * (30 + len(control)), 6 * IMAGES + 3 * (30 + len(control)) + 3)
    return inverse[place, place]


@pytest.mark.parametrize(
    ("control", "fixes"),
    [
        (CONTROL[:0], np.arange(IMAGES)),
        (CONTROL, np.arange(IMAGES)),
        (CONTROL, np.arange(0)),
        (CONTROL, np.array([1])),
    ],
    ids=["fixes", "both", "control points", "one fix"],
)
def test_bound_is_the_inverse_of_all_information(control: np.ndarray, fixes: np.ndarray) -> None:
    marks = np.full(IMAGES * len(control), MARK_PX)
    anchors = Anchors(fixes, np.tile(FIX, (len(fixes), 1, 1)))
    if len(control):
        anchors = replace(
            anchors,
            control=seen_by_all(control),
            control_sigma_px=marks,
            cov_control=np.tile(SURVEY, (len(control), 1, 1)),
        )
    information = CameraInformation(exact_network(images=IMAGES, points=30), SIGMA_PX, anchors)
    found = information.bound(seen_by_all(CHECK), np.full(2 * IMAGES, MARK_PX))
    for j in range(2):
        np.testing.assert_allclose(found[j], full_bound(CHECK[j], control, fixes), rtol=2e-3, atol=1e-8)


def test_without_a_tie_to_the_earth_there_is_no_bound() -> None:
    with refused("no-bound", DegenerateGeometryError):
        CameraInformation(
            exact_network(images=IMAGES, points=30), SIGMA_PX, Anchors(np.arange(2), np.tile(FIX, (2, 1, 1)))
        )


def test_a_point_with_one_mark_has_none() -> None:
    anchors = Anchors(np.arange(IMAGES), np.tile(FIX, (IMAGES, 1, 1)))
    information = CameraInformation(exact_network(images=IMAGES, points=30), SIGMA_PX, anchors)
    marks = seen_by_all(CHECK)
    alone = replace(
        marks, obs_point=np.zeros(1, dtype=int), obs_image=np.zeros(1, dtype=int), obs_xy_px=np.zeros((1, 2))
    )
    assert np.isnan(information.bound(alone, np.ones(1))).all()
