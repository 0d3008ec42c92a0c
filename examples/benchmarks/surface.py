"""Compare the surface model of a simulated flight with the true surface.

    georef simulate survey --flight grid --images 40 --size 960x720 --seed 5
    georef run WORKSPACE --images survey/images … && georef export-raster WORKSPACE
    python examples/benchmarks/surface.py WORKSPACE --flight grid --images 40 --size 960x720 --seed 5

The options are those of `georef simulate`: the same scene is built again, and plumb lines through the middles of
cells are intersected with it. Cells within 0.5 m of a step of the true surface are listed apart: there, a fraction
of a cell decides between roof and ground. `the rest` is the RMSE of the cells that are off by 1 m at most, and
`error/σ` the root mean square of their error over the predicted σ; of interpolated cells, that of all.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import rasterio

from pipelines.core.products import load_json
from pipelines.core.types import FloatArray, IntArray
from pipelines.deliver.raster_whole import MEASURED
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_lla, enu_from_ecef, lla_from_ecef
from pipelines.simulate.mesh import MISS, Material, Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import fly_survey

_ABOVE_M, _BELOW_M = 200.0, 200.0
_AROUND_M, _STEP_M = (0.25, 0.5), 1.2
_CLASSES = {"ground": (Material.TERRAIN,), "roofs": (Material.TILES, Material.FLAT_ROOF)}


class TrueSurface:
    """Upper surface of a simulated scene, by plumb lines."""

    def __init__(self, options: SimulateOptions, crs: PointCrs) -> None:
        world = fly_survey(options).world
        self._origin, self._mesh, self._crs = world.origin, world.scene.mesh, crs
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
    heads = "".join(f"{head:>9s}" for head in ("cells", "bias", "RMSE", "95 %", "> 1 m", "the rest", "error/σ"))
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
            f"{np.sqrt(np.mean(z**2)):9.2f}"
        )


if __name__ == "__main__":
    main()
