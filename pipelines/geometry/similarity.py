"""Similarities of space: p_to = s R p_from + t, with composition, inverse and uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Product, Rotation
from pipelines.core.types import FloatArray, Row7, Vector3
from pipelines.geometry.rotations import exp_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix, skew


@dataclass(frozen=True)
class Similarity:
    """`to_from_from`: scale (> 0), rotation (3, 3), translation (3,), in float64."""

    scale: float = 1.0
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))

    def apply(self, points: ArrayLike) -> FloatArray:
        """Map points (…, 3)."""
        return self.scale * np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def __matmul__(self, other: Similarity) -> Similarity:
        """Composition: `c_from_b @ b_from_a = c_from_a`."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def matrix(self) -> FloatArray:
        """Return the matrix (4, 4) for homogeneous points."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    @classmethod
    def from_record(cls, record: SimilarityRecord) -> Similarity:
        return cls(record.scale, matrix_from_quat_xyzw(record.quat_xyzw), np.array(record.translation))

    def to_record(
        self,
        from_frame: str,
        to_frame: str,
        *,
        covariance: FloatArray | None = None,
        pivot: ArrayLike = (0.0, 0.0, 0.0),
    ) -> SimilarityRecord:
        """Stored form; see `SimilarityRecord` for the meaning of covariance (7, 7) and pivot."""
        cov = np.zeros((7, 7)) if covariance is None else covariance
        return SimilarityRecord(
            from_frame=from_frame,
            to_frame=to_frame,
            scale=float(self.scale),
            quat_xyzw=tuple(quat_xyzw_from_matrix(self.rotation).tolist()),
            translation=tuple(self.translation.tolist()),
            pivot=tuple(np.asarray(pivot, dtype=np.float64).tolist()),
            covariance=tuple(tuple(row) for row in cov.tolist()),
        )


def perturbation(delta: FloatArray, pivot: FloatArray) -> Similarity:
    """Return p' = pivot + δt + e^{δ ln s} Exp(δω) (p − pivot) of delta (δ ln s, δω, δt) (7,) and pivot (3,)."""
    scale, turn = float(np.exp(delta[0])), exp_so3(delta[1:4])
    return Similarity(scale, turn, pivot + delta[4:7] - scale * turn @ pivot)


def jacobian_at(points: ArrayLike, pivot: ArrayLike) -> FloatArray:
    """∂p'/∂(δ ln s, δω, δt) at points (N, 3) in the target frame, for a perturbation about `pivot`: (N, 3, 7)."""
    arm = np.asarray(points, dtype=np.float64) - np.asarray(pivot, dtype=np.float64)
    identity = np.broadcast_to(np.eye(3), (*arm.shape, 3))
    return np.concatenate([arm[..., None], -skew(arm), identity], axis=-1)


def covariance_at(points: ArrayLike, covariance: ArrayLike, pivot: ArrayLike) -> FloatArray:
    """Covariance (N, 3, 3) that a similarity's uncertainty causes at points (N, 3) in the target frame."""
    jacobian = jacobian_at(points, pivot)
    return jacobian @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(jacobian, -1, -2)


def second_moment_at(points: ArrayLike, covariance: ArrayLike, pivot: ArrayLike) -> FloatArray:
    """Return the second moment (3 N, 3 N) of the second-order errors that an uncertain similarity causes.

    With A = δ ln s I + [δω]× the error is ½ A² (p − pivot), quadratic in Gaussian parameters (Isserlis' theorem).
    Points (N, 3), covariance (7, 7) of (δ ln s, δω, δt) and pivot (3,) are those of `covariance_at`.
    """
    arm = np.asarray(points, dtype=np.float64) - np.asarray(pivot, dtype=np.float64)
    cov = np.asarray(covariance, dtype=np.float64)[:4, :4]
    generators = np.concatenate([np.eye(3)[None], skew(np.eye(3))])
    by_squares = np.einsum("iab,jbc,nc->naij", generators, generators, arm).reshape(-1, 4, 4) / 2
    moments = np.einsum("ij,kl->ijkl", cov, cov)
    moments = moments + np.einsum("ik,jl->ijkl", cov, cov) + np.einsum("il,jk->ijkl", cov, cov)
    flat = by_squares.reshape(-1, 16)
    return np.asarray(flat @ moments.reshape(16, 16) @ flat.T)


