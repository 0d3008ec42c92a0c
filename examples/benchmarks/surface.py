"""Compare surface model, point cloud and mesh of a simulated flight with the true surface.

    georef simulate survey --flight grid --images 40 --size 960x720 --seed 5
    georef run WORKSPACE --images survey/images … && georef export-raster WORKSPACE
    python examples/benchmarks/surface.py WORKSPACE --flight grid --images 40 --size 960x720 --seed 5

The options are those of `georef simulate`: the same scene is built again, and plumb lines through the middles of
cells are intersected with it. Cells within 0.5 m of a step of the true surface are listed apart: there, a fraction
of a cell decides between roof and ground. `the rest` is the RMSE of the cells that are off by 1 m at most, and
`error/σ` the root mean square of their error over the predicted σ, and `> 2 σ` the share of them beyond two σ; of
interpolated cells, that of all.

Of `cloud.laz` and `mesh.ply`, where there are any, points are compared with points on the true surface, both drawn
evenly: `off` is the mean distance of the file's points from the true surface, and `precision` the share of those
that are off by 0.1 m at most; `missing` and `recall` are the same the other way round, of the true surface that
three photographs see. Chamfer is the mean of both distances, F1 the harmonic mean of both shares.

Of the terrain, cells are compared with the true ground: open, below the edges (the outer metre) of houses, trees
and cars, and below these as a whole. Errors of type I are ground points of the cloud that are not told as such,
errors of type II others that are.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import rasterio
from plyfile import PlyData
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from pipelines.core.products import load_json
from pipelines.core.types import FloatArray, IntArray
from pipelines.deliver.raster_mosaic import MEASURED
from pipelines.formats.georef_sidecar import CrsSidecar, MeshSidecar, sidecar_path
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla, enu_from_ecef, lla_from_ecef
from pipelines.geometry.cameras import Pinhole
from pipelines.simulate.mesh import MISS, Material, Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import RecordedFlight, fly_survey

_ABOVE_M, _BELOW_M = 200.0, 200.0
_AROUND_M, _STEP_M = (0.25, 0.5), 1.2
_CLASSES = {"ground": (Material.TERRAIN,), "roofs": (Material.TILES, Material.FLAT_ROOF)}


class TrueSurface:
    """Upper surface of a simulated scene, or its ground alone, by plumb lines."""

    def __init__(self, options: SimulateOptions, crs: PointCrs, *, ground: bool = False) -> None:
        world = fly_survey(options).world
        self._origin, self._mesh, self._crs = world.origin, world.scene.mesh, crs
        if ground:
            chosen = np.asarray(self._mesh.material) == Material.TERRAIN
            rows = {name: value[chosen] for name, value in vars(self._mesh).items() if len(value) == len(chosen)}
            self._mesh = replace(self._mesh, **rows)
        self._rays = Raycaster(self._mesh)

    def at(self, xy: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return ellipsoidal heights (K,) and materials (K,) at places (K, 2) in the CRS; NaN and −1: none."""
        lla = self._crs.lla_from_xyz(np.column_stack([xy, np.zeros(len(xy))]))
        above, below = (
            enu_from_ecef(ecef_from_lla(np.column_stack([lla[:, :2], np.full(len(lla), height)])), self._origin)
            for height in (self._origin.alt_m + _ABOVE_M, self._origin.alt_m - _BELOW_M)
        )
        down = (below - above) / np.linalg.norm(below - above, axis=1, keepdims=True)
        hits = self._rays.first_hits(above, down)
        place = above + down * hits.distance[:, None].astype(np.float64)
        height = lla_from_ecef(ecef_from_enu(place, self._origin))[:, 2]
        known = hits.triangle != MISS
        material = np.asarray(self._mesh.material)[hits.triangle].astype(np.int64)
        return np.where(known, height, np.nan), np.where(known, material, -1)


_OPEN_M, _GROUND_M = 0.05, 0.5  # above the ground: of open ground, and of points that are none
_EDGE_M = 1.0
_NEAR_M = 0.1  # of F1
_PER_M2, _BESIDE_M = 30.0, 0.25  # points on the true surface, and how far beside each other points are one place
_DRAWN, _TARGETS, _SEEN_BY = 400_000, 30_000, 3


