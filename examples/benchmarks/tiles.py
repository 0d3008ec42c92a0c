"""Time the tiles of a splat, and its SPZ file: python examples/benchmarks/tiles.py --help.

The splat is a made-up landscape: discs on hills of 300 m, with noise in all harmonics. `write_tiles` makes the
levels of detail and writes every tile; `write_whole` writes the same Gaussians as one glb.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from pipelines.deliver.tiles import Tiling, write_tiles, write_whole
from pipelines.formats.georef_sidecar import GeorefSidecar
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geodesy.crs import ECEF, parse_crs
from pipelines.geodesy.vertical import VerticalDatum


def landscape(count: int, degree: int, middle_m: float = 0.0) -> SplatArrays:
    """Discs on hills, evenly spread, a half larger than their distance."""
    rng = np.random.default_rng(0)
    east, north = rng.uniform(-150, 150, (2, count))
    east += middle_m
    up = 5 * np.sin(east / 20) * np.cos(north / 30) + rng.normal(0, 0.03, count)
    radius = 0.75 * 300 / np.sqrt(count)
    scales = np.log([radius, radius, 0.1 * radius]) + rng.normal(0, 0.3, (count, 3))
    harmonics = rng.normal(0, 0.1, (count, (degree + 1) ** 2, 3))
    harmonics[:, 0] += np.sin(east / 3)[:, None]
    quats = np.array([1.0, 0, 0, 0]) + rng.normal(0, 0.2, (count, 4))
    parts = (np.column_stack([east, north, up]), quats, scales, rng.normal(1, 1, count), harmonics)
    return SplatArrays(*(part.astype(np.float32) for part in parts))


def main() -> None:
    """Print times, sizes and peak memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--sh-degree", type=int, default=3)
    parser.add_argument("--parts", type=int, default=1, help="neighbouring landscapes, each with so many Gaussians")
    args = parser.parse_args()
    count, middles = (
        args.gaussians * args.parts,
        [300.0 * (part - (args.parts - 1) / 2) for part in range(args.parts)],
    )
    # What a lazy reader knows of all parts: here the extent by construction.
    half = np.array([150.0 * args.parts, 150.0, 5.0])
    tiling = Tiling(np.array([-half, half]), count)
    sidecar = GeorefSidecar(
        origin=(6378137.0, 0.0, 0.0),
        rotation=(0.5, 0.5, 0.5, 0.5),
        scale=1.0,
        origin_lla=(0.0, 0.0, 0.0),
        vertical_datum=VerticalDatum(name="ellipsoidal", stated=True),
        crs_wkt=parse_crs(ECEF).wkt,
        covariance=None,
        accuracy=None,
    )
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        start = time.perf_counter()
        parts = (landscape(args.gaussians, args.sh_degree, middle) for middle in middles)
        root = write_tiles(folder, parts, tiling, sidecar)
        tiled = time.perf_counter()
        parts = (landscape(args.gaussians, args.sh_degree, middle) for middle in middles)
        write_whole(folder, parts, root, sidecar, count)
        whole = time.perf_counter()
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        tiles = list(root.all())
        print(f"{count} Gaussians of degree {args.sh_degree}: {len(tiles)} tiles, {size / 2**20:.0f} MiB")
        print(f"tiles {tiled - start:.1f} s, splat.glb {whole - tiled:.1f} s")
        print("shown by level:", " ".join(str(tile.count) for tile in tiles if tile.children))
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
