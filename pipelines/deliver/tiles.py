"""Export of the splat as 3D Tiles with levels of detail, for web globes, and as a single glb.

Reads `ingest/survey.json`, `train/model.json`, `train/gaussians.ply` and, of a training in blocks,
`train/blocks.json`: the Gaussians of one block after another come into memory. Writes `tiles/tileset.json` with the
contents in `tiles/content/`, `tiles/splat.glb`, a sidecar of each (docs/formats.md), and `tiles/index.html`, which
shows them in a browser; if asked, `tiles/tiles.3tz`, the tileset in one file.

All files are in the frame of the placement, East-North-Up; the tileset's root places it on Earth.
"""

import json
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, replace_text
from pipelines.core.json_values import Json
from pipelines.core.products import Remark
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import TILES_GLB
from pipelines.core.types import FloatArray, joined_rows
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.deliver.options import Compression, ExportTilesOptions
from pipelines.deliver.pages import TILESET, ScenePage, scene_page, write_scene_page
from pipelines.deliver.placement import require_space
from pipelines.deliver.splat import SplatParts, load_splat_parts, splat_values
from pipelines.formats.georef_sidecar import GeorefSidecar, write_sidecar
from pipelines.formats.gltf import SPLATS, SPZ_IN_GLTF, decode_plain_glb, encode_glb, encode_plain_glb, spz_in_glb
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import decode_spz, encode_wide_spz
from pipelines.formats.tiles_archive import write_tiles_archive
from pipelines.splat.level_of_detail import DetailTile, Tiler, best_cut, build_tiles, scene_box, within_budget
from pipelines.splat.sh import coefficient_count
from pipelines.survey.navigation import load_survey
from pipelines.survey.target_crs import target_crs, without_grid

log = logging.getLogger(__name__)

# Bytes of a Gaussian in SPZ before its compression, or in plain arrays: without harmonics, and of each of these.
_BYTES: dict[Compression, tuple[int, int]] = {"spz": (17, 3), "none": (48, 12)}
_COPIES, _ARCHIVED_COPIES = 3, 2  # each Gaussian is in a leaf, in splat.glb, and merged in levels
# A viewer draws nothing of a tileset whose own error is below its limit (16 pixels by default): with this factor,
# the scene is shown until it is a pixel wide.
_UNSEEN_FACTOR = 16.0
GLB, ARCHIVE = Path(TILES_GLB).name, "tiles.3tz"
# CesiumJS refuses to decode more at degree 3 (its decoder has 2 GB of memory).
_LARGEST_GLB = 3_400_000


