"""Coordinates of a CRS as polynomials around a scene, for programs that have no PROJ, such as a web page."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.products import Product
from pipelines.core.types import FloatArray, Vector3
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import SEMI_MAJOR_M, ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geodesy.vertical import ELLIPSOIDAL

_DEGREE = 3
_EXPONENTS = tuple(powers for powers in itertools.product(range(_DEGREE + 1), repeat=3) if sum(powers) <= _DEGREE)
_NODES = 7  # of each axis: more than the polynomial has coefficients along it
_MOST_DECIMALS = 3
_SHORT_UNIT = {"metre": "m", "degree": "°"}


class Axis(Product):
    """Axis of a CRS: its short name, its unit, and the decimals of which the polynomial is sure."""

    name: str
    unit: str
    decimals: int


class LocalCrs(Product):
    """Polynomials of the coordinates of a CRS, in a box around a scene.

    A coordinate is Σ coefficient · (e / a)^i (n / b)^j (u / c)^k; e, n, u are East-North-Up metres at the scene.

    Attributes:
        axes: of the coordinates, easting or longitude first.
        half_extent_m: (a, b, c), half of the box's sides; the polynomials are not to be used outside.
        exponents: (i, j, k) of each coefficient.
        coefficients: of the three axes, for each row of exponents.
        error_m: largest departure from the CRS that was found in the box.
    """

    axes: tuple[Axis, Axis, Axis]
    half_extent_m: Vector3
    exponents: tuple[tuple[int, int, int], ...]
    coefficients: tuple[Vector3, ...]
    error_m: float


def fit_local_crs(crs: PointCrs, origin_lla: ArrayLike, half_extent_m: Vector3) -> LocalCrs:
    """Return the polynomials of a CRS in a box around a place.

    Args:
        crs: the CRS.
        origin_lla: (3,) latitude, longitude in degrees, ellipsoidal height: middle of the box.
        half_extent_m: half of its sides east, north and up.

    Raises:
        InputError: the box leaves the domain of the CRS, or a grid is missing.
    """
    chebyshev = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    between = np.linspace(-1.0, 1.0, _NODES + 1)
    nodes, checks = _cube(chebyshev), _cube(between)
    plan_m = crs.horizontal_unit * (SEMI_MAJOR_M if crs.is_geographic else 1.0)
    unit_m = np.array([plan_m, plan_m, crs.height_unit_m])
    values = _coordinates(crs, origin_lla, np.vstack([nodes, checks]) * half_extent_m)
    solved = np.linalg.lstsq(_powers(nodes), values[: len(nodes)], rcond=None)[0]
    errors = np.abs(_powers(checks) @ solved - values[len(nodes) :]).max(axis=0)
    decimals = np.clip(np.floor(-np.log10(2 * errors + 1e-12)), 0, _MOST_DECIMALS + np.round(np.log10(unit_m)))
    axes = [
        Axis(name=name, unit=_SHORT_UNIT.get(unit, unit), decimals=int(count))
        for name, unit, count in zip(_axis_names(crs), crs.units, decimals, strict=True)
    ]
    return LocalCrs(
        axes=(axes[0], axes[1], axes[2]),
        half_extent_m=half_extent_m,
        exponents=tuple((i, j, k) for i, j, k in _EXPONENTS),
        coefficients=tuple((x, y, z) for x, y, z in solved.tolist()),
        error_m=float((errors * unit_m).max()),
    )


def _cube(along: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)


def _powers(unit: FloatArray) -> FloatArray:
    return np.stack([np.prod(unit ** np.array(powers), axis=1) for powers in _EXPONENTS], axis=1)


def _coordinates(crs: PointCrs, origin_lla: ArrayLike, enu: FloatArray) -> FloatArray:
    lla = lla_from_ecef(ecef_from_lla(origin_lla) + enu @ ecef_from_enu_rotation(origin_lla).T)
    xyz = crs.serving(lla).xyz_from_lla(lla)
    if crs.is_geographic:  # a polynomial cannot jump at the date line
        xyz[:, 0] -= 360.0 * np.round((xyz[:, 0] - xyz[0, 0]) / 360.0)
    return xyz


def _axis_names(crs: PointCrs) -> tuple[str, str, str]:
    if crs.is_geocentric:
        return "X", "Y", "Z"
    height = "h" if crs.vertical.name == ELLIPSOIDAL else "H"
    return ("lon", "lat", height) if crs.is_geographic else ("E", "N", height)
