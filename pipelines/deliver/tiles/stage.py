"""Export of the splat as 3D Tiles with levels of detail, for web globes, and as a single glb.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`. Writes `tiles/tileset.json` with the
contents in `tiles/content/`, `tiles/splat.glb`, a sidecar of each (docs/formats.md), and `tiles/index.html`, which
shows the tiles in a browser.

All files are in the frame of the placement, East-North-Up; the tileset's root places it on Earth.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import TILES_GLB
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.deliver.options import ExportTilesOptions
from pipelines.deliver.splat import PlacedSplat, codec_arrays, load_splat
from pipelines.deliver.tiles.content import read_glb, require_space, write_glb
from pipelines.deliver.tiles.page import ScenePage, scene_page, write_page
from pipelines.deliver.tiles.tileset import TILESET, content_uri, write_tileset
from pipelines.formats.georef_sidecar import GeorefSidecar, write_sidecar
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geodesy.vertical import ELLIPSOIDAL, parse_vertical
from pipelines.scene.calibrated import load_survey
from pipelines.scene.target_crs import target_crs
from pipelines.splat.level_of_detail import DetailTile, best_cut, build_tiles

GLB = TILES_GLB.rpartition("/")[2]
# CesiumJS refuses to decode more at degree 3 (its decoder has 2 GB of memory).
_LARGEST_GLB = 3_400_000


def run(stage: StageRun, options: ExportTilesOptions) -> Summary:
    """Write tileset, contents, glb and sidecars, and return their key figures.

    Raises:
        MissingProductError: ingest or train has not been run.
        InputError: a product is damaged, or the disk is too small.
        DegenerateGeometryError: no Gaussian is opaque enough.
    """
    splat = load_splat(stage.workspace, options)
    page = _page(stage.workspace, splat, options)
    arrays = codec_arrays(splat.gaussians, options.sh_degree)
    require_space(stage.out, arrays)
    sidecar = splat.placement.sidecar()
    root = write_tiles(stage.out, arrays, sidecar, options.max_tile_gaussians, stage.progress)
    in_glb = write_whole(stage.out, arrays, root, sidecar)
    for name in (TILESET, GLB):
        write_sidecar(sidecar, stage.out / name)
    write_page(page, stage.out)
    tiles = list(root.all())
    size = sum(path.stat().st_size for path in stage.out.rglob("*") if path.is_file())
    values = {
        **splat.figures(),
        "tiles": len(tiles),
        "leaves": sum(not tile.children for tile in tiles),
        "coarsest": root.count,
        "glb_gaussians": in_glb,
        "bytes": size,
    }
    merged = (f"{GLB} holds {in_glb} merged Gaussians: viewers cannot load all {len(arrays)} from one file",)
    return Summary(
        f"{splat.key_figure()}, {len(tiles)} tiles, {size / 2**20:.0f} MiB",
        values,
        warnings=merged if in_glb < len(arrays) else (),
        cautions=splat.placement.cautions,
    )


def _page(workspace: Workspace, splat: PlacedSplat, options: ExportTilesOptions) -> ScenePage:
    survey = load_survey(workspace)
    middle_in_geo = splat.placement.file_from_geo.inverse().apply(np.zeros((1, 3)))
    try:
        target = target_crs(options, survey.origin, middle_in_geo, survey.vertical)
    except InputError as error:
        if options.crs is not None or options.vertical is not None:
            raise
        # The tiles themselves need no grid: without one, the page shows ellipsoidal heights, and says so.
        without_grid = options.model_copy(update={"vertical": parse_vertical(ELLIPSOIDAL)})
        target = target_crs(without_grid, survey.origin, middle_in_geo, survey.vertical)
        target = replace(target, assumed=(*target.assumed, f"heights are ellipsoidal, because {error}"))
    return scene_page(workspace.root.resolve().name, splat, survey, target, options.cesium)


def write_tiles(
    folder: Path,
    splat: SplatArrays,
    sidecar: GeorefSidecar,
    largest_tile: int = 200_000,
    progress: Progress = SILENT,
) -> DetailTile:
    """Write Gaussians as a tileset with levels of detail, and return its root.

    Args:
        folder: exists.
        splat: N ≥ 1 Gaussians in the frame of the sidecar.
        sidecar: place of the frame on Earth.
        largest_tile: largest number of Gaussians in a tile.
        progress: shows how many of the Gaussians are in tiles.

    Raises:
        OSError: a file cannot be written.
    """
    with progress.task("tiles", total=len(splat)) as task:

        def write(name: str, content: SplatArrays, *, is_leaf: bool) -> None:
            write_glb(folder / content_uri(name), content)
            task.advance(len(content) if is_leaf else 0, note=f"tile {name}")

        root = build_tiles(splat, largest_tile, write)
    write_tileset(folder, root, sidecar)
    return root


def write_whole(
    folder: Path, splat: SplatArrays, root: DetailTile, sidecar: GeorefSidecar, most: int = _LARGEST_GLB
) -> int:
    """Write the whole splat as one glb, and return the number of its Gaussians.

    A splat of more Gaussians than a viewer can load is shown by the most detailed tiles that it can.

    Args:
        folder: holds the contents of the tiles.
        splat: the Gaussians.
        root: of their tiles.
        sidecar: place of the frame on Earth; it is in `asset.extras`, too.
        most: largest number of Gaussians.
    """
    if len(splat) > most:
        parts = [vars(read_glb(folder / content_uri(tile.name))) for tile in best_cut(root, most)]
        splat = SplatArrays(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    write_glb(folder / GLB, splat, {"georef": sidecar.model_dump(mode="json", by_alias=True)})
    return len(splat)
