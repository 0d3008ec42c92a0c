"""Predicted accuracy over the scene: σ on a grid, and the grid as a table for other programs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.files import replace_text
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.tables import table_text
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.report import AccuracySummary

_CELLS = 48  # along the longer side of the grid
_LEAST_RAYS = 3  # of an SfM point that counts as a part of the scene
_MANY_CELLS = 400
_NEIGHBOURS = 3  # nearest SfM points, which give a cell its height and its cameras
_FARTHEST_CELLS = 1.5  # distance from an SfM point beyond which there is no scene
_NEAR = 0.1  # of a cell: a nearer cell's middle has no larger weight
_RIM = 0.01  # fraction of the SfM points outside the grid on each side
_PLACE = ("east_m", "north_m", "up_m", "latitude_deg", "longitude_deg", "ellipsoidal_height_m")
_SIGMA = ("sigma_e_m", "sigma_n_m", "sigma_u_m", "sigma_h_m", "sigma_v_m")


@dataclass(frozen=True)
class AccuracyGrid:
    """Predicted σ at C cells of a grid over the scene, of `shape` columns and rows and sides of `size_m` metres."""

    NO_ARRAYS: ClassVar[Mapping[str, FloatArray]] = {
        f"grid_{name}": np.zeros(0) for name in ("position", "cov_m2", "cell", "place")
    }

    position_in_geo: FloatArray  # (C, 3) middle of each cell, at the height of the scene there
    cov_m2: FloatArray  # (C, 3, 3) covariance in m², east, north, up
    cell: IntArray  # (C, 2) column from the west and row from the south
    size_m: float
    corner_in_geo: FloatArray  # (2,) east and north of the south-western corner
    shape: tuple[int, int]

    def arrays(self) -> dict[str, FloatArray | IntArray]:
        place = np.array([self.size_m, *self.corner_in_geo, *self.shape])
        return dict(zip(self.NO_ARRAYS, (self.position_in_geo, self.cov_m2, self.cell, place), strict=True))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, FloatArray]) -> AccuracyGrid | None:
        """Return the grid of stored arrays; None: it was not known."""
        position, cov, cell, place = (arrays[name] for name in cls.NO_ARRAYS)
        if place.shape != (5,) or cov.shape != (len(position), 3, 3) or len(cell) != len(cov):
            return None
        shape = (int(place[3]), int(place[4]))
        return cls(position, cov, cell.astype(np.int64), float(place[0]), place[1:3], shape)

    @cached_property
    def sigma_m(self) -> FloatArray:
        return np.asarray(np.sqrt(np.diagonal(self.cov_m2, axis1=1, axis2=2)))

    @property
    def sigma_h_m(self) -> FloatArray:
        """Horizontal σ (C,): √(σ_E² + σ_N²)."""
        return np.asarray(np.hypot(self.sigma_m[:, 0], self.sigma_m[:, 1]))

    @property
    def sigma_v_m(self) -> FloatArray:
        return self.sigma_m[:, 2]

    def raster(self, values: FloatArray) -> FloatArray:
        """Return values (C,) of the cells as a raster, rows from the south, columns from the west; NaN: no cell."""
        columns, rows = self.shape
        raster = np.full((rows, columns), np.nan)
        raster[self.cell[:, 1], self.cell[:, 0]] = values
        return raster

    def cov_at(self, position_in_geo: FloatArray) -> FloatArray:
        """Return the covariance (N, 3, 3) of each of the points (N, 3) of the scene, in m².

        It varies slowly over a scene: that of the nearest cells is weighted by inverse distance in plan.
        """
        near = min(_NEIGHBOURS, len(self.cell))
        distance, cell = cKDTree(self.position_in_geo[:, :2]).query(position_in_geo[:, :2], k=[*range(1, near + 1)])
        weight = 1.0 / np.maximum(distance, _NEAR * self.size_m)
        return np.asarray(np.einsum("nk,nkij->nij", weight / weight.sum(axis=1, keepdims=True), self.cov_m2[cell]))

    def covers(self, position_in_geo: FloatArray) -> BoolArray:
        """Return which of the points (N, 3) lie in the scene; beyond it, σ is not known."""
        distance, _ = cKDTree(self.position_in_geo[:, :2]).query(position_in_geo[:, :2])
        within: BoolArray = distance <= _FARTHEST_CELLS * self.size_m
        return within

    def summary(self) -> AccuracySummary:
        horizontal, vertical = self.sigma_h_m, self.sigma_v_m
        return AccuracySummary(
            cells=len(self.cell),
            cell_m=self.size_m,
            least_sigma_h_m=float(horizontal.min()),
            median_sigma_h_m=float(np.median(horizontal)),
            largest_sigma_h_m=float(horizontal.max()),
            least_sigma_v_m=float(vertical.min()),
            median_sigma_v_m=float(np.median(vertical)),
            largest_sigma_v_m=float(vertical.max()),
            rms_sigma_h_m=float(np.sqrt(np.mean(horizontal**2))),
            rms_sigma_v_m=float(np.sqrt(np.mean(vertical**2))),
            reason=None,
        )


# Covariances (J, 3, 3) in m² of points (J, 3), from pairs (point, camera) of what sees them.
CovarianceOfPoints = Callable[[FloatArray, IntArray, IntArray], FloatArray]


def accuracy_grid(
    sparse: SparseModel, point_in_geo: FloatArray, covariance: CovarianceOfPoints
) -> AccuracyGrid | None:
    """Return the predicted σ on a grid over the scene, at the middle of each cell; None: too few points.

    The cameras that observe the nearest of the model's points (N, 3) observe the cell.
    """
    rays = np.bincount(sparse.obs_point, minlength=len(sparse.point_id))
    chosen = np.flatnonzero(rays >= _LEAST_RAYS)
    if len(chosen) < _NEIGHBOURS:
        return None
    point = point_in_geo[chosen]
    low, high = np.quantile(point[:, :2], [_RIM, 1 - _RIM], axis=0)
    size = float((high - low).max()) / _CELLS
    if size <= 0:
        return None
    columns, rows = np.maximum(np.ceil((high - low) / size).astype(int), 1).tolist()
    cell = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    middle = low + (cell + 0.5) * size
    distance, near = cKDTree(point[:, :2]).query(middle, k=_NEIGHBOURS)
    in_scene = distance[:, 0] <= _FARTHEST_CELLS * size
    cell, near = cell[in_scene], near[in_scene]
    position = np.column_stack([middle[in_scene], np.median(point[near, 2], axis=1)])
    # Covariances vary slowly: of many cells, every other one in both directions stands for its neighbours.
    computed = (cell % 2 == 0).all(axis=1) if len(cell) > _MANY_CELLS else np.ones(len(cell), dtype=bool)
    of_part = covariance(position[computed], *seen_by(sparse.obs_point, sparse.obs_image, chosen[near[computed]]))
    known = np.isfinite(of_part).all(axis=(1, 2))
    if not known.any():
        return None
    at, of_part, cell_of_part = position[computed][known], of_part[known], cell[computed][known]
    part = AccuracyGrid(at, of_part, cell_of_part, size, low, (columns, rows))
    if computed.all():
        return part
    cov = part.cov_at(position)
    cov[np.flatnonzero(computed)[known]] = of_part
    return AccuracyGrid(position, cov, cell, size, low, (columns, rows))


def seen_by(obs_point: IntArray, obs_image: IntArray, near: IntArray) -> tuple[IntArray, IntArray]:
    """Return unique pairs (cell, camera), ordered by cell: cameras that observe any of the near points (C, k)."""
    order = np.argsort(obs_point, kind="stable")
    start = np.searchsorted(obs_point[order], np.arange(int(obs_point.max()) + 2))
    cameras = [
        np.unique(np.concatenate([obs_image[order[start[p] : start[p + 1]]] for p in points])) for points in near
    ]
    owner = np.repeat(np.arange(len(near)), [len(of_cell) for of_cell in cameras])
    return owner, np.concatenate(cameras)


def write_csv(grid: AccuracyGrid, origin: Origin | None, path: Path) -> None:
    """Write the grid as a CSV table, one line a cell, with positions in `geo` and on the ellipsoid.

    Without an origin, the columns of positions on the ellipsoid are empty.
    """
    geodetic = [["", "", ""]] * len(grid.position_in_geo)
    if origin is not None:
        lla = lla_from_enu(grid.position_in_geo, origin).tolist()
        geodetic = [[f"{lat:.8f}", f"{lon:.8f}", f"{height:.3f}"] for lat, lon, height in lla]
    values = np.column_stack([grid.sigma_m, grid.sigma_h_m, grid.sigma_v_m])
    rows = (
        [f"{value:.3f}" for value in position] + on_ellipsoid + [f"{value:.5f}" for value in sigma]
        for position, on_ellipsoid, sigma in zip(grid.position_in_geo, geodetic, values, strict=True)
    )
    replace_text(path, table_text(itertools.chain([_PLACE + _SIGMA], rows)))
