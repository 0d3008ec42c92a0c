"""Relative covariance of two dates: that of the difference between the later and the earlier place of a point.

The later date is adjusted onto the earlier one, whose cameras are held at their solution x₁: files were made from
it, and they stay. N₂ is the normal matrix of the later date with the common points, A their derivatives by its
unknowns, and W their weights. An error δx₁ of the earlier solution moves the common points by D δx₁ and the later
unknowns by N₂⁻¹ Aᵀ W D δx₁. The difference of a place, with the derivatives J₂ and J₁, has the covariance

    J₂ N₂⁻¹ J₂ᵀ + L N₁⁻¹ Lᵀ,   L = J₂ N₂⁻¹ Aᵀ W D − J₁.

That is the covariance of this estimate by the information of both dates together. L vanishes for all that the later
date follows: a wrong place, rotation or scale of the earlier one, and a wrong shape where points are dense.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag as dense_block_diag
from scipy.sparse import csr_matrix, hstack, kron
from scipy.sparse import eye as identity
from scipy.spatial import cKDTree

from pipelines.adjust.accuracy_grid import AccuracyGrid, accuracy_grid, seen_by
from pipelines.adjust.posterior import CommonRows, Posterior
from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_enu_rotation, enu_from_ecef, lla_of
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.network import Network, points_of_network
from pipelines.geometry.similarity import Similarity
from pipelines.survey.common_points import CommonPoints
from pipelines.survey.scene import network_of

_NEIGHBOURS = 3  # earlier points whose cameras see a place
_CELLS = 64  # whose responses are computed together


@dataclass(frozen=True)
class Solved:
    """Posterior of a date, with the origin of its `geo`."""

    posterior: Posterior
    origin: Origin

    @cached_property
    def network(self) -> Network:
        """Cameras, points and image observations in `model`, with the solved cameras and SfM's points."""
        solution = self.posterior.solution
        point = Similarity.from_record(solution.model_from_local).apply(self.posterior.sparse.point_in_local)
        return network_of(self.posterior.sparse, solution.poses, point)

    @property
    def point_in_geo(self) -> FloatArray:
        return self.posterior.solution.similarity.apply(self.network.point_in_world)

    def tracks(self, point_id: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the places (J, 3) in geo of points by COLMAP's ids, and point and camera (K,) of their tracks."""
        part = points_of_network(self.network, np.searchsorted(self.posterior.sparse.point_id, point_id))
        point_in_geo = self.posterior.solution.similarity.apply(refined_points(part).point_in_world)
        return point_in_geo, part.obs_point, part.obs_image

    @property
    def sigma_m(self) -> FloatArray:
        """σ (3,) east, north, up, root mean square over the scene."""
        grid = self.posterior.grid
        if grid is None:
            return np.asarray(np.sqrt(np.diag(self.posterior.of_similarity)[4:]))
        return np.asarray(np.sqrt((grid.sigma_m**2).mean(axis=0)))

    @property
    def similarity_in_ecef(self) -> tuple[FloatArray, FloatArray]:
        """Covariance (7, 7) of the similarity along Earth-centred axes, and its pivot (3,)."""
        axes = ecef_from_enu_rotation(lla_of(self.origin))
        turn = dense_block_diag(1.0, axes, axes)
        pivot = np.array(self.posterior.solution.geo_from_model.pivot)
        return np.asarray(turn @ self.posterior.of_similarity @ turn.T), ecef_from_enu(pivot, self.origin)

    def placed(self, point_id: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the Earth-centred places (J, 3) of points by COLMAP's ids, and their covariances (J, 3, 3).

        The covariances are those of the points' own marks; NaN: they do not determine a point.
        """
        point_in_geo, point, camera = self.tracks(point_id)
        _, _, cov = self.posterior.derivatives(point_in_geo, point, camera, of_tracks=True)
        axes = ecef_from_enu_rotation(lla_of(self.origin))
        return ecef_from_enu(point_in_geo, self.origin), np.asarray(axes @ cov @ axes.T)


@dataclass(frozen=True)
class Relative:
    """Two dates that common points tie.

    Attributes:
        position_in_geo: (J, 3) common points in the later `geo`.
        used: (J,) whether a point takes part, as it agrees with the others.
        missed_m: (J, 3) later minus earlier place.
        grid: covariance of the difference over the later scene; None: the scene has too few points.
    """

    position_in_geo: FloatArray
    used: BoolArray
    missed_m: FloatArray
    grid: AccuracyGrid | None


def relative(later: Solved, earlier: Solved, common: CommonPoints) -> Relative:
    """Return what two dates know of each other; the solutions are those that `common` ties.

    Raises:
        InputError: a date is stale, as its points are no longer those that were solved.
    """
    tied = later.posterior.common
    assert tied is not None
    ids = ((tied.point_id, common.point_id), (common.earlier_point_id, earlier.posterior.sparse.point_id))
    if not all(np.isin(*pair).all() for pair in ids):
        message = "The points in common are not those of the solutions: a date is stale, `sfm` ran again since."
        remedy = "Run `georef run` of the later date again."
        raise InputError("common-points-stale", message, remedy=remedy)
    known = np.isin(common.point_id, later.posterior.sparse.point_id)
    point_in_geo, *_ = later.tracks(common.point_id[known])
    missed = point_in_geo - common.position_in_geo(later.origin)[known]
    order = np.argsort(common.point_id)
    row = order[np.searchsorted(common.point_id, tied.point_id, sorter=order)]
    axes = _turn(later.origin, earlier.origin)
    tie = _Tie(later, earlier, tied, axes, _moved_by_earlier(earlier, common.earlier_point_id[row], axes))
    grid = accuracy_grid(later.posterior.sparse, later.point_in_geo, tie.covariance)
    return Relative(point_in_geo, np.isin(common.point_id[known], tied.point_id), missed, grid)


def _finite(matrix: csr_matrix) -> csr_matrix:
    return csr_matrix((np.nan_to_num(matrix.data), matrix.indices, matrix.indptr), shape=matrix.shape)


def _moved_by_earlier(earlier: Solved, point_id: IntArray, axes: FloatArray) -> csr_matrix:
    """Return the derivative (3 J, 6 n + b) of the common points, along the later axes, by the earlier unknowns."""
    point_in_geo, point, camera = earlier.tracks(point_id)
    by_poses, by_border, _ = earlier.posterior.derivatives(point_in_geo, point, camera, of_tracks=True)
    turned = kron(identity(len(point_in_geo)), axes, format="csr")
    return _finite(csr_matrix(turned @ hstack([by_poses, csr_matrix(by_border)])))


@dataclass(frozen=True)
class _Tie:
    later: Solved
    earlier: Solved
    common: CommonRows
    axes: FloatArray  # (3, 3) later geo ← earlier geo
    moved: csr_matrix  # D: (3 J, 6 n' + b') by the earlier unknowns

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.earlier.point_in_geo[:, :2])

    def covariance(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        """Return the covariance (C, 3, 3) of the difference at places (C, 3) that later cameras see."""
        cov = np.empty((len(point_in_geo), 3, 3))
        for first in range(0, len(cov), _CELLS):
            rows = slice(first, min(first + _CELLS, len(cov)))
            chosen = (point >= rows.start) & (point < rows.stop)
            cov[rows] = self._of_part(point_in_geo[rows], point[chosen] - first, camera[chosen])
        return cov

    def _of_part(self, point_in_geo: FloatArray, point: IntArray, camera: IntArray) -> FloatArray:
        normal = self.later.posterior.normal
        by_poses, by_border, _ = self.later.posterior.derivatives(point_in_geo, point, camera)
        of_later = normal.covariances(by_poses, by_border, 3)
        poses, border = normal.solve(by_poses.T.toarray(), by_border.T)
        response = (self.common.by_poses @ poses + self.common.by_border @ border).T  # J₂ N₂⁻¹ Aᵀ W
        there = self._at_earlier(point_in_geo)
        follows = response @ self.moved - there
        count = self.earlier.posterior.normal.poses.shape[0]
        of_earlier = self.earlier.posterior.normal.covariances(
            csr_matrix(follows[:, :count]), np.asarray(follows[:, count:]), 3
        )
        return of_later + of_earlier

    def _at_earlier(self, point_in_geo: FloatArray) -> FloatArray:
        """Return the derivative (3 C, 6 n' + b') of the earlier places, along the later axes."""
        in_earlier = enu_from_ecef(ecef_from_enu(point_in_geo, self.later.origin), self.earlier.origin)
        sparse, posterior = self.earlier.posterior.sparse, self.earlier.posterior
        near = self._tree.query(in_earlier[:, :2], k=[*range(1, min(_NEIGHBOURS, len(sparse.point_id)) + 1)])[1]
        point, camera = seen_by(sparse.obs_point, sparse.obs_image, near)
        by_poses, by_border, _ = posterior.derivatives(in_earlier, point, camera)
        turned = kron(identity(len(point_in_geo)), self.axes, format="csr")
        return np.asarray((turned @ hstack([by_poses, csr_matrix(by_border)])).toarray())


def _turn(later: Origin, earlier: Origin) -> FloatArray:
    """Return the rotation (3, 3) later geo ← earlier geo."""
    return np.asarray(ecef_from_enu_rotation(lla_of(later)).T @ ecef_from_enu_rotation(lla_of(earlier)))
