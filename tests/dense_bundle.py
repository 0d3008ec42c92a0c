"""Corrections of a bundle's cameras in a dense basis: slow, plain, and the reference of the sparse equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from pipelines.geometry.bundle import BundleInformation


def lens_elimination(bundle: BundleInformation) -> tuple[np.ndarray, np.ndarray]:
    """How the lens follows the poses (L, 6 n), and its information about that (L, L).

    Parameters that no observation reveals have rows of zeros.
    """
    diagonal = np.diag(bundle.sums.lens)
    used = np.flatnonzero(diagonal > 0)  # shorter parameter lists leave empty columns
    scale = 1.0 / np.sqrt(diagonal[used])
    block = bundle.sums.lens[np.ix_(used, used)] * scale[:, None] * scale + 1e-9 * np.eye(len(used))
    follows = np.zeros((len(diagonal), len(bundle.sums.cross)))
    information = np.zeros_like(bundle.sums.lens)
    follows[used] = -scale[:, None] * np.linalg.solve(block, (bundle.sums.cross[:, used] * scale).T)
    information[np.ix_(used, used)] = block / scale[:, None] / scale
    return follows, information


@dataclass(frozen=True)
class DenseBasis:
    """Whitened corrections: (δω, δc) of all cameras = matrix @ z, with z ~ N(0, I) a posteriori.

    A correction that costs the observations χ² = 1 has length one, and a similarity of the whole does not exist.

    `δω` [rad] turns a camera about its centre, axes of the world: `R' = R Exp(−δω)`; `δc` [m] moves the centre.

    The lens parameters correlate with the poses. Their error, (L,) in the order of `geometry.cameras.Lenses`, is
    lens_matrix @ z plus an error that is independent of z.
    """

    matrix: np.ndarray  # (n, 6, k), rows (δω, δc), k = 6 n − 7
    lens_matrix: np.ndarray  # (L, k)


def correction_basis(bundle: BundleInformation, *, lens_follows: bool = True) -> DenseBasis:
    """Return whitened, gauge-free coordinates of the camera corrections of a bundle at its minimum.

    The points define the gauge. Under each correction the points follow the cameras and their lens; the mean
    similarity of this movement, weighted by the information of each point, is zero.

    The uncertainty of the similarity is therefore that of the scene, not that of the cameras' mean. A wrong focal
    length or principal point shows as a common shift of the cameras against a scene that stays. That shift costs
    the images little, and fixes reveal it. Cost O((6 n)³).

    Unless the caller moves the lens by `lens_matrix` with the cameras (`lens_follows`), the lens is frozen, and the
    points follow the cameras alone.
    """
    follows, _ = lens_elimination(bundle)
    root, complement = _root(bundle)
    flat = solve_triangular(root, complement.T, lower=True).T * bundle.unit[:, None]
    poses = len(bundle.unit)
    through_lens = bundle.followed[:, poses:] @ follows if lens_follows else 0.0
    held = flat - bundle.similarity_modes @ ((bundle.followed[:, :poses] + through_lens) @ flat)
    return DenseBasis(held.reshape(-1, 6, flat.shape[1]), follows @ flat)


def _root(bundle: BundleInformation) -> tuple[np.ndarray, np.ndarray]:
    """Return the Cholesky root (k, k) of the information orthogonal to the similarities, and its axes (6 n, k)."""
    follows, lens = lens_elimination(bundle)
    information = bundle.sums.poses.toarray() - follows.T @ lens @ follows
    scaled = (information + information.T) / 2 * bundle.unit[:, None] * bundle.unit
    complement = np.linalg.qr(bundle.similarity_modes / bundle.unit[:, None], mode="complete")[0][:, 7:]
    reduced = complement.T @ scaled @ complement
    reduced += np.eye(len(reduced)) / bundle.loosest_sigma_m**2
    return np.asarray(np.linalg.cholesky(reduced)), complement
