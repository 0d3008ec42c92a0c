"""Whitened corrections of the camera poses: a dense root of the bundle's covariance.

The inverse square root of the bundle's information gives coordinates with two properties:

1. A correction that costs the observations χ² = 1 has length one.
2. The seven movements that no observation resists, those of a similarity of the whole, do not exist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from pipelines.core.types import FloatArray
from pipelines.geometry.bundle import BundleInformation

_COPIES = 4  # information, its factor, the basis, and a Jacobian or a normal matrix of the same size


def predicted_basis_bytes(cameras: int) -> int:
    """Return the peak of memory of a dense basis and of the normal equations in it."""
    return _COPIES * 8 * (6 * cameras) ** 2


@dataclass(frozen=True)
class CorrectionBasis:
    """Whitened corrections: (δω, δc) of all cameras = matrix @ z, with z ~ N(0, I) a posteriori.

    `δω` [rad] turns a camera about its centre, axes of the world: `R' = R Exp(−δω)`; `δc` [m] moves the centre.

    The lens parameters correlate with the poses. Their error, (L,) in the order of `geometry.cameras.Lenses`, is
    lens_matrix @ z plus an error that is independent of z.
    """

    matrix: FloatArray  # (n, 6, k), rows (δω, δc), k = 6 n − 7
    lens_matrix: FloatArray  # (L, k)


def correction_basis(bundle: BundleInformation, *, lens_follows: bool = True) -> CorrectionBasis:
    """Return whitened, gauge-free coordinates of the camera corrections of a bundle at its minimum.

    The points define the gauge. Under each correction the points follow the cameras and their lens; the mean
    similarity of this movement, weighted by the information of each point, is zero.

    The uncertainty of the similarity is therefore that of the scene, not that of the cameras' mean. A wrong focal
    length or principal point shows as a common shift of the cameras against a scene that stays. That shift costs
    the images little, and fixes reveal it. Cost O((6 n)³).

    Args:
        lens_follows: whether the caller moves the lens by `lens_matrix` with the cameras. Otherwise the lens is
            frozen, and the points follow the cameras alone.
    """
    follows, _ = bundle.lens_elimination
    root, complement = _root(bundle)
    flat = solve_triangular(root, complement.T, lower=True).T * bundle.unit[:, None]
    poses = len(bundle.unit)
    through_lens = bundle.followed[:, poses:] @ follows if lens_follows else 0.0
    held = flat - bundle.similarity_modes @ ((bundle.followed[:, :poses] + through_lens) @ flat)
    return CorrectionBasis(held.reshape(-1, 6, flat.shape[1]), follows @ flat)


def coordinates_of(bundle: BundleInformation, correction: FloatArray) -> FloatArray:
    """Return the coordinates z (k,) of corrections (n, 6) in the basis; their common similarity is dropped."""
    root, complement = _root(bundle)
    return np.asarray(root.T @ (complement.T @ (correction.ravel() / bundle.unit)))


def _root(bundle: BundleInformation) -> tuple[FloatArray, FloatArray]:
    """Return the Cholesky root (k, k) of the information orthogonal to the similarities, and its axes (6 n, k)."""
    follows, lens = bundle.lens_elimination
    information = bundle.sums.poses.toarray() - follows.T @ lens @ follows
    scaled = (information + information.T) / 2 * bundle.unit[:, None] * bundle.unit
    complement = np.linalg.qr(bundle.similarity_modes / bundle.unit[:, None], mode="complete")[0][:, 7:]
    reduced = complement.T @ scaled @ complement
    reduced += np.eye(len(reduced)) / bundle.loosest_sigma_m**2
    return np.asarray(np.linalg.cholesky(reduced)), complement
