"""Real spherical harmonics of degree 0 to 3 and their derivative, as numba kernels.

Order, signs and polynomials are those of 3DGS (doi 10.1145/3592433).
"""

from __future__ import annotations

import math
from typing import Any

from pipelines.splat.rasterizer.cpu_jit import jit

# N_lm of the real spherical harmonics; the other factor of each is a polynomial of the direction.
_C0 = math.sqrt(1 / (4 * math.pi))
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi))
_C2_ZONAL = math.sqrt(5 / (16 * math.pi))
_C3_3 = math.sqrt(35 / (32 * math.pi))
_C3_2 = math.sqrt(105 / (4 * math.pi))
_C3_1 = math.sqrt(21 / (32 * math.pi))
_C3_0 = math.sqrt(7 / (16 * math.pi))

MAX_COEFFICIENTS = 16


@jit
def sh_basis(direction: Any, degree: int, basis: Any) -> None:
    """Write the (degree + 1)² functions of a unit vector (x, y, z) into `basis` (16,)."""
    x, y, z = direction
    basis[0] = _C0
    if degree < 1:
        return
    basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = _C2 * x * y
    basis[5] = -_C2 * y * z
    basis[6] = _C2_ZONAL * (2 * zz - xx - yy)
    basis[7] = -_C2 * x * z
    basis[8] = 0.5 * _C2 * (xx - yy)
    if degree < 3:
        return
    basis[9] = -_C3_3 * y * (3 * xx - yy)
    basis[10] = _C3_2 * x * y * z
    basis[11] = -_C3_1 * y * (4 * zz - xx - yy)
    basis[12] = _C3_0 * z * (2 * zz - 3 * xx - 3 * yy)
    basis[13] = -_C3_1 * x * (4 * zz - xx - yy)
    basis[14] = 0.5 * _C3_2 * z * (xx - yy)
    basis[15] = -_C3_3 * x * (xx - 3 * yy)


@jit
def sh_direction_gradient(direction: Any, degree: int, weight: Any) -> Any:
    """Return Σ_k weight[k] · ∂basis[k]/∂(x, y, z), with the polynomials as functions of all space."""
    x, y, z = direction
    gx, gy, gz = 0.0, 0.0, 0.0
    if degree >= 1:
        gx, gy, gz = -_C1 * weight[3], -_C1 * weight[1], _C1 * weight[2]
    if degree >= 2:
        zonal, planar = 2 * _C2_ZONAL * weight[6], _C2 * weight[8]
        gx += _C2 * (y * weight[4] - z * weight[7]) + x * (planar - zonal)
        gy += _C2 * (x * weight[4] - z * weight[5]) - y * (planar + zonal)
        gz += -_C2 * (y * weight[5] + x * weight[7]) + 2 * z * zonal
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        w9, w10, w11 = _C3_3 * weight[9], _C3_2 * weight[10], _C3_1 * weight[11]
        w12, w13 = _C3_0 * weight[12], _C3_1 * weight[13]
        w14, w15 = 0.5 * _C3_2 * weight[14], _C3_3 * weight[15]
        gx += -6 * x * y * w9 + y * z * w10 + 2 * x * y * w11 - 6 * x * z * w12
        gx += (3 * xx + yy - 4 * zz) * w13 + 2 * x * z * w14 + 3 * (yy - xx) * w15
        gy += 3 * (yy - xx) * w9 + x * z * w10 + (xx + 3 * yy - 4 * zz) * w11 - 6 * y * z * w12
        gy += 2 * x * y * w13 - 2 * y * z * w14 + 6 * x * y * w15
        gz += x * y * w10 - 8 * y * z * w11 + (6 * zz - 3 * xx - 3 * yy) * w12
        gz += -8 * x * z * w13 + (xx - yy) * w14
    return gx, gy, gz
