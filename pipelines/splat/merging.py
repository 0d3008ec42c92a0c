"""Merging of Gaussians into fewer and larger ones, whose moments are kept.

A Gaussian counts with its mass: opacity times the area of its shadow, averaged over all directions. That is the
light which it takes away from a distant viewer. Merging keeps the sum of the masses, and, weighted by mass, the
mean, the covariance (that of the mixture, by the law of total covariance) and the harmonics. Moments of moments are
those of the whole, so that levels of detail can be merged from one another without drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix

# Thomsen's formula for the surface of an ellipsoid, which is four times its mean shadow (Cauchy), within 1.1 %.
_THOMSEN = 1.6075
_LEAST_MASS = 1e-300
_LOG_SCALES = (-20.0, 20.0)  # a file may state more, with which nobody can calculate
_MOST_OPACITY = 0.99
# Mass that an opaque Gaussian of the mixture's covariance cannot take makes it larger, by at most this factor of
# its variance: an opaque surface in cells of edge h has σ = h / √12 in each, and is closed again at σ = h / √3.
_MOST_GROWTH = 4.0
# A viewer shows no Gaussian whose σ is less than about a third of a pixel. In the farthest view of a level, a cell
# is at least a pixel wide (see `level_of_detail`).
_LEAST_SIGMA_CELLS = 0.35


@dataclass(frozen=True)
class Mixture:
    """Moments of N groups of Gaussians.

    Attributes:
        mass: (N,) opacity times area, m².
        means: (N, 3) metres.
        covariances: (N, 3, 3) m².
        sh: (N, K, 3).
    """

    mass: FloatArray
    means: FloatArray
    covariances: FloatArray
    sh: Float32Array

    def __len__(self) -> int:
        return len(self.mass)

    @property
    def sizes_m(self) -> FloatArray:
        """Root of the trace of the covariances (N,): between one and √3 times the largest σ."""
        return np.asarray(np.sqrt(np.einsum("nii->n", self.covariances)))

    def select(self, index: IntArray) -> Mixture:
        """Return copies of the rows (M,)."""
        return Mixture(**{name: values[index] for name, values in vars(self).items()})

    @staticmethod
    def concatenate(parts: list[Mixture]) -> Mixture:
        """Return all rows of `parts`, in order."""
        names = vars(parts[0])
        return Mixture(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def shadow_areas(sigmas: FloatArray) -> FloatArray:
    """Return the integrals (N,) of the shadows of Gaussians of opacity 1, averaged over all directions.

    A Gaussian that is σ wide in every direction has the shadow 2π σ².

    Args:
        sigmas: (N, 3) standard deviations along the principal axes.
    """
    a, b, c = sigmas.T
    products = np.stack([a * b, b * c, c * a])
    largest = np.maximum(products.max(axis=0), np.finfo(np.float64).tiny)
    mean = ((products / largest) ** _THOMSEN).mean(axis=0) ** (1 / _THOMSEN)
    return np.asarray(2 * np.pi * largest * mean)


def mixture_of(splat: SplatArrays) -> Mixture:
    """Return each Gaussian as a group of its own."""
    sigmas = np.exp(np.clip(splat.log_scales.astype(np.float64), *_LOG_SCALES))
    opacities = 0.5 + 0.5 * np.tanh(0.5 * splat.logit_opacities.astype(np.float64))
    axes = matrix_from_quat_xyzw(np.roll(splat.quats_wxyz, -1, axis=1)) * sigmas[:, None]
    return Mixture(
        mass=np.maximum(opacities * shadow_areas(sigmas), _LEAST_MASS),
        means=splat.means.astype(np.float64),
        covariances=axes @ axes.transpose(0, 2, 1),
        sh=splat.sh,
    )


def merged(mixture: Mixture, starts: IntArray) -> Mixture:
    """Return the moments of groups of successive rows.

    Args:
        mixture: N rows.
        starts: (G,) the first row of each group, ascending from 0.
    """
    mass = np.add.reduceat(mixture.mass, starts)
    group = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(mixture)))
    weight = mixture.mass / mass[group]
    means = np.add.reduceat(weight[:, None] * mixture.means, starts)
    arm = mixture.means - means[group]
    second = mixture.covariances + arm[:, :, None] * arm[:, None, :]
    return Mixture(
        mass=mass,
        means=means,
        covariances=np.add.reduceat(weight[:, None, None] * second, starts),
        sh=np.add.reduceat(weight[:, None, None].astype(np.float32) * mixture.sh, starts),
    )


def drawn(mixture: Mixture, cell_m: float) -> SplatArrays:
    """Return Gaussians that show the groups of a level.

    The opacity is mass over area. A group with more mass than an opaque Gaussian of its covariance takes, and one
    too small to be shown, is enlarged evenly; where the limit of growth is met, its mass is cut.

    Args:
        mixture: N groups.
        cell_m: edge of the cells in which they were merged.
    """
    variances, axes = np.linalg.eigh(mixture.covariances)
    sigmas = np.sqrt(np.maximum(variances, 1e-12 * np.maximum(variances[:, 2:], 1e-30)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    excess = mixture.mass / (_MOST_OPACITY * shadow_areas(sigmas))
    growth = np.sqrt(np.clip(excess, 1, _MOST_GROWTH))
    growth = np.maximum(growth, _LEAST_SIGMA_CELLS * cell_m / sigmas[:, 2])
    sigmas = sigmas * growth[:, None]
    opacity = np.clip(mixture.mass / shadow_areas(sigmas), 1e-12, _MOST_OPACITY)
    return SplatArrays(
        means=mixture.means.astype(np.float32),
        quats_wxyz=np.roll(quat_xyzw_from_matrix(axes), 1, axis=1).astype(np.float32),
        log_scales=np.log(sigmas).astype(np.float32),
        logit_opacities=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh=mixture.sh,
    )


def bounds_of(mixture: Mixture, sigmas: float = 3.0) -> FloatArray:
    """Return the box (2, 3), least and largest coordinates, of Gaussians up to a multiple of their σ."""
    reach = sigmas * np.sqrt(np.einsum("nii->ni", mixture.covariances))
    return np.stack([(mixture.means - reach).min(axis=0), (mixture.means + reach).max(axis=0)])
