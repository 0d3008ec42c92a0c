"""Content of a tile: Gaussians as a glb, in the frame of the tileset's root.

The tileset document `tileset.json` (3D Tiles 1.1).

Coordinates of a CRS as polynomials around a scene, for programs that have no PROJ, such as a web page.
"""

from __future__ import annotations

import itertools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, replace_text
from pipelines.core.products import Product
from pipelines.core.types import FloatArray, Vector3
from pipelines.formats.georef_sidecar import GeorefSidecar
from pipelines.formats.gltf import SPLATS, SPZ_IN_GLTF, encode_glb, spz_in_glb
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import FRACTIONAL_BITS, decode_spz, encode_spz
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import SEMI_MAJOR_M, ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geodesy.vertical import ELLIPSOIDAL
from pipelines.splat.level_of_detail import DetailTile

_REACH_M = 2.0 ** (23 - FRACTIONAL_BITS)
_COPIES, _BYTES = 3, 17  # bytes of a Gaussian in SPZ before its compression, without harmonics above the constant


def write_glb(path: Path, splat: SplatArrays, extras: dict[str, Any] | None = None) -> None:
    """Write Gaussians of an East-North-Up frame as a glb.

    A scene that reaches further than ±2048 m gets coarser steps of position: 0.24 mm up to ±4096 m, and so on.

    Args:
        path: of the glb.
        splat: N ≥ 1 Gaussians.
        extras: metadata for `asset.extras`.

    Raises:
        InputError: values that are not finite.
        OSError: the file cannot be written.
    """
    furthest = float(np.abs(splat.means).max())
    coarser = max(0, math.ceil(math.log2((furthest + 1) / _REACH_M))) if math.isfinite(furthest) else 0
    spz = encode_spz(splat, 3, FRACTIONAL_BITS - coarser)
    low, high = splat.means.min(axis=0).tolist(), splat.means.max(axis=0).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_glb(spz, len(splat), math.isqrt(splat.sh.shape[1]) - 1, (low, high), extras))


def require_space(folder: Path, count: int, coefficients: int) -> None:
    """Refuse tiles that the disk would not hold: each Gaussian is in a leaf, in splat.glb, and merged in levels.

    Args:
        folder: on the disk.
        count: number of Gaussians.
        coefficients: of the harmonics of each colour.

    Raises:
        InputError: too little space is free.
    """
    needed = _COPIES * count * (_BYTES + 3 * coefficients)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"tiles of {count} Gaussians may need {needed / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB are "
            "free: give a lower --sh-degree or a larger --min-opacity, or make room on this disk",
            path=folder,
        )


def read_glb(path: Path) -> SplatArrays:
    """Return the Gaussians of a glb that `write_glb` wrote.

    Raises:
        InputError: the file cannot be read, or is damaged.
    """
    file_size(path)
    return decode_spz(spz_in_glb(path.read_bytes()), path)


TILESET = "tileset.json"
# A viewer draws nothing of a tileset whose own error is below its limit (16 pixels by default): with this factor,
# the scene is shown until it is a pixel wide.
_UNSEEN_FACTOR = 16.0


def content_uri(name: str) -> str:
    """Return the address of a tile's content, relative to the tileset."""
    return f"content/{name}.glb"


def write_tileset(folder: Path, root: DetailTile, sidecar: GeorefSidecar) -> None:
    """Write `tileset.json` into the folder of the contents; the file appears whole or not at all.

    Args:
        folder: the contents lie below it.
        root: in the frame of the sidecar.
        sidecar: place of that frame on Earth; it is in `asset.extras`, too.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(tileset_document(root, sidecar), separators=(",", ":"), ensure_ascii=False)
    replace_text(folder / TILESET, text + "\n")


def tileset_document(root: DetailTile, sidecar: GeorefSidecar) -> dict[str, Any]:
    """Return the content of `tileset.json`. Only the root has a transform: that of the frame to EPSG:4978."""
    extensions = {"3DTILES_content_gltf": {"extensionsUsed": [SPLATS, SPZ_IN_GLTF]}}
    extensions["3DTILES_content_gltf"]["extensionsRequired"] = [SPLATS, SPZ_IN_GLTF]
    diagonal = float(np.linalg.norm(root.bounds[1] - root.bounds[0]))
    return {
        "asset": {"version": "1.1", "extras": {"georef": sidecar.model_dump(mode="json", by_alias=True)}},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": extensions,
        "geometricError": max(_UNSEEN_FACTOR * diagonal, 2 * root.error_m),
        "root": {"transform": sidecar.ecef_from_file().matrix().T.ravel().tolist(), **_tile(root)},
    }


def _tile(tile: DetailTile) -> dict[str, Any]:
    middle, half = tile.bounds.mean(axis=0), (tile.bounds[1] - tile.bounds[0]) / 2
    document: dict[str, Any] = {
        "boundingVolume": {"box": [*middle.tolist(), *np.diag(half).ravel().tolist()]},
        "geometricError": tile.error_m,
        "refine": "REPLACE",
        "content": {"uri": content_uri(tile.name)},
    }
    if tile.children:
        document["children"] = [_tile(child) for child in tile.children]
    return document


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
