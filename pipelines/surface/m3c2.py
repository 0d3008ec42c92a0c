"""Distances of two clouds along normals, and points sorted into squares of the plan on the disk.

M3C2: Lague, Brodu and Leroux 2013, doi 10.1016/j.isprsjprs.2013.04.009, by py4dgeo.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.geometry.footprints import first_of_voxels, rows_by_square

_MOST_POINTS = 2_000_000  # of a cloud in a square: seconds
_SAMPLE = 20_000  # points that tell the spacing of a cloud
LEAST_POINTS = 4  # in the cylinder, of each cloud
CONFIDENCE_95 = 1.96


def m3c2(
    first: FloatArray,
    second: FloatArray,
    core: FloatArray,
    normal: FloatArray,
    *,
    radius_m: float,
    reach_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the distances of two clouds at core points (C, 3), and their σ (C,) from the roughness of both clouds.

    Distances count from the first cloud (P, 3) to the second (Q, 3) along unit normals (C, 3); NaN where one has
    too few points in a cylinder. `reach_m` is half the length of a cylinder: the largest distance that is found.
    """
    nothing = np.full(len(core), np.nan)
    if not (len(core) and len(first) and len(second)):
        return nothing, nothing.copy()
    py4dgeo = require_py4dgeo()
    middle = core.mean(axis=0)
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(first - middle), py4dgeo.Epoch(second - middle)),
        corepoints=np.ascontiguousarray(core - middle),
        corepoint_normals=np.ascontiguousarray(normal, dtype=np.float64),
        cyl_radius=radius_m,
        max_distance=reach_m,
    )
    distance, uncertainty = algorithm.run()
    known = (uncertainty["num_samples1"] >= LEAST_POINTS) & (uncertainty["num_samples2"] >= LEAST_POINTS)
    known &= np.isfinite(distance)
    with np.errstate(invalid="ignore"):
        noise = uncertainty["lodetection"] / CONFIDENCE_95
    return np.where(known, distance, np.nan), np.where(known, noise, np.nan)


def require_py4dgeo() -> Any:
    """Import py4dgeo; its absence is to be told before work starts.

    Raises:
        BackendUnavailableError: py4dgeo is not installed.
    """
    require("reference")
    import py4dgeo

    # It logs to stdout, which belongs to our results, and into a file of the current folder.
    log = logging.getLogger("py4dgeo")
    for handler in list(log.handlers):
        log.removeHandler(handler)
    log.setLevel(logging.WARNING)
    return py4dgeo


def oriented_normals(
    place: FloatArray, spacing_m: float, towards: FloatArray, towards_normal: FloatArray
) -> FloatArray:
    """Return unit normals (P, 3) of planes through neighbours of points (P, 3) that are `spacing_m` apart.

    Noise would turn the normals of closer ones. They are on the side of the normals (Q, 3) of the nearest of other
    points (Q, 3); NaN for lone points.
    """
    sparse = place[first_of_voxels(place, spacing_m)]
    normal = plane_normals(sparse, spacing_m)
    if len(towards):
        against = np.einsum("ni,ni->n", normal, towards_normal[cKDTree(towards).query(sparse)[1]]) < 0
        normal = np.where(against[:, None], -normal, normal)
    return np.asarray(normal[cKDTree(sparse).query(place)[1]])


_NEIGHBOURS = 16
_FARTHEST = 6.0  # spacings: a point whose neighbours lie further off stands alone


