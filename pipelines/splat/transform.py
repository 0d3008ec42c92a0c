"""Gaussians in another frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.splat import sh
from pipelines.splat.gaussians import Gaussians


def transformed(gaussians: Gaussians, to_from_from: Similarity) -> Gaussians:
    """The same Gaussians in another frame: seen from a camera that moves along, they give the same image.

    Centres are mapped, scales grow, rotations and the direction-dependent bands of the colours turn. Computed in
    float64; the result is of the input's type, so the target frame's origin must be near the scene.

    Args:
        gaussians: N Gaussians.
        to_from_from: p_to = s R p_from + t.
    """
    device, kind = gaussians.means.device, gaussians.means.dtype
    turn = torch.as_tensor(to_from_from.rotation, dtype=torch.float64, device=device)
    shift = torch.as_tensor(to_from_from.translation, dtype=torch.float64, device=device)
    x, y, z, w = quat_xyzw_from_matrix(to_from_from.rotation).tolist()
    quat_wxyz = torch.tensor([w, x, y, z], dtype=torch.float64, device=device)
    unit = torch.nn.functional.normalize(gaussians.quats_wxyz.double(), dim=1)
    return Gaussians(
        means=(to_from_from.scale * gaussians.means.double() @ turn.T + shift).to(kind),
        quats_wxyz=_quaternion_product(quat_wxyz, unit).to(kind),
        log_scales=(gaussians.log_scales.double() + math.log(to_from_from.scale)).to(kind),
        logit_opacities=gaussians.logit_opacities.clone(),
        sh=sh.rotate_sh(gaussians.sh, turn.cpu()),
    )


def _quaternion_product(left_wxyz: Tensor, right_wxyz: Tensor) -> Tensor:
    """Quaternions (N, 4) of the rotation `left` (4,) after the rotations `right` (N, 4)."""
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
