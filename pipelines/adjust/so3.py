"""Rotations in torch: exponential map and logarithm, differentiable at zero too."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the cross-product matrices (…, 3, 3) of vectors (…, 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vector.shape[:-1], 3, 3)


def exp_so3(rotation_vector: Tensor) -> Tensor:
    """Return the rotation matrices (…, 3, 3) of rotation vectors (…, 3), in radians.

    Rodrigues' formula is used, because `torch.linalg.matrix_exp` would wait for the device.
    """
    squared = rotation_vector.square().sum(dim=-1, keepdim=True)[..., None]
    angle = (squared + torch.finfo(squared.dtype).tiny).sqrt()  # the root has no derivative at zero
    cross = cross_matrix(rotation_vector)
    identity = torch.eye(3, dtype=cross.dtype, device=cross.device)
    linear, quadratic = torch.sinc(angle / math.pi), 0.5 * torch.sinc(0.5 * angle / math.pi).square()
    return identity + linear * cross + quadratic * (cross @ cross)


def log_so3(rotation: Tensor) -> Tensor:
    """Return the rotation vectors (…, 3), in radians, of rotations (…, 3, 3) by less than π."""
    skewed = rotation - rotation.transpose(-1, -2)
    sine_axis = 0.5 * torch.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], dim=-1)
    # The root has no derivative at zero: a rotation by 0 counts as one by 1e-12 rad.
    sine = (sine_axis.square().sum(dim=-1, keepdim=True) + 1e-24).sqrt()
    cosine = 0.5 * (rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1.0)
    return sine_axis * (torch.atan2(sine, cosine) / sine)
