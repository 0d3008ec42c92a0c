"""Change along the normals of the earlier surface, for walls and slopes, from the clouds of both epochs (M3C2).

The variance of a distance along a normal n is

    s₁² / N₁ + s₂² / N₂ + Σₖ (nᵀ Cₖ n − nᵀ Dₖ n) + nᵀ D n

with sₖ the roughness of Nₖ points in a cylinder, Cₖ the covariance that the nearest point of a cloud states, Dₖ the
part of the datum in it, and D the covariance of the difference of both datums, as of the rasters. The errors of
surfaces are common to the neighbours in a cylinder: their number does not lessen them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines import __version__
from pipelines.change.detection import QUANTILE_95, Noise
from pipelines.change.grid import CommonGrid
from pipelines.core.errors import InputError
from pipelines.core.files import remove
from pipelines.core.products import load_json
from pipelines.core.progress import Progress
from pipelines.core.stages import CLOUD
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.formats.las import MovedPoints, MovedWriter, open_las, read_surface
from pipelines.geometry.footprints import first_of_voxels
from pipelines.surface.m3c2 import TiledPoints, at_random, m3c2, oriented_normals, require_py4dgeo, spacing_of
from pipelines.survey.change_report import AlongNormals

FILE = "along_normals.laz"
_SQUARE_M, _CHUNK = 32.0, 1_000_000
_CORE_SPACINGS = 3.0  # between core points, and radius of the cylinders: about 28 points of each surface
_LEAST_SPACING_M = 0.02


def require_clouds(workspaces: tuple[Workspace, Workspace]) -> None:
    """Refuse to start without both clouds.

    Raises:
        MissingProductError: names the command that makes a cloud.
        BackendUnavailableError: py4dgeo is not installed.
    """
    require_py4dgeo()
    for workspace in workspaces:
        workspace.path(CLOUD)


@dataclass(frozen=True)
class Datum:
    """Difference of the datums of both epochs at places in the plan: what was taken out, and what is left as σ."""

    grid: CommonGrid
    noise: Noise
    registered: bool

    @property
    def shift_m(self) -> FloatArray:
        """Shift (3,) of the later epoch that is taken out."""
        return self.noise.shift_m if self.registered else np.zeros(3)

    def variance(self, normal: FloatArray, of_difference: FloatArray) -> FloatArray:
        """Return the variance (C,) along unit normals (C, 3), from the variances (C, 3) of the difference."""
        long_range = self.noise.long_range_m**2
        if self.registered:
            of_shift = np.einsum("ci,ij,cj->c", normal, self.noise.shift_cov_m2, normal)
            return np.asarray(of_shift + long_range)
        return np.maximum(_along(normal, of_difference), long_range)


def _along(normal: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the variances (C,) along unit normals (C, 3) from those by axis (C, 3)."""
    return np.asarray((normal**2 * variance).sum(axis=1))


def change_along_normals(
    workspaces: tuple[Workspace, Workspace], datum: Datum, reach_m: float, out: Path, progress: Progress
) -> AlongNormals:
    """Write `along_normals.laz` into a folder, and return its figures.

    Distances of more than `reach_m` are not found.

    Raises:
        InputError: a cloud is damaged, has another CRS than the rasters, or states no σ.
    """
    scratch = out / "clouds"
    clouds = tuple(
        _sorted(workspace.path(CLOUD), datum.grid, scratch / name, progress)
        for workspace, name in zip(workspaces, ("earlier", "later"), strict=True)
    )
    spacing_m = max(spacing_of(cloud, _LEAST_SPACING_M) for cloud in clouds)
    core_m = _CORE_SPACINGS * max(spacing_m, _LEAST_SPACING_M)
    every = []
    near = [datum.grid.frame.west, datum.grid.frame.north, 0.0]
    wkt, text = datum.grid.crs.wkt1, "distance: later minus earlier along the normal of the earlier surface"
    with MovedWriter(
        out / FILE, wkt1=wkt, angular=False, near=near, software=f"GeoRefGS {__version__}", text=text
    ) as writer:
        for part in _squares(clouds, datum, core_m, reach_m, progress):
            writer.write(part)
            every.append(np.column_stack([part.distance_m, part.lod_m]))
    remove(scratch)
    distance_m, lod_m = np.concatenate([np.empty((0, 2)), *every]).T
    known = np.isfinite(distance_m)
    return AlongNormals(
        points=len(distance_m),
        measured=int(known.sum()),
        cylinder_m=core_m,
        reach_m=reach_m,
        median_lod_m=float(np.median(lod_m[known])) if known.any() else None,
        significant_share=float((np.abs(distance_m) > lod_m)[known].mean()) if known.any() else None,
    )


