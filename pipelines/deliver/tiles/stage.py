"""Export of the splat as 3D Tiles with levels of detail, for web globes, and as a single glb.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`. Writes `tiles/tileset.json` with the
contents in `tiles/content/`, `tiles/splat.glb`, and a sidecar of each (docs/formats.md).

All files are in the frame of the placement, East-North-Up; the tileset's root places it on Earth.
"""

from __future__ import annotations

from pathlib import Path

from pipelines.core.stages import TILES_GLB
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportTilesOptions
from pipelines.deliver.splat import codec_arrays, load_splat
from pipelines.deliver.tiles.content import bounds_of, write_glb
from pipelines.deliver.tiles.tileset import TILESET, Tile, write_tileset
from pipelines.formats.georef_sidecar import GeorefSidecar, write_sidecar
from pipelines.formats.splat_ply import SplatArrays

GLB = TILES_GLB.rpartition("/")[2]


def run(stage: StageRun, options: ExportTilesOptions) -> Summary:
    """Write tileset, contents, glb and sidecar, and return their key figures.

    Raises:
        MissingProductError: ingest or train has not been run.
        InputError: a product is damaged.
        DegenerateGeometryError: no Gaussian is opaque enough.
    """
    splat = load_splat(stage.workspace, options)
    arrays = codec_arrays(splat.gaussians, options.sh_degree)
    sidecar = splat.placement.sidecar()
    write_tiles(stage.out, arrays, sidecar)
    write_glb(stage.out / GLB, arrays, {"georef": sidecar.model_dump(mode="json", by_alias=True)})
    for name in (TILESET, GLB):
        write_sidecar(sidecar, stage.out / name)
    return Summary(splat.key_figure(), splat.figures(), cautions=splat.placement.cautions)


def write_tiles(folder: Path, splat: SplatArrays, sidecar: GeorefSidecar) -> None:
    """Write Gaussians as a tileset.

    Args:
        folder: exists.
        splat: N ≥ 1 Gaussians in the frame of the sidecar.
        sidecar: place of the frame on Earth.
    """
    tile = Tile("content/0.glb", bounds_of(splat), 0.0, len(splat))
    write_glb(folder / tile.uri, splat)
    write_tileset(folder, tile, sidecar)
