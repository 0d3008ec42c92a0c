"""Discs on a surface: flat Gaussians whose centres are points of it."""

from __future__ import annotations

import numpy as np
import torch

from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.sh import coefficient_count, sh_from_rgb

# In spacings. Wider discs hide more of the places behind them, so that a reader of depths meets a centre too near.
# Narrower ones leave gaps. Between four discs, the transmittance is (1 − 0.9 exp(−1/4 / 0.5²))⁴ = 0.2.
_SIGMA = 0.5
_THICKNESS = 0.05  # in spacings
_OPACITY = 0.9


def surface_discs(
    point_in_model: FloatArray, normal_in_model: FloatArray, rgb: ByteArray, spacing_m: float, sh_degree: int
) -> Gaussians:
    """Return a disc of one colour at each point of a surface.

    Args:
        point_in_model: (P, 3) metres, about `spacing_m` apart.
        normal_in_model: (P, 3) unit vectors.
        rgb: (P, 3) colours.
        spacing_m: between neighbouring points, in units of `model`.
        sh_degree: of the harmonics; those above degree 0 are zero.
    """
    count = len(point_in_model)
    aside = np.eye(3)[np.abs(normal_in_model).argmin(axis=1)]
    first = np.cross(aside, normal_in_model)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal_in_model, first), normal_in_model], axis=2)
    sh = torch.zeros(count, coefficient_count(sh_degree), 3)
    sh[:, 0] = sh_from_rgb(torch.from_numpy(rgb).float() / 255)
    sigmas_m = spacing_m * np.array([_SIGMA, _SIGMA, _THICKNESS])
    return Gaussians(
        means=torch.from_numpy(point_in_model).float(),
        quats_wxyz=torch.from_numpy(np.roll(quat_xyzw_from_matrix(axes), 1, axis=1)).float(),
        log_scales=torch.from_numpy(np.log(sigmas_m)).float().repeat(count, 1),
        logit_opacities=torch.full((count,), float(np.log(_OPACITY / (1 - _OPACITY)))),
        sh=sh,
    )