def drawn_on(corners: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Return points (count, 3) drawn evenly on triangles (T, 3, 3), and the triangle (count,) of each."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(cross, axis=1)
    triangle = rng.choice(len(corners), count, p=areas / areas.sum())
    weight = np.sort(rng.random((count, 2)), axis=1)
    weights = np.column_stack([weight[:, 0], weight[:, 1] - weight[:, 0], 1 - weight[:, 1]])
    return np.einsum("nk,nkj->nj", weights, corners[triangle]), triangle


def file_points(workspace: Path, origin: Origin, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Return points (N, 3) in `geo` of each file that there is, drawn evenly."""
    found, cloud, mesh = {}, workspace / "cloud" / "cloud.laz", workspace / "mesh" / "mesh.ply"
    if cloud.is_file():
        crs = parse_crs(load_json(CrsSidecar, sidecar_path(cloud)).crs)
        xyz = np.asarray(laspy.read(cloud).xyz)
        lla = crs.lla_from_xyz(xyz[rng.choice(len(xyz), min(_DRAWN, len(xyz)), replace=False)])
        found["cloud"] = enu_from_ecef(ecef_from_lla(lla), origin)
    if mesh.is_file():
        ply = PlyData.read(mesh)
        vertices = np.column_stack([ply["vertex"][axis] for axis in "xyz"]).astype(np.float64)
        points, _ = drawn_on(vertices[np.stack(ply["face"]["vertex_indices"])], _DRAWN, rng)
        place = load_json(MeshSidecar, sidecar_path(mesh)).ecef_from_file()
        found["mesh"] = enu_from_ecef(place.apply(points), origin)
    return found


def compare_points(workspace: Path, options: SimulateOptions) -> None:
    """Print Chamfer distance and F1 of cloud and mesh."""
    flight, rng = fly_survey(options), np.random.default_rng(0)
    files = file_points(workspace, flight.world.origin, rng)
    if not files:
        return
    every = np.concatenate(list(files.values()))
    low, high = np.quantile(every, [0.005, 0.995], axis=0) + np.array([[-_BESIDE_M], [_BESIDE_M]])
    corners = flight.world.scene.mesh.corners
    corners = corners[(corners.max(axis=1) > low).all(axis=1) & (corners.min(axis=1) < high).all(axis=1)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    true, triangle = drawn_on(corners, int(np.linalg.norm(cross, axis=1).sum() / 2 * _PER_M2), rng)
    normal = cross[triangle] / np.linalg.norm(cross[triangle], axis=1, keepdims=True)
    inside = ((true > low) & (true < high)).all(axis=1)
    true, normal = true[inside], normal[inside]
    drawn = rng.choice(len(true), min(_TARGETS, len(true)), replace=False)
    drawn = drawn[seen_by(flight, true[drawn]) >= _SEEN_BY]
    tree = KDTree(true)
    print(
        f"{'':8s}" + "".join(f"{head:>11s}" for head in ("off", "missing", "Chamfer", "precision", "recall", "F1"))
    )
    for name, every_point in files.items():
        points = every_point[((every_point > low) & (every_point < high)).all(axis=1)]
        judged = points[rng.choice(len(points), min(_TARGETS, len(points)), replace=False)]
        _, nearest = tree.query(judged, workers=-1)
        off = distance_beside(judged - true[nearest], normal[nearest])
        _, nearest = KDTree(points).query(true[drawn], workers=-1)
        missing = distance_beside(points[nearest] - true[drawn], normal[drawn])
        precision, recall = float(np.mean(off < _NEAR_M)), float(np.mean(missing < _NEAR_M))
        figures = (off.mean(), missing.mean(), (off.mean() + missing.mean()) / 2, precision, recall)
        f1 = 2 * precision * recall / max(precision + recall, 1e-9)
        print(f"{name:8s}" + "".join(f"{value:11.3f}" for value in (*figures, f1)))


def distance_beside(difference: FloatArray, normal: FloatArray) -> FloatArray:
    """Return lengths (N,) of differences (N, 3), along the normal alone where points lie beside each other."""
    along, length = np.einsum("ni,ni->n", difference, normal), np.linalg.norm(difference, axis=1)
    return np.asarray(np.where(length**2 - along**2 < _BESIDE_M**2, np.abs(along), length))


def seen_by(flight: RecordedFlight, points: FloatArray) -> IntArray:
    """Return the number of photographs that see points (N, 3) in `geo` closely, their lens taken as a pinhole."""
    truth, seen = flight.recording.truth, np.zeros(len(points), np.int64)
    fx, fy, cx, cy = truth.lens.params[:4]
    pinhole = Pinhole(truth.lens.width, truth.lens.height, fx, fy, cx, cy)
    furthest_m = 2 * np.median(np.linalg.norm(np.array(truth.centers) - np.median(points, axis=0), axis=1))
    for center, rotation in zip(np.array(truth.centers), np.array(truth.cam_from_enu), strict=True):
        in_cam = (points - center) @ rotation.T
        rows = np.flatnonzero(
            (in_cam[:, 2] > 0) & (in_cam[:, 2] < furthest_m) & pinhole.contains(pinhole.project(in_cam))
        )
        rays = points[rows] - center
        hits = flight.renderer.raycaster.first_hits(center, rays)
        seen[rows] += hits.distance > 1 - 0.1 / np.linalg.norm(rays, axis=1)
    return seen


def compare_ground(workspace: Path, options: SimulateOptions) -> None:
    """Print the errors of the terrain model and of the classes of the cloud, where there are any."""
    dtm, cloud = workspace / "raster" / "dtm.tif", workspace / "cloud" / "cloud.laz"
    if dtm.is_file():
        crs = parse_crs(load_json(CrsSidecar, sidecar_path(dtm)).crs)
        with rasterio.open(dtm) as heights, rasterio.open(dtm.with_name("sigma_dtm.tif")) as sigmas:
            row, column = np.nonzero(heights.read_masks(1))
            xy = np.column_stack(rasterio.transform.xy(heights.transform, row, column))
            height, sigma = (raster.read(1)[row, column].astype(float) for raster in (heights, sigmas))
            grid, cell_m = np.zeros(heights.shape, dtype=bool), heights.transform.a
        ground, top = TrueSurface(options, crs, ground=True).at(xy)[0], TrueSurface(options, crs).at(xy)[0]
        error, is_open = height - ground, top - ground < _OPEN_M
        grid[row, column] = is_open
        at_edge = ~is_open & (cell_m * distance_transform_edt(~grid)[row, column] <= _EDGE_M)
        for name, chosen in (("open ground", is_open), ("below edges", at_edge), ("below things", ~is_open)):
            e, z = error[chosen & np.isfinite(error)], (error / sigma)[chosen & np.isfinite(error)]
            print(
                f"terrain, {name:14s}{len(e):9d} cells, bias {np.median(e):+.3f}, "
                f"RMSE {np.sqrt(np.mean(e**2)):.3f}, error/σ {np.sqrt(np.mean(z**2)):.2f}"
            )
    if cloud.is_file():
        crs, las = parse_crs(load_json(CrsSidecar, sidecar_path(cloud)).crs), laspy.read(cloud)
        xyz = np.asarray(las.xyz)
        above, told = xyz[:, 2] - TrueSurface(options, crs, ground=True).at(xyz[:, :2])[0], las.classification == 2
        true = np.abs(above) < _GROUND_M
        first, second = np.mean(~told[true]), np.mean(told[~true])
        print(f"cloud, ground within {_GROUND_M} m: type I {first:.2%}, type II {second:.2%}")


def main() -> None:
    """Print errors by class."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    for name in ("scene", "flight", "images", "size", "seed"):
        parser.add_argument(f"--{name}", default=SimulateOptions.model_fields[name].default)
    parser.add_argument("--cells", type=int, default=200_000)
    args = parser.parse_args()
    names = ("scene", "flight", "images", "size", "seed")
    options = SimulateOptions.model_validate({name: getattr(args, name) for name in names})
    compare_points(args.workspace, options)
    compare_ground(args.workspace, options)
    dsm, sigma, measured_mask = (
        args.workspace / "raster" / f"{name}.tif" for name in ("dsm", "sigma_v", "measured")
    )
    truth = TrueSurface(options, parse_crs(load_json(CrsSidecar, sidecar_path(dsm)).crs))
    with rasterio.open(dsm) as heights, rasterio.open(sigma) as sigmas, rasterio.open(measured_mask) as masks:
        mask = masks.read(1)
        row, column = np.nonzero(mask)
        drawn = np.random.default_rng(0).choice(len(row), min(args.cells, len(row)), replace=False)
        row, column = row[drawn], column[drawn]
        x, y = rasterio.transform.xy(heights.transform, row, column)
        measured, sigma_v = heights.read(1)[row, column].astype(float), sigmas.read(1)[row, column].astype(float)
        seen = mask[row, column] == MEASURED
        gsd = heights.transform.a
    xy = np.column_stack([x, y])
    true, material = truth.at(xy)
    angle = np.arange(8) * np.pi / 4
    around = [truth.at(xy + radius * np.array([np.cos(a), np.sin(a)]))[0] for radius in _AROUND_M for a in angle]
    smooth = np.ptp(np.stack([true, *around]), axis=0) < _STEP_M
    error = measured - true
    columns = ("cells", "bias", "RMSE", "95 %", "> 1 m", "the rest", "error/σ", "> 2 σ")
    heads = "".join(f"{name:>9s}" for name in columns)
    print(f"cells of {gsd:.3f} m; metres\n{'':20s}{heads}")
    classes = {
        f"{name}{where}": chosen & seen & np.isin(material, materials)
        for name, materials in _CLASSES.items()
        for where, chosen in (("", smooth), (", at steps", ~smooth))
    }
    for name, chosen in {**classes, "interpolated": ~seen}.items():
        k = chosen & np.isfinite(error)
        if not k.any():
            continue
        e = error[k]
        near = np.abs(e) <= 1
        z = (e / sigma_v[k])[near if name != "interpolated" else slice(None)]
        print(
            f"{name:20s}{k.sum():9d}{np.median(e):+9.3f}{np.sqrt(np.mean(e**2)):9.3f}"
            f"{np.quantile(np.abs(e), 0.95):9.3f}{np.mean(~near):9.2%}{np.sqrt(np.mean(e[near] ** 2)):9.3f}"
            f"{np.sqrt(np.mean(z**2)):9.2f}{np.mean(np.abs(z) > 2):9.2%}"
        )


if __name__ == "__main__":
    main()
