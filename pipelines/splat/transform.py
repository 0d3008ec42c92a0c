"""Transformation of Gaussians to another frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.splat import sh
from pipelines.splat.gaussians import Gaussians


def transformed(gaussians: Gaussians, target_from_source: Similarity) -> Gaussians:
    """Return the same Gaussians in another frame: a camera that moves along sees the same image.

    Centres are mapped, scales multiplied, rotations and the direction-dependent bands of the colours turned, in
    float64. The result has the input's type, so that the target frame's origin must lie near the scene.

    Args:
        gaussians: N Gaussians.
        target_from_source: p_target = s R p_source + t.
    """
    device, kind = gaussians.means.device, gaussians.means.dtype
    turn = torch.as_tensor(target_from_source.rotation, dtype=torch.float64, device=device)
    shift = torch.as_tensor(target_from_source.translation, dtype=torch.float64, device=device)
    x, y, z, w = quat_xyzw_from_matrix(target_from_source.rotation).tolist()
    quat_wxyz = torch.tensor([w, x, y, z], dtype=torch.float64, device=device)
    unit = torch.nn.functional.normalize(gaussians.quats_wxyz.double(), dim=1)
    return Gaussians(
        means=(target_from_source.scale * gaussians.means.double() @ turn.T + shift).to(kind),
        quats_wxyz=_quaternion_product(quat_wxyz, unit).to(kind),
        log_scales=(gaussians.log_scales.double() + math.log(target_from_source.scale)).to(kind),
        logit_opacities=gaussians.logit_opacities.clone(),
        sh=sh.rotate_sh(gaussians.sh, turn.cpu()),
    )


def _quaternion_product(left_wxyz: Tensor, right_wxyz: Tensor) -> Tensor:
    """Return quaternions (N, 4) of the rotation `left` (4,) after the rotations `right` (N, 4)."""
    w, x, y, z = left_wxyz.unbind(-1)
    matrix = torch.stack(
        [
            torch.stack([w, -x, -y, -z]),
            torch.stack([x, w, -z, y]),
            torch.stack([y, z, w, -x]),
            torch.stack([z, -y, x, w]),
        ]
    )
    return right_wxyz @ matrix.T