def moved_pivot(covariance: ArrayLike, pivot: ArrayLike, new_pivot: ArrayLike) -> FloatArray:
    """The same uncertainty (7, 7), expressed about another pivot."""
    transfer = np.eye(7)
    arm = np.asarray(new_pivot, dtype=np.float64) - np.asarray(pivot, dtype=np.float64)
    transfer[4:, 0], transfer[4:, 1:4] = arm, -skew(arm)
    return transfer @ np.asarray(covariance, dtype=np.float64) @ transfer.T


def umeyama(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> Similarity:
    """Least-squares similarity that maps source (N, 3) onto target (N, 3), weighted by `weights` (N,).

    GeoRefGS eqs 16–21 (doi 10.3390/drones10030195); the reflection guard is that of Umeyama
    (doi 10.1109/34.88573). The scale is the trace form, which is the least-squares one also for noisy points;
    the paper's ratio of spreads (eq. 18) is `spread_ratio_similarity`.

    Raises:
        DegenerateGeometryError: fewer than 3 points, or all on one line.
    """
    p, q, w = _checked(source, target, weights)
    p0, q0 = p - w @ p, q - w @ q
    u, singular, vt = np.linalg.svd((p0 * w[:, None]).T @ q0)  # eq. 19: H = Σ (p−p̄)(q−q̄)ᵀ = U Σ Vᵀ
    if singular[1] <= 1e-12 * max(singular[0], np.finfo(float).tiny):
        message = "The points lie on one line: the rotation about it is not determined."
        raise DegenerateGeometryError("points-on-a-line", message)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ np.diag(sign) @ u.T  # eq. 20
    scale = float((singular * sign).sum() / (w @ (p0**2).sum(axis=1)))
    return Similarity(scale, rotation, w @ q - scale * rotation @ (w @ p))  # eq. 21


def spread_ratio_similarity(source: ArrayLike, target: ArrayLike) -> Similarity:
    """The paper's closed form: scale from the ratio of spreads (eq. 18), rotation and translation as `umeyama`.

    Raises:
        DegenerateGeometryError: as `umeyama`.
    """
    fitted = umeyama(source, target)
    p, q, w = _checked(source, target, None)
    p0, q0 = p - w @ p, q - w @ q
    scale = float(np.sqrt((q0**2).sum() / (p0**2).sum()))
    return Similarity(scale, fitted.rotation, w @ q - scale * fitted.rotation @ (w @ p))


def _checked(
    source: ArrayLike, target: ArrayLike, weights: ArrayLike | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    p, q = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if p.shape != q.shape or p.ndim != 2 or p.shape[1] != 3:
        raise ValueError(f"expected two arrays of shape (N, 3), got {p.shape} and {q.shape}")
    if len(p) < 3:
        message = f"A similarity needs at least 3 points; there are {len(p)}."
        raise DegenerateGeometryError("too-few-points", message)
    w = np.ones(len(p)) if weights is None else np.asarray(weights, dtype=np.float64)
    return p, q, w / w.sum()


class SimilarityRecord(Product):
    """A similarity `p_to = scale · R(quat_xyzw) p_from + translation` with its uncertainty.

    `covariance` is 7×7 over (δ ln s, δω [rad], δt [m]) of a perturbation applied in the target frame about
    `pivot`: `p' = pivot + δt + e^{δ ln s} Exp(δω) (p − pivot)`.
    """

    from_frame: str
    to_frame: str
    scale: float = Field(gt=0)
    quat_xyzw: Rotation
    translation: Vector3
    pivot: Vector3 = (0.0, 0.0, 0.0)
    covariance: Annotated[tuple[Row7, ...], Field(min_length=7, max_length=7)]
