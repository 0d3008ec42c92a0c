"""Real spherical harmonics as 3D Gaussian Splatting uses them: values, and rotation of the coefficients.

Basis, order and signs are those of the 3DGS code (degree 0 to 3; Sloan, "Stupid Spherical Harmonics Tricks",
2008, appendix A2): band l holds coefficients l² … (l + 1)² − 1, and a colour is 0.5 + Σ c_k Y_k(d), clamped at 0.
"""

from functools import cache

import torch
from numpy.typing import ArrayLike
from torch import Tensor

MAX_DEGREE = 3

C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def coefficient_count(degree: int) -> int:
    """Return the number of coefficients up to a degree from 0 to 3; a ValueError refuses others."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics have degree 0 to {MAX_DEGREE}, not {degree}")
    return (degree + 1) ** 2


def sh_from_rgb(rgb: Tensor) -> Tensor:
    """Return the coefficients of degree 0 of colours from 0 to 1, of the same shape."""
    return (rgb - 0.5) / C0


def basis(directions: Tensor, degree: int) -> Tensor:
    """Return values Y_k (…, K) of the harmonics up to `degree` at unit vectors (…, 3)."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * zz - xx - yy),
            _C2[3] * x * z,
            _C2[4] * (xx - yy),
        ]
    if degree >= 3:
        values += [
            _C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            _C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def evaluate_sh(sh: Tensor, directions: Tensor, degree: int | None = None) -> Tensor:
    """Return Σ c_k Y_k(d) (…, 3) of coefficients (…, K, 3), without the 0.5 and the clamp of a colour.

    Directions (…, 3) need not be of unit length. The degree is the highest band to use; None: all.
    """
    used = round(sh.shape[-2] ** 0.5) - 1 if degree is None else degree
    count = coefficient_count(used)
    unit = directions / directions.norm(dim=-1, keepdim=True)
    return (basis(unit, used)[..., None] * sh[..., :count, :]).sum(dim=-2)


def rotate_sh(sh: Tensor, rotation: ArrayLike | Tensor) -> Tensor:
    """Return coefficients of the turned functions: evaluate_sh(rotate_sh(sh, R), R d) = evaluate_sh(sh, d).

    Coefficients (…, K, 3) keep their type; the rotation (3, 3) is applied in float64.
    """
    turn = torch.as_tensor(rotation, dtype=torch.float64)
    degree = round(sh.shape[-2] ** 0.5) - 1
    coefficient_count(degree)
    bands = [sh[..., :1, :]]
    for band in range(1, degree + 1):
        matrix = _band_rotation(band, turn).to(device=sh.device)
        turned = torch.einsum("ij,...jc->...ic", matrix, sh[..., band**2 : (band + 1) ** 2, :].double())
        bands.append(turned.to(sh.dtype))
    return torch.cat(bands, dim=-2)


def _band_rotation(band: int, rotation: Tensor) -> Tensor:
    """Return the matrix (2l + 1, 2l + 1) that turns the coefficients of band l.

    A rotation maps a band into itself (Ivanic and Ruedenberg, doi 10.1021/jp953350u). Its matrix therefore follows
    from the values at enough directions: Y(R d_i) c' = Y(d_i) c for all i. The solution is exact, and the system
    small: it is solved once a call.
    """
    directions = _sample_directions()
    columns = slice(band**2, (band + 1) ** 2)
    before = basis(directions, band)[:, columns]
    after = basis(directions @ rotation.T, band)[:, columns]
    solution: Tensor = torch.linalg.lstsq(after, before).solution
    return solution


@cache
def _sample_directions() -> Tensor:
    """Return evenly spread directions (64, 3): a Fibonacci sphere."""
    index = torch.arange(64, dtype=torch.float64) + 0.5
    polar, azimuth = torch.acos(1 - 2 * index / 64), torch.pi * (1 + 5**0.5) * index
    return torch.stack([azimuth.cos() * polar.sin(), azimuth.sin() * polar.sin(), polar.cos()], dim=1)
