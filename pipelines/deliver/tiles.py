"""Export of the splat as 3D Tiles with levels of detail, for web globes, and as a single glb.

Reads `ingest/survey.json`, `train/model.json`, `train/gaussians.ply` and, of a training in blocks,
`train/blocks.json`: the Gaussians of one block after another come into memory. Writes `tiles/tileset.json` with the
contents in `tiles/content/`, `tiles/splat.glb`, a sidecar of each (docs/formats.md), and `tiles/index.html`, which
shows the tiles in a browser.

All files are in the frame of the placement, East-North-Up; the tileset's root places it on Earth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import TILES_GLB
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.deliver.options import ExportTilesOptions
from pipelines.deliver.splat import SplatParts, load_splat_parts
from pipelines.deliver.tiles_content import TILESET, content_uri, read_glb, require_space, write_glb, write_tileset
from pipelines.deliver.tiles_page import ScenePage, ShownScene, scene_page, write_page
from pipelines.formats.georef_sidecar import GeorefSidecar, write_sidecar
from pipelines.formats.splat_ply import SplatArrays, concatenated
from pipelines.geodesy.vertical import ELLIPSOIDAL, parse_vertical
from pipelines.splat.level_of_detail import DetailTile, Tiler, best_cut, build_tiles, scene_box
from pipelines.splat.sh import coefficient_count
from pipelines.survey.calibrated import load_survey
from pipelines.survey.target_crs import target_crs

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
    splat = load_splat_parts(stage.workspace, options)
    page = _page(stage.workspace, splat, options)
    count, sidecar = splat.figures.count, splat.placement.sidecar()
    require_space(stage.out, count, coefficient_count(splat.sh_degree))
    tiling = Tiling(scene_box(splat.center_in_file), count, options.max_tile_gaussians)
    root = write_tiles(stage.out, splat, tiling, sidecar, stage.progress)
    in_glb = write_whole(stage.out, splat, root, sidecar, count)
    for name in (TILESET, GLB):
        write_sidecar(sidecar, stage.out / name)
    write_page(page, stage.out)
    tiles = list(root.all())
    size = sum(path.stat().st_size for path in stage.out.rglob("*") if path.is_file())
    values = {
        **splat.figures.values(),
        "tiles": len(tiles),
        "leaves": sum(not tile.children for tile in tiles),
        "coarsest": root.count,
        "glb_gaussians": in_glb,
        "bytes": size,
    }
    merged = (f"{GLB} holds {in_glb} merged Gaussians: viewers cannot load all {count} from one file",)
    return Summary(
        f"{splat.figures.key_figure()}, {len(tiles)} tiles, {size / 2**20:.0f} MiB",
        values,
        warnings=merged if in_glb < count else (),
        cautions=splat.placement.cautions,
    )


def _page(workspace: Workspace, splat: SplatParts, options: ExportTilesOptions) -> ScenePage:
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
    scene = ShownScene(workspace.root.resolve().name, splat.placement, splat.center_in_file)
    return scene_page(scene, survey, target, options.cesium)


@dataclass(frozen=True)
class Tiling:
    """Division of a splat into tiles.

    Attributes:
        extent: (2, 3) box of the scene.
        count: number of all Gaussians.
        largest_tile: largest number of Gaussians in a tile.
    """

    extent: FloatArray
    count: int
    largest_tile: int = 200_000

    @staticmethod
    def of(splat: SplatArrays) -> Tiling:
        """Return the division of a splat that is one part."""
        return Tiling(scene_box(splat.means), len(splat))


def write_tiles(
    folder: Path, parts: Iterable[SplatArrays], tiling: Tiling, sidecar: GeorefSidecar, progress: Progress = SILENT
) -> DetailTile:
    """Write Gaussians as a tileset with levels of detail, and return its root.

    Args:
        folder: exists.
        parts: at least one Gaussian each, in the frame of the sidecar; one after another is in memory.
        tiling: of all parts together.
        sidecar: place of the frame on Earth.
        progress: shows how many of the Gaussians are in tiles.

    Raises:
        OSError: a file cannot be written.
    """
    with progress.task("tiles", total=tiling.count) as task:

        def write(name: str, content: SplatArrays, *, is_leaf: bool) -> None:
            write_glb(folder / content_uri(name), content)
            task.advance(len(content) if is_leaf else 0, note=f"tile {name}")

        root = build_tiles(parts, tiling.extent, Tiler(tiling.largest_tile, write))
    write_tileset(folder, root, sidecar)
    return root


def write_whole(
    folder: Path,
    parts: Iterable[SplatArrays],
    root: DetailTile,
    sidecar: GeorefSidecar,
    count: int,
    *,
    most: int = _LARGEST_GLB,
) -> int:
    """Write the whole splat as one glb, and return the number of its Gaussians.

    A splat of more Gaussians than a viewer can load is shown by the most detailed tiles that it can.

    Args:
        folder: holds the contents of the tiles.
        parts: of the Gaussians.
        root: of their tiles.
        sidecar: place of the frame on Earth; it is in `asset.extras`, too.
        count: number of all Gaussians.
        most: largest number of Gaussians.
    """
    if count > most:
        parts = [read_glb(folder / content_uri(tile.name)) for tile in best_cut(root, most)]
    splat = concatenated(list(parts))
    write_glb(folder / GLB, splat, {"georef": sidecar.model_dump(mode="json", by_alias=True)})
    return len(splat)
