"""Residuals and losses of the measurements (GeoRefGS section 2.4, doi 10.3390/drones10030195), in float64.

Residuals are whitened by their covariance, so that each term is half of a χ² and the whole a maximum a posteriori
estimate; `paper` takes plain mean squares in metres instead. A Cauchy kernel bounds what one bad fix can do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pipelines.georef.measured import Attitudes, ControlMarks, Fixes, Pairs
from pipelines.georef.similarity import Mapping, exp_so3, log_so3
from pipelines.georef.systematic import Errors

Weighting = Literal["whitened", "paper"]
Schedule = Literal["rising", "constant"]

# Cauchy's scale² for residuals of one and of three degrees of freedom: χ² at 95 %.
CAUCHY_SCALE2 = 7.815
CAUCHY_SCALE2_OF_ONE = 3.841


def cauchy(chi2: Tensor, scale2: float = CAUCHY_SCALE2) -> Tensor:
    """Cauchy's ρ of squared whitened residuals (N,): c² ln(1 + χ²/c²)."""
    return scale2 * torch.log1p(chi2 / scale2)


def rising_weight(iteration: int, w_max: float, tau: float) -> float:
    """w(t) = w_max (1 − exp(−t/τ)), GeoRefGS eq. 27."""
    return w_max * (1.0 - math.exp(-iteration / tau))


@dataclass(frozen=True)
class Estimate:
    """Everything that the measurements are compared with.

    Attributes:
        rotation: (n, 3, 3) cam ← model.
        center: (n, 3) projection centres in `model`.
        geo_from_model: the similarity.
        errors: constant errors of the measurements.
        lens: (L,) change of the lens parameters; L = 0 where the lens stays.
    """

    rotation: Tensor
    center: Tensor
    geo_from_model: Mapping
    errors: Errors
    lens: Tensor

    def geo_from_cam(self, camera: Tensor) -> Tensor:
        """Rotations (K, 3, 3) of cameras (K,)."""
        return self.geo_from_model.rotation @ self.rotation[camera].transpose(1, 2)


def fix_residuals(at: Estimate, fixes: Fixes) -> Tensor:
    """T(c_i) + lever arm + bias − C_i (F, 3) in metres: the residuals of L_abs."""
    predicted = at.geo_from_model.apply(at.center[fixes.camera])
    if at.errors.arm_m is not None:
        predicted = predicted + at.geo_from_cam(fixes.camera) @ at.errors.arm_m
    if at.errors.bias_m is not None:
        predicted = predicted + (at.errors.bias_m[0] if fixes.flight is None else at.errors.bias_m[fixes.flight])
    return predicted - fixes.position_in_geo


def control_residuals(at: Estimate, marks: ControlMarks) -> Tensor:
    """T(x_j) − X_j (J, 3) in metres, x_j intersected from its marks and the cameras: the residuals of L_gcp."""
    return at.geo_from_model.apply(intersect(at, marks)) - marks.position_in_geo


def depth_residuals(
    pose: tuple[Tensor, Tensor], geo_from_model: Mapping, position_in_geo: Tensor, xy: Tensor, depth_m: Tensor
) -> Tensor:
    """T(c_i + R_iᵀ z (x, y, 1)) − X_j (K, 3) in metres of the K marks of one camera: L_gcp by depth.

    Args:
        pose: rotation cam ← model (3, 3) and centre (3,) of that camera.
        geo_from_model: the similarity.
        position_in_geo: (K, 3) surveyed, of each mark.
        xy: (K, 2) x/z and y/z of the marks' rays.
        depth_m: (K,) rendered depth along the camera's z axis at the marks.
    """
    rotation, center = pose
    ray = torch.nn.functional.pad(xy, (0, 1), value=1.0)
    point = center + (depth_m[:, None] * ray) @ rotation
    return geo_from_model.apply(point) - position_in_geo


def attitude_residuals(at: Estimate, attitudes: Attitudes) -> Tensor:
    """Log(R_iᵀ G_i B) (A, 3) in radians: what turns a camera into its recorded axes, less the boresight; L_att."""
    found = at.geo_from_cam(attitudes.camera)
    recorded = attitudes.geo_from_cam
    if at.errors.common_rad is not None:
        found = exp_so3(at.errors.common_rad) @ found
    if at.errors.boresight_rad is not None:
        recorded = recorded @ exp_so3(at.errors.boresight_rad)
    return log_so3(found.transpose(1, 2) @ recorded)


def pair_residuals(at: Estimate, pairs: Pairs) -> Tensor:
    """s |x_i − x_j| − |X_i − X_j| (P,) in metres: the residuals of L_rel.

    Points stay where SfM put them. They would follow the cameras' corrections; but these are such that the points
    keep their mean place, turn and size (`geometry.bundle.correction_basis`), so that fixed ones are right to first
    order for what the pairs can say: the scale.
    """
    if pairs.camera is None:
        assert pairs.distance_in_model is not None
        distance = pairs.distance_in_model
    else:
        distance = (at.center[pairs.camera[:, 0]] - at.center[pairs.camera[:, 1]]).norm(dim=1)
    return at.geo_from_model.scale * distance - pairs.distance_in_geo


def intersect(at: Estimate, marks: ControlMarks) -> Tensor:
    """Points (J, 3) in `model` nearest to the rays of their marks, differentiable in the cameras and the lens.

    Rays are weighted by the inverse of their lateral σ at the point (angular σ × distance); GeoRefGS eqs 4–8.
    """
    rotation, center = at.rotation[marks.camera], at.center[marks.camera]
    direction = (rotation.transpose(1, 2) @ marks.bearings(at.lens)[:, :, None])[:, :, 0]
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