def plane_normals(position: FloatArray, spacing_m: float) -> FloatArray:
    """Return unit normals (P, 3), upwards, of planes through neighbours `spacing_m` apart; NaN for lone points."""
    count = min(_NEIGHBOURS, len(position))
    if count < 4:
        return np.full(position.shape, np.nan)
    distance, row = cKDTree(position).query(position, k=count)
    arm = position[row] - position[row].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", arm, arm))
    normal = axes[:, :, 0] * np.where(axes[:, 2:, 0] < 0, -1.0, 1.0)
    lone = distance[:, count // 2] > _FARTHEST * spacing_m
    return np.where(lone[:, None], np.nan, normal)


Square = tuple[int, int]
_ROW = np.dtype([("position", "<f8", 3), ("normal", "<f4", 3), ("classification", "u1"), ("variance", "<f4")])
_SPARE_BYTES = 1 << 28  # of the disk, to be left free


class TiledPoints:
    """Points with normal, class and variance, in a file a square of the plan, in a scratch folder."""

    def __init__(self, folder: Path, side_m: float) -> None:
        self.side_m = side_m
        self._folder = folder
        self.count: dict[Square, int] = {}  # points, of squares that hold some
        folder.mkdir(parents=True, exist_ok=True)

    def append(
        self,
        position: FloatArray,
        normal: FloatArray | Float32Array | None,
        classification: ByteArray | None,
        variance_m2: FloatArray | Float32Array | None = None,
    ) -> None:
        """Append points (P, 3) with normals (P, 3), classes (P,) of LAS and variances (P,); what is unknown is 0.

        Raises:
            InputError: the disk is full.
        """
        rows = np.zeros(len(position), dtype=_ROW)
        if shutil.disk_usage(self._folder).free < rows.nbytes + _SPARE_BYTES:
            raise InputError(
                "disk-full",
                "No room for the points that are compared.",
                path=self._folder,
                remedy="Make room on this disk.",
            )
        rows["position"] = position
        if normal is not None:
            rows["normal"] = normal
        if classification is not None:
            rows["classification"] = classification
        if variance_m2 is not None:
            rows["variance"] = variance_m2
        for square, part in rows_by_square(position, self.side_m):
            with self._path(square).open("ab") as file:
                file.write(rows[part].tobytes())
            self.count[square] = self.count.get(square, 0) + len(part)

    def around(self, square: Square, margin_m: float) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
        """Return the rows in a square and its margin, and which of them lie in the square itself."""
        reach = int(np.ceil(margin_m / self.side_m))
        names = [
            (square[0] + across, square[1] + along)
            for across in range(-reach, reach + 1)
            for along in range(-reach, reach + 1)
        ]
        parts = [np.fromfile(self._path(name), dtype=_ROW) for name in names if name in self.count]
        rows = np.concatenate([np.empty(0, dtype=_ROW), *parts])
        offset = rows["position"][:, :2] - self.side_m * np.array(square)
        near = ((offset >= -margin_m) & (offset < self.side_m + margin_m)).all(axis=1)
        rows, offset = rows[near], offset[near]
        return rows, np.asarray(((offset >= 0) & (offset < self.side_m)).all(axis=1))

    def _path(self, square: Square) -> Path:
        return self._folder / f"{square[0]}_{square[1]}.points"


def at_random(position: FloatArray) -> FloatArray:
    """Return points (P, 3), or as many of them as M3C2 takes.

    One point a voxel would not do: where a noisy surface lies near a border of voxels, the few points beyond that
    border would count as much as the many before it, which shifts the mean by up to one σ.
    """
    if len(position) <= _MOST_POINTS:
        return position
    return position[np.sort(np.random.default_rng(0).choice(len(position), _MOST_POINTS, replace=False))]


def spacing_of(points: TiledPoints, voxel_m: float) -> float:
    """Return the median distance between neighbours, one a voxel, in the square with the most points."""
    rows, inside = max((points.around(square, 0.0) for square in points.count), key=lambda part: len(part[0]))
    place = rows["position"][inside]
    place = place[first_of_voxels(place, voxel_m)]
    chosen = np.random.default_rng(0).permutation(len(place))[:_SAMPLE]
    if len(place) < 2:
        return points.side_m
    return float(np.median(cKDTree(place).query(place[chosen], k=2)[0][:, 1]))
