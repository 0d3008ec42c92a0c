"""Posterior of a solved survey: covariances of cameras, lens, and points, from the matrix of the adjustment.

The matrix is stored with the solution: whoever asks for a σ factorises it once, and solves nothing again. A wanted
quantity is described by its derivatives by cameras and lens; points follow from the rays that intersect in them.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import bsr_matrix, csr_matrix, eye, kron

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.system import NormalMatrix
from pipelines.core.errors import InputError
from pipelines.core.files import read_npz
from pipelines.core.products import save_npz
from pipelines.core.types import FloatArray, IntArray, rows_of
from pipelines.geometry.intersection import IntersectionJacobian, intersection_jacobian
from pipelines.geometry.similarity import covariance_at, jacobian_at, moved_pivot, second_moment_at
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import MarkRays
from pipelines.survey.scene import network_of
from pipelines.survey.solution import EarlierDate, Solution


@dataclass(frozen=True)
class CommonRows:
    """Points in common with an earlier date, as the matrix of the adjustment has them: W A of J points.

    W (3 J, 3 J) is their information, robust weights included, and A their derivatives in metres of `geo`.
    """

    point_id: IntArray  # (J,) COLMAP's
    by_poses: csr_matrix  # (3 J, 6 n)
    by_border: FloatArray  # (3 J, b)


@dataclass(frozen=True)
class Posterior:
    """Covariances of a solved survey."""

    solution: Solution
    sparse: SparseModel  # with the solved lenses
    normal: NormalMatrix  # in `model`
    followed: FloatArray  # (7, 6 n + L) mean similarity of the SfM points by corrections of cameras and lens
    lens: IntArray  # (ℓ,) lens parameters among the unknowns, of L in the order of `geometry.cameras.Lenses`
    camera_cov: FloatArray  # (n, 6, 6) of (δθ [rad], δc [m]) of the cameras, along the axes of `geo`
    grid: AccuracyGrid | None = None  # σ over the scene; None: the scene has too few points
    common: CommonRows | None = None  # of a survey that is tied to an earlier date

    @property
    def datum(self) -> FloatArray:
        """Covariance (3, 3) in m² of the error that all positions share beyond the matrix of the adjustment."""
        return np.asarray(np.diag(np.square(self.solution.sigma_datum_m)))

    @property
    def datum_against_points(self) -> FloatArray:
        """The part (3, 3) of `datum` that surveyed points show: none where control points have the same datum."""
        rows = self.solution.measurements
        return np.zeros((3, 3)) if any(row.kind == "control point" and row.used for row in rows) else self.datum

    def of_marked_points(self, point_in_geo: FloatArray, rays: MarkRays) -> FloatArray:
        """Return covariances (J, 3, 3) in m² of points (J, 3) intersected from their marks, with the marks' errors.

        They are those against surveyed points, with `datum_against_points`. NaN for a point that is NaN, or
        that its marks do not determine.
        """
        rays = rows_of(rays, np.flatnonzero(np.isfinite(point_in_geo[rays.point]).all(axis=1)))
        intersected = self._intersected(np.nan_to_num(point_in_geo), rays.point, rays.camera, rays.sigma_px)
        return intersected + self.datum_against_points + self._of_earlier_each(point_in_geo)

    def jointly_of_marked_points(self, point_in_geo: FloatArray, rays: MarkRays) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points (J, 3) that are all determined by their marks.

        The points share the errors of similarity, cameras and lens. Those of the marks are independent.
        """
        jacobian = self._jacobian(point_in_geo, rays.point, rays.camera, rays.sigma_px)
        joint = self.normal.covariance(*self._derivatives(jacobian)) + self._second_order(point_in_geo)
        joint = joint + np.tile(self.datum_against_points, (len(point_in_geo), len(point_in_geo)))
        joint = joint + self._of_earlier(point_in_geo)
        return np.asarray(joint + block_diag(*self._cov_of_marks(jacobian)))

    def of_distances(self, point_in_geo: FloatArray, rays: MarkRays) -> FloatArray:
        """Return the variances (D,) in m² of the distances between marked points 2 i and 2 i + 1 of (2 D, 3).

        A rotation of the whole changes no distance, whatever its size: there is no second-order part.
        """
        jacobian = self._jacobian(point_in_geo, rays.point, rays.camera, rays.sigma_px)
        apart = (point_in_geo[::2] - point_in_geo[1::2])[:, None, :]
        along = apart / np.linalg.norm(apart, axis=2, keepdims=True)
        slope = block_diag(*np.concatenate([along, -along], axis=2))
        by_poses, by_border = self._derivatives(jacobian)
        across = self.normal.covariances(csr_matrix(slope @ by_poses), slope @ by_border, 1)[:, 0, 0]
        earlier = self._of_earlier(point_in_geo)
        across = across + np.diag(slope @ earlier @ slope.T)
        of_marks = self._cov_of_marks(jacobian).reshape(-1, 2, 3, 3).sum(axis=1)
        return np.asarray(across + (along @ of_marks @ np.swapaxes(along, 1, 2))[:, 0, 0])

    def of_scene(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Return the covariance (J, 3, 3) in m² of points (J, 3) of the scene, without errors of marks.

        Each of K rays sees one point from one camera: `point` and `camera` (K,) are indices.
        """
        jacobian = self._jacobian(point_in_geo, point, camera)
        cov = self.normal.covariances(*self._derivatives(jacobian), 3) + self.datum
        return cov + self._of_earlier_each(point_in_geo)

    def jointly_of_scene(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points of the scene; arguments as of `of_scene`."""
        jacobian = self._jacobian(point_in_geo, point, camera)
        joint = self.normal.covariance(*self._derivatives(jacobian)) + self._second_order(point_in_geo)
        joint = joint + np.tile(self.datum, (len(point_in_geo), len(point_in_geo)))
        return joint + self._of_earlier(point_in_geo)

    def of_tie_points(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Return the covariance (J, 3, 3) in m² of tie points, errors of their own image observations included.

        NaN for a point that fewer than two rays see; arguments as of `of_scene`.
        """
        sigma_px = np.full(len(point), np.nan if self.solution.sigma_px is None else self.solution.sigma_px)
        intersected = self._intersected(point_in_geo, point, camera, sigma_px) + self.datum
        return intersected + self._of_earlier_each(point_in_geo)

    def derivatives(
        self, point_in_geo: FloatArray, point: IntArray, camera: IntArray, *, of_tracks: bool = False
    ) -> tuple[csr_matrix, FloatArray, FloatArray]:
        """Return the derivatives (3 J, 6 n), (3 J, b) of points (J, 3) in geo by the unknowns, and a covariance.

        The covariance (J, 3, 3) is that of the marks, which are image observations of the solution `of_tracks`.
        Arguments as of `of_scene`.
        """
        sigma_px = None
        if of_tracks and self.solution.sigma_px is not None:
            sigma_px = np.full(len(point), self.solution.sigma_px)
        jacobian = self._jacobian(point_in_geo, point, camera, sigma_px)
        return *self._derivatives(jacobian), self._cov_of_marks(jacobian)

    def of_lens(self) -> FloatArray | None:
        """Return the covariance (L, L) of the lens parameters, in the order of `geometry.cameras.Lenses`.

        None if the lens was frozen. Parameters that nothing reveals have zeros.
        """
        if not len(self.lens):
            return None
        every = self.followed.shape[1] - self.normal.poses.shape[0]
        covariance = np.zeros((every, every))
        by_border = np.eye(len(self.lens), len(self.normal.corner))
        no_poses = csr_matrix((len(self.lens), self.normal.poses.shape[0]))
        covariance[np.ix_(self.lens, self.lens)] = self.normal.covariance(no_poses, by_border)
        return covariance

    @cached_property
    def of_similarity(self) -> FloatArray:
        """Covariance (7, 7) of (δ ln s, δω, δt) about the pivot of the solution, as in `SimilarityRecord`.

        It is that of the SfM points' mean similarity: of the scene, not of the cameras.
        """
        n = self.normal.poses.shape[0]
        by_border = np.zeros((7, len(self.normal.corner)))
        by_border[:, : len(self.lens)] = self.followed[:, n + self.lens]
        in_model = self.normal.covariance(csr_matrix(self.followed[:, :n]), by_border)
        similarity = self.solution.similarity
        center = similarity.apply(self.solution.poses.cam_center_in_model.mean(axis=0))
        turn = block_diag(1.0, similarity.rotation, similarity.scale * similarity.rotation)
        about = jacobian_at(np.array(self.solution.geo_from_model.pivot)[None], center)[0]
        to_pivot = np.eye(7)
        to_pivot[4:, :4] = about[:, :4]
        by_model = to_pivot @ turn
        covariance = np.asarray(by_model @ in_model @ by_model.T)
        covariance[4:, 4:] += self.datum
        date = self.solution.earlier
        if date is not None:
            covariance = covariance + moved_pivot(date.covariance, date.pivot, self.solution.geo_from_model.pivot)
        return covariance

    def _of_earlier(self, point_in_geo: FloatArray) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) that points (J, 3) take over from an earlier date."""
        date = self.solution.earlier
        if date is None:
            return np.zeros((3 * len(point_in_geo),) * 2)
        by_similarity = jacobian_at(point_in_geo, date.pivot).reshape(-1, 7)
        return np.asarray(by_similarity @ np.array(date.covariance) @ by_similarity.T)

    def _of_earlier_each(self, point_in_geo: FloatArray) -> FloatArray:
        """Return the covariance (J, 3, 3) that each of points (J, 3) takes over, or (3, 3) of zeros."""
        date = self.solution.earlier
        return np.zeros((3, 3)) if date is None else covariance_at(point_in_geo, date.covariance, date.pivot)

    def _intersected(
        self, point_in_geo: FloatArray, point: IntArray, camera: IntArray, sigma_px: FloatArray
    ) -> FloatArray:
        jacobian = self._jacobian(point_in_geo, point, camera, sigma_px)
        cov = self.normal.covariances(*self._derivatives(jacobian), 3) + self._cov_of_marks(jacobian)
        cov[np.bincount(point, minlength=len(cov)) < 2] = np.nan
        return cov

    def _second_order(self, point_in_geo: FloatArray) -> FloatArray:
        """Return the second-order part (3 J, 3 J) of the joint covariance of points (J, 3): that of the similarity.

        Relative positions are known far better than the similarity, so that the square of a rotation can exceed
        their σ.
        """
        pivot = np.array(self.solution.geo_from_model.pivot)
        return second_moment_at(point_in_geo, self.of_similarity, pivot)

    def _jacobian(
        self, point_in_geo: FloatArray, point: IntArray, camera: IntArray, sigma_px: FloatArray | None = None
    ) -> IntersectionJacobian:
        """Return the derivatives, in metres of `model`, of points (J, 3) by the cameras and lens that see them.

        Without the σ of the rays, all of them have the same angular σ.
        """
        in_model = self.solution.similarity.inverse().apply(point_in_geo)
        every = network_of(self.sparse, self.solution.poses, in_model)
        no_pixels = np.full((len(point), 2), np.nan)  # derivatives do not need them
        rays = replace(every, obs_point=point, obs_image=camera, obs_xy_px=no_pixels)
        return intersection_jacobian(rays, self.sparse.focal_px[camera] if sigma_px is None else sigma_px)

    def _derivatives(self, jacobian: IntersectionJacobian) -> tuple[csr_matrix, FloatArray]:
        """Return the derivatives (3 J, 6 n), (3 J, b) of points in geo by the unknowns."""
        axes, count = self._geo_by_model, len(jacobian.by_lens)
        turned = kron(eye(count), axes, format="csr")
        by_border = np.zeros((3 * count, len(self.normal.corner)))
        by_border[:, : len(self.lens)] = (axes @ jacobian.by_lens)[:, :, self.lens].reshape(3 * count, -1)
        return csr_matrix(turned @ jacobian.by_poses), by_border

    def _cov_of_marks(self, jacobian: IntersectionJacobian) -> FloatArray:
        return self._geo_by_model @ jacobian.cov_of_marks @ self._geo_by_model.T

    @property
    def _geo_by_model(self) -> FloatArray:
        """Derivative (3, 3) of positions in `geo` by positions in `model`."""
        return self.solution.similarity.scale * self.solution.similarity.rotation


def camera_covariances(normal: NormalMatrix, turn: FloatArray, scale: float) -> FloatArray:
    """Return the covariance (n, 6, 6) of (δθ [rad], δc [m]) of all cameras, along the axes of `geo`.

    δθ turns a camera about its centre, R_geo_from_cam' = Exp(δθ) R_geo_from_cam, and δc moves its centre. `turn`
    (3, 3) and `scale` are those of geo ← model.
    """
    count = len(normal.position)
    by_pose = np.broadcast_to(block_diag(turn, scale * turn), (count, 6, 6))
    return normal.of_each_camera(np.arange(count), by_pose, np.zeros((count, 6, len(normal.corner))))


def of_earlier_cameras(date: EarlierDate | None, center_in_geo: FloatArray) -> FloatArray:
    """Return the covariance (n, 6, 6) of (δθ, δc) that cameras take over with the places of an earlier date."""
    by_similarity = np.zeros((len(center_in_geo), 6, 7))
    if date is None:
        return np.zeros((len(center_in_geo), 6, 6))
    by_similarity[:, :3, 1:4] = np.eye(3)
    by_similarity[:, 3:] = jacobian_at(center_in_geo, date.pivot)
    return np.asarray(by_similarity @ np.array(date.covariance) @ np.swapaxes(by_similarity, 1, 2))


_ARRAYS = ("data", "indices", "indptr", "border", "corner", "position", "followed", "lens", "camera_cov")
_COMMON = ("common_id", "common_data", "common_indices", "common_indptr", "common_border")


def save_posterior(posterior: Posterior, path: Path) -> None:
    """Write matrix and covariances as NPZ; the solution is a document of its own."""
    normal, grid = posterior.normal, posterior.grid
    poses = normal.poses
    of_matrix = (poses.data, poses.indices, poses.indptr, normal.border, normal.corner, normal.position)
    arrays = (*of_matrix, posterior.followed, posterior.lens, posterior.camera_cov)
    of_grid = dict(AccuracyGrid.NO_ARRAYS if grid is None else grid.arrays())
    common, of_common = posterior.common, {}
    if common is not None:
        rows = common.by_poses
        values = (common.point_id, rows.data, rows.indices, rows.indptr, common.by_border)
        of_common = dict(zip(_COMMON, values, strict=True))
    save_npz(path, dict(zip(_ARRAYS, arrays, strict=True)) | of_grid | of_common)


def load_posterior(path: Path, solution: Solution, sfm: SparseModel) -> Posterior:
    """Read what `save_posterior` has written; `sfm` has SfM's lenses.

    Raises:
        InputError: the file is damaged, of another solution, or stale: an older version has written it.
    """
    of_common = _COMMON if solution.earlier is not None else ()
    try:
        arrays, n = read_npz(path, (*_ARRAYS, *AccuracyGrid.NO_ARRAYS, *of_common)), len(solution.cameras)
    except InputError as error:
        if error.code != "array-missing":
            raise
        message = "is stale: an older version of GeoRefGS has solved this survey, without all covariances."
        remedy = "Run `georef init-sim3` (and `georef train`) again."
        raise InputError("posterior-of-older-version", message, path=path, remedy=remedy) from error
    border, corner, position, followed, lens, camera_cov = (arrays[name] for name in _ARRAYS[3:])
    known, width = len(followed[0]) - 6 * n if followed.ndim == 2 else -1, len(corner)
    fits = (
        border.shape == (width, 6 * n)
        and corner.shape == (width, width)
        and position.shape == (n, 3)
        and followed.shape == (7, 6 * n + known)
        and camera_cov.shape == (n, 6, 6)
        and lens.ndim == 1
        and all(0 <= index < known for index in lens.tolist())
        and len(lens) <= width
        and arrays["data"].shape == (len(arrays["indices"]), 6, 6)
        and arrays["indptr"].shape == (n + 1,)
    )
    rows = 3 * len(arrays["common_id"]) if of_common else 0
    fits = fits and (not of_common or arrays["common_border"].shape == (rows, width))
    if not fits:
        raise InputError(
            "posterior-of-another-solution",
            "does not belong to the solution beside it.",
            path=path,
            remedy="Run `georef init-sim3` (and `georef train`) again.",
        )
    poses = bsr_matrix((arrays["data"], arrays["indices"], arrays["indptr"]), shape=(6 * n, 6 * n))
    normal, sparse = NormalMatrix(poses, border, corner, position), solution.with_lenses(sfm)
    common = None
    if of_common:
        by_poses = csr_matrix(tuple(arrays[name] for name in _COMMON[1:4]), shape=(rows, 6 * n))
        common = CommonRows(arrays["common_id"], by_poses, arrays["common_border"])
    grid = AccuracyGrid.of_arrays(arrays)
    return Posterior(solution, sparse, normal, followed, lens, camera_cov, grid, common)
