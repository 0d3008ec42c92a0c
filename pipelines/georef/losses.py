"""Geographic losses (GeoRefGS section 2.4, doi 10.3390/drones10030195), in float64.

Residuals are whitened by their covariance, so that each term is half of a χ² and the whole a maximum a posteriori
estimate; `paper` takes plain mean squares in metres instead. A Cauchy kernel bounds what one bad fix can do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pipelines.georef.cameras import CameraCorrections
from pipelines.georef.similarity import LearnableSimilarity

Weighting = Literal["whitened", "paper"]

# Cauchy's scale² for residuals of three degrees of freedom: χ²₃ at 95 %.
CAUCHY_SCALE2 = 7.815


def cauchy(chi2: Tensor) -> Tensor:
    """Cauchy's ρ of squared whitened residuals (N,): c² ln(1 + χ²/c²)."""
    return CAUCHY_SCALE2 * torch.log1p(chi2 / CAUCHY_SCALE2)


@dataclass(frozen=True)
class Fixes:
    """Measured centres of F training cameras.

    Attributes:
        camera: (F,) int64 index into the cameras.
        position_in_geo: (F, 3) float64 metres.
        root_information: (F, 3, 3) float64, W with WᵀW = Σ⁻¹.
    """

    camera: Tensor
    position_in_geo: Tensor
    root_information: Tensor


@dataclass(frozen=True)
class ControlMarks:
    """Image marks of J control points, K in all.

    Attributes:
        point: (K,) int64 index into the points.
        camera: (K,) int64 index into the cameras.
        bearing_in_cam: (K, 3) float64 unit vectors.
        sigma_rad: (K,) float64 angular σ of a mark.
        position_in_geo: (J, 3) float64 metres, surveyed.
        root_information: (J, 3, 3) float64 of survey and intersection together.
    """

    point: Tensor
    camera: Tensor
    bearing_in_cam: Tensor
    sigma_rad: Tensor
    position_in_geo: Tensor
    root_information: Tensor


def rising_weight(iteration: int, w_max: float, tau: float) -> float:
    """w(t) = w_max (1 − exp(−t/τ)), GeoRefGS eq. 27."""
    return w_max * (1.0 - math.exp(-iteration / tau))


def absolute_loss(
    similarity: LearnableSimilarity, cameras: CameraCorrections, fixes: Fixes, weighting: Weighting
) -> Tensor:
    """L_abs = 1/N Σ ρ(|T(c_i) − C_i|²) over the fixes; scalar."""
    residual = similarity(cameras.centers()[fixes.camera]) - fixes.position_in_geo
    return _mean_rho(residual, fixes.root_information, weighting)


def control_point_loss(
    similarity: LearnableSimilarity, cameras: CameraCorrections, marks: ControlMarks, weighting: Weighting
) -> Tensor:
    """L_gcp = 1/M Σ ρ(|T(x_j) − X_j|²), x_j intersected from its marks and the current cameras; scalar."""
    residual = similarity(intersect(cameras, marks)) - marks.position_in_geo
    return _mean_rho(residual, marks.root_information, weighting)


def intersect(cameras: CameraCorrections, marks: ControlMarks) -> Tensor:
    """Points (J, 3) in `model` nearest to the rays of their marks, differentiable in the cameras.

    Rays are weighted by the inverse of their lateral σ at the point (angular σ × distance); GeoRefGS eqs 4–8.
    """
    rotation, center = cameras.rotations()[marks.camera], cameras.centers()[marks.camera]
    direction = (rotation.transpose(1, 2) @ marks.bearing_in_cam[:, :, None])[:, :, 0]
    projector = torch.eye(3, dtype=direction.dtype, device=direction.device) - (
        direction[:, :, None] * direction[:, None, :]
    )
    weight = 1.0 / marks.sigma_rad**2
    point = torch.zeros(0)
    for _ in range(2):  # the second pass knows the distances
        normal = _sum_by_point(weight[:, None, None] * projector, marks)
        right = _sum_by_point(weight[:, None, None] * (projector @ center[:, :, None]), marks)
        point = torch.linalg.solve_ex(normal, right).result[:, :, 0]  # `solve` would wait for the device
        distance = (point[marks.point] - center).norm(dim=1)
        weight = 1.0 / (marks.sigma_rad * distance) ** 2
    return point


def _sum_by_point(terms: Tensor, marks: ControlMarks) -> Tensor:
    total = torch.zeros((len(marks.position_in_geo), *terms.shape[1:]), dtype=terms.dtype, device=terms.device)
    return total.index_add(0, marks.point, terms)


def _mean_rho(residual: Tensor, root_information: Tensor, weighting: Weighting) -> Tensor:
    if weighting == "paper":
        return residual.square().sum(dim=1).mean()
    white = (root_information @ residual[:, :, None])[:, :, 0]
    return cauchy(white.square().sum(dim=1)).mean()
