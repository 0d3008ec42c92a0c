"""Motion of the rows of photographs that no model of the bundle holds, as of a rolling shutter that nobody stated.

A photograph that is read row by row while its camera moves is stretched along its columns and sheared along its
rows. SfM bends cameras and points until that fits: what is left in the residuals is small, the bend is not. Row y
of a photograph of height H is taken as moved by (2 y/H − 1) m, with m (2,) pixels of each photograph:

1. The residuals and their normal equations, points, poses and lens eliminated, give estimates m̂ with covariance C.
   The variances of m along the two axes are those that explain them best (expectation maximisation).
2. Where chance does not explain the residuals, the poses have the additional covariance G (m̂ m̂ᵀ + C) Gᵀ, G the
   response of poses and lens to m: nothing corrects the cameras, so that all of m̂ is their error (a consider
   covariance; Schmidt 1966). In the form of information, with K = m̂ m̂ᵀ + C,

       N ← N − N_am (K⁻¹ + N_ma N⁻¹ N_am)⁻¹ N_ma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.sparse import bsr_matrix

from pipelines.core.types import FloatArray
from pipelines.geometry.network import EliminatedPoints, MoreColumns, Network, eliminate_points

MOST_CAMERAS = 500  # dense matrices of six times as many rows
_LEAST_CAMERAS = 8
_BY_CHANCE = 5.0  # σ of the residuals' gradient by m under independent errors
_LEAST_PART = 0.05  # of the information on a motion, which poses and lens leave
_ROUNDS, _SETTLED = 100, 1e-3
_RIDGE = 1e-9  # of the scaled normal equations, against the seven movements of a similarity


@dataclass(frozen=True)
class RowMotion:
    """Motion of the rows of n photographs, from the middle row to the last.

    Attributes:
        motion_px: m̂ (n, 2).
        information: (2 n, 2 n) of the residuals on all m, in 1/px²; without the variances of m.
        sigma_px: (2,) σ of m along the axes of a photograph.
    """

    motion_px: FloatArray
    information: FloatArray
    sigma_px: FloatArray
    second_moment: FloatArray  # (2 n, 2 n) K
    coupling: FloatArray  # (2 n, 6 n + L) N_ma
    response: FloatArray  # (2 n, 2 n) N_ma N⁻¹ N_am

    def considered(self, sums: EliminatedPoints, variance_factor: float) -> EliminatedPoints:
        """Return the information with the error that the motion leaves in poses and lens.

        All other errors have a variance that is larger by the factor.
        """
        value, vector = np.linalg.eigh(self.second_moment)
        root = vector * np.sqrt(np.maximum(value, 0.0))
        through = root.T @ self.coupling
        all_motion = variance_factor * np.eye(len(root)) + root.T @ self.response @ root
        lost = through.T @ np.linalg.solve(all_motion, through) / variance_factor
        sums = sums.scaled(1.0 / variance_factor)
        poses = sums.poses.toarray()
        n = len(poses)
        return replace(
            sums,
            poses=bsr_matrix(poses - lost[:n, :n], blocksize=(6, 6)),
            cross=sums.cross - lost[:n, n:],
            lens=sums.lens - lost[n:, n:],
        )


def with_row_motion(
    network: Network, root_weight: FloatArray, residual_px: FloatArray
) -> tuple[EliminatedPoints, RowMotion | None]:
    """Return the normal equations of poses and lens of a network, and the motion of its rows; None: chance.

    The residuals (M, 2) are projected minus observed, with inverse σ (M,) in 1/px.
    """
    n = len(network.camera_id)
    if not _LEAST_CAMERAS <= n <= MOST_CAMERAS:
        return eliminate_points(network, root_weight), None
    height = np.array([network.cameras[key].height for key in network.camera_id.tolist()])[network.obs_image]
    row = 2.0 * network.obs_xy_px[:, 1] / height - 1.0
    more = MoreColumns(row[:, None, None] * np.eye(2), residual_px)
    whole = eliminate_points(network, root_weight, more=more)
    index = np.arange(8 * n).reshape(n, 8)
    pose, motion = index[:, :6].ravel(), index[:, 6:].ravel()
    every = whole.poses.tocsr()
    sums = EliminatedPoints(
        poses=bsr_matrix(every[pose][:, pose], blocksize=(6, 6)),
        cross=whole.cross[pose, :-1],
        lens=whole.lens[:-1, :-1],
        pose_modes=whole.pose_modes[pose],
        lens_modes=whole.lens_modes[:-1],
        modes=whole.modes,
    )
    coupling = np.concatenate([every[motion][:, pose].toarray(), whole.cross[motion, :-1]], axis=1)
    motion_motion, gradient = (
        every[motion][:, motion].toarray(),
        np.concatenate([whole.cross[pose, -1], whole.lens[:-1, -1]]),
    )
    return sums, _estimated(sums, motion_motion, coupling, gradient, whole.cross[motion, -1])


def _estimated(
    sums: EliminatedPoints,
    motion_motion: FloatArray,
    coupling: FloatArray,
    gradient: FloatArray,
    by_motion: FloatArray,
) -> RowMotion | None:
    """Return the motion of the rows from its information (2 n, 2 n), and gradients by poses and lens, and by m."""
    information = np.block([[sums.poses.toarray(), sums.cross], [sums.cross.T, sums.lens]])
    diagonal = np.diag(information)
    used = np.flatnonzero(diagonal > 0)
    scale = 1.0 / np.sqrt(diagonal[used])
    scaled = information[np.ix_(used, used)] * scale[:, None] * scale + _RIDGE * np.eye(len(used))
    scaled_coupling = coupling[:, used] * scale
    follows = cho_solve(cho_factor(scaled), scaled_coupling.T)
    response = scaled_coupling @ follows
    left, slope = _observed(
        motion_motion, motion_motion - response, by_motion - follows.T @ (gradient[used] * scale)
    )
    spread2 = float((left**2).sum())
    excess = float(slope @ slope - np.trace(left))
    if spread2 <= 0 or excess <= _BY_CHANCE * (2.0 * spread2) ** 0.5:
        return None
    variance = np.full(2, excess / spread2)
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(left + np.diag(1.0 / np.tile(variance, len(left) // 2)))
        motion = -covariance @ slope
        before, second = variance, motion**2 + np.diag(covariance)
        variance = second.reshape(-1, 2).mean(axis=0)
        if (np.abs(variance - before) <= _SETTLED * before.max()).all():
            break
    return RowMotion(
        motion_px=motion.reshape(-1, 2),
        information=left,
        sigma_px=np.sqrt(variance),
        second_moment=np.outer(motion, motion) + covariance,
        coupling=coupling,
        response=response,
    )


def _observed(motion_motion: FloatArray, reduced: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return information (2 n, 2 n) and gradient (2 n,) along what poses and lens do not take up.

    The motion that all photographs of parallel lines share is taken up nearly as a whole. What is left of it in the
    residuals is no measurement, but how near to its minimum SfM has ended.
    """
    part, axes = eigh(
        (reduced + reduced.T) / 2,
        motion_motion + _RIDGE * np.trace(motion_motion) / len(motion_motion) * np.eye(len(motion_motion)),
    )
    seen = part > _LEAST_PART
    across = motion_motion @ axes[:, seen]
    return across * part[seen] @ across.T, across @ (axes[:, seen].T @ slope)