def run(stage: StageRun, options: ExportTilesOptions) -> Summary:
    """Write tileset, contents, glb and sidecars, and return their key figures; errors as of `load_splat`."""
    splat = load_splat_parts(stage.workspace, options)
    if splat.placement.ecef_from_file is None:
        raise InputError(
            "not-on-earth",
            "3D Tiles need a place on Earth, and this survey has a local metric frame. `georef export-ply`, "
            "`georef export-spz` and `georef export-mesh` write it in that frame.",
        )
    page = _page(stage.workspace, splat, options)
    count, sidecar = len(splat.center_in_file), splat.placement.sidecar()
    each, harmonic = _BYTES[options.compression]
    copies = _COPIES + (_ARCHIVED_COPIES if options.archive else 0)
    needed_bytes = copies * count * (each + harmonic * coefficient_count(splat.sh_degree))
    advice = "give a lower --sh-degree or a larger --min-opacity"
    require_space(stage.out, needed_bytes, f"tiles of {count} Gaussians", advice)
    box = scene_box(splat.center_in_file)
    tiling = Tiling(box, count, options.max_tile_gaussians, options.compression)
    whole = write_tiles(stage.out, splat, tiling, sidecar, stage.progress)
    in_glb = write_whole(stage.out, splat, whole, sidecar, count, compression=options.compression)
    root = _without_finest(stage.out, whole, sidecar, options)
    for name in (TILESET, GLB):
        write_sidecar(sidecar, stage.out / name)
    write_scene_page(page, stage.out)
    tiles = list(root.all())
    if options.archive:
        names = [TILESET, *(_content_uri(tile.name) for tile in tiles)]
        write_tiles_archive(stage.out / ARCHIVE, stage.out, names)
    levels = [_level(stage.out, level) for level in root.levels()]
    for number, level in enumerate(levels):
        log.info(
            "level %d: %d tiles, %d Gaussians, %.1f MB",
            number, level["tiles"], level["gaussians"], level["bytes"] / 1e6,
        )  # fmt: skip
    finest = sum(tile.count for tile in tiles if not tile.children)
    size = sum(path.stat().st_size for path in stage.out.rglob("*") if path.is_file())
    values = {
        **splat_values(splat),
        "tiles": len(tiles),
        "leaves": sum(not tile.children for tile in tiles),
        "coarsest": root.count,
        "finest": finest,
        "held": sum(level["gaussians"] for level in levels),
        "levels": levels,
        "glb_gaussians": in_glb,
        "bytes": size,
    }
    warnings = []
    if in_glb < count:
        sentence = f"{GLB} holds {in_glb} merged Gaussians: viewers cannot load all {count} from one file"
        warnings.append(Remark(code="glb-merged", sentence=sentence))
    if finest < count:
        sentence = (
            f"The finest tiles show {finest} merged Gaussians instead of all {count}: with these, the levels of "
            f"{TILESET} would exceed the budget of {options.budget} that a viewer can hold."
        )
        remedy = (
            "`georef clean --gaussians` makes a smaller model with less loss; viewers with more memory take a "
            "larger --budget."
        )
        warnings.append(Remark(code="tiles-coarser", sentence=sentence, remedy=remedy))
    return Summary(
        f"{count} Gaussians, {len(tiles)} tiles, {size / 2**20:.0f} MiB; all {len(levels)} levels: "
        f"{values['held']} Gaussians",
        values,
        warnings=tuple(warnings),
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
        reason = f"heights are ellipsoidal, because {error.fault}"
        target = without_grid(options, survey.origin, middle_in_geo, survey.vertical, reason)
    return scene_page(
        workspace.root.resolve().name,
        splat.placement,
        splat.center_in_file,
        survey=survey,
        target=target,
        cesium=options.cesium,
    )


@dataclass(frozen=True)
class Tiling:
    """Division of a splat: box (2, 3) of the scene in metres, number of Gaussians, largest number in a tile."""

    extent: FloatArray
    count: int
    largest_tile: int = 200_000
    compression: Compression = "spz"


def _without_finest(
    folder: Path, whole: DetailTile, sidecar: GeorefSidecar, options: ExportTilesOptions
) -> DetailTile:
    """Return the tree of tiles within the budget, and remove the contents of all others."""
    root = within_budget(whole, options.budget)
    dropped = {tile.name for tile in whole.all()} - {tile.name for tile in root.all()}
    if dropped:
        _write_tileset(folder, root, sidecar, options.compression)
        for name in dropped:
            (folder / _content_uri(name)).unlink()
    return root


def _level(folder: Path, tiles: Sequence[DetailTile]) -> dict[str, int]:
    """Return the sums of a level: tiles, Gaussians, bytes of the contents."""
    sizes = [(folder / _content_uri(tile.name)).stat().st_size for tile in tiles]
    return {"tiles": len(tiles), "gaussians": sum(tile.count for tile in tiles), "bytes": sum(sizes)}


def write_tiles(
    folder: Path, parts: Iterable[SplatArrays], tiling: Tiling, sidecar: GeorefSidecar, progress: Progress = SILENT
) -> DetailTile:
    """Write Gaussians as a tileset with levels of detail, and return its root; an OSError: a file is not written.

    Args:
        folder: exists.
        parts: at least one Gaussian each, in the frame of the sidecar; one after another is in memory.
        tiling: of all parts together.
    """
    with progress.task("tiles", total=tiling.count) as task:

        def write(name: str, content: SplatArrays, *, is_leaf: bool) -> None:
            write_glb(folder / _content_uri(name), content, compression=tiling.compression)
            task.advance(len(content) if is_leaf else 0, note=f"tile {name}")

        root = build_tiles(parts, tiling.extent, Tiler(tiling.largest_tile, write))
    _write_tileset(folder, root, sidecar, tiling.compression)
    return root


def _write_tileset(folder: Path, root: DetailTile, sidecar: GeorefSidecar, compression: Compression) -> None:
    text = json.dumps(_tileset(root, sidecar, compression), separators=(",", ":"), ensure_ascii=False)
    replace_text(folder / TILESET, text + "\n")


def write_whole(
    folder: Path,
    parts: Iterable[SplatArrays],
    root: DetailTile,
    sidecar: GeorefSidecar,
    count: int,
    *,
    most: int = _LARGEST_GLB,
    compression: Compression = "spz",
) -> int:
    """Write the whole splat as one glb, and return the number of its Gaussians.

    A splat of more than `most` Gaussians, which viewers cannot load, is shown by the most detailed tiles that they
    can. The folder holds the tiles' contents.
    """
    if count > most:
        parts = [read_glb(folder / _content_uri(tile.name)) for tile in best_cut(root, most)]
    splat = joined_rows(list(parts))
    extras = {"georef": sidecar.model_dump(mode="json", by_alias=True)}
    write_glb(folder / GLB, splat, extras, compression=compression)
    return len(splat)


def write_glb(
    path: Path, splat: SplatArrays, extras: Json | None = None, *, compression: Compression = "spz"
) -> None:
    """Write N ≥ 1 Gaussians of an East-North-Up frame as a glb, with `extras` as its `asset.extras`.

    Raises:
        InputError: values that are not finite.
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if compression == "none":
        path.write_bytes(encode_plain_glb(splat, extras))
        return
    spz = encode_wide_spz(splat)
    low, high = splat.means.min(axis=0).tolist(), splat.means.max(axis=0).tolist()
    path.write_bytes(encode_glb(spz, len(splat), math.isqrt(splat.sh.shape[1]) - 1, (low, high), extras))


def read_glb(path: Path) -> SplatArrays:
    """Return the Gaussians of a glb that `write_glb` wrote; an InputError: it cannot be read, or is damaged."""
    file_size(path)
    data = path.read_bytes()
    return decode_spz(spz_in_glb(data), path) if SPZ_IN_GLTF.encode() in data else decode_plain_glb(data, path)


def _tileset(root: DetailTile, sidecar: GeorefSidecar, compression: Compression) -> dict[str, Any]:
    """Return the content of `tileset.json`. Only the root has a transform: that of the frame to EPSG:4978."""
    in_contents: dict[str, list[str]] = {"extensionsUsed": [SPLATS]}
    if compression == "spz":
        in_contents = {name: [SPLATS, SPZ_IN_GLTF] for name in ("extensionsUsed", "extensionsRequired")}
    diagonal = float(np.linalg.norm(root.bounds[1] - root.bounds[0]))
    return {
        "asset": {"version": "1.1", "extras": {"georef": sidecar.model_dump(mode="json", by_alias=True)}},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": in_contents},
        "geometricError": max(_UNSEEN_FACTOR * diagonal, 2 * root.error_m),
        "root": {"transform": sidecar.ecef_from_file().matrix().T.ravel().tolist(), **_tile(root)},
    }


def _content_uri(name: str) -> str:
    return f"content/{name}.glb"


def _tile(tile: DetailTile) -> dict[str, Any]:
    middle, half = tile.bounds.mean(axis=0), (tile.bounds[1] - tile.bounds[0]) / 2
    document: dict[str, Any] = {
        "boundingVolume": {"box": [*middle.tolist(), *np.diag(half).ravel().tolist()]},
        "geometricError": tile.error_m,
        "refine": "REPLACE",
        "content": {"uri": _content_uri(tile.name)},
    }
    if tile.children:
        document["children"] = [_tile(child) for child in tile.children]
    return document