def _sorted(path: Path, grid: CommonGrid, folder: Path, progress: Progress) -> TiledPoints:
    """Sort a cloud into squares, in metres, with the variance of each point along its normal."""
    file = open_las(path)
    sidecar, rasters = load_json(CrsSidecar, sidecar_path(path)), grid.rasters[1].sidecar
    if (sidecar.crs_wkt, sidecar.vertical_datum) != (rasters.crs_wkt, rasters.vertical_datum):
        raise InputError(
            "epochs-differ-in-crs",
            "is in another CRS than the rasters.",
            path=path,
            remedy="Export cloud and rasters of both with one --crs and --vertical.",
        )
    points = TiledPoints(folder, _SQUARE_M)
    with progress.task("cloud", file.count) as task:
        for chunk in read_surface(path, _CHUNK):
            normal = chunk.normal.astype(np.float64)
            variance = np.einsum("ni,nij,nj->n", normal, chunk.cov_m2, normal)
            points.append(chunk.position * _metres(grid), normal, chunk.classification, variance)
            task.advance(len(chunk))
    return points


def _metres(grid: CommonGrid) -> FloatArray:
    """Return the units (3,) of the CRS in metres."""
    return np.array([grid.unit_m, grid.unit_m, grid.crs.height_unit_m])


def _squares(
    clouds: tuple[TiledPoints, ...], datum: Datum, core_m: float, reach_m: float, progress: Progress
) -> Iterator[MovedPoints]:
    earlier, later = clouds
    margin_m = reach_m + 3 * core_m
    with progress.task("squares", len(earlier.count)) as task:
        for square in sorted(earlier.count):
            rows, inside = earlier.around(square, margin_m)
            others, _ = later.around(square, margin_m + float(np.linalg.norm(datum.shift_m)))
            place, moved = rows["position"], others["position"] - datum.shift_m
            normal = oriented_normals(place, core_m / 2, place, rows["normal"].astype(np.float64))
            usable = np.flatnonzero(inside & np.isfinite(normal[:, 0]))
            core = usable[first_of_voxels(place[usable], core_m)]
            distance_m, noise_m = m3c2(
                at_random(place), at_random(moved), place[core], normal[core], radius_m=core_m, reach_m=reach_m
            )
            position, along = place[core] / _metres(datum.grid), normal[core]
            of_earlier, of_later, of_difference = datum.grid.datum_variances(position[:, :2])
            variance = noise_m**2 + datum.variance(along, of_difference)
            variance += _own_variance(rows["variance"][core], _along(along, of_earlier))
            if len(others):
                there = place[core] + np.nan_to_num(distance_m)[:, None] * along
                nearest = cKDTree(moved).query(there)[1]
                variance += _own_variance(others["variance"][nearest], _along(along, of_later))
            sigma_m = np.sqrt(variance)
            yield MovedPoints(position, along, distance_m, sigma_m, QUANTILE_95 * sigma_m)
            task.advance()


def _own_variance(stated: NDArray[np.float32], of_datum: FloatArray) -> FloatArray:
    """Return the variance (C,) of a surface itself: what its points state, less that of the datum."""
    return np.asarray(np.maximum(np.nan_to_num(stated.astype(np.float64)) - of_datum, 0.0))
