"""The tileset document `tileset.json` (3D Tiles 1.1)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.durable import replace_text
from pipelines.formats.georef_sidecar import GeorefSidecar
from pipelines.formats.gltf import SPLATS, SPZ_IN_GLTF
from pipelines.splat.level_of_detail import DetailTile

TILESET = "tileset.json"
# A viewer draws nothing of a tileset whose own error is below its limit (16 pixels by default): with this factor,
# the scene is shown until it is a pixel wide.
_UNSEEN_FACTOR = 16.0


def content_uri(name: str) -> str:
    """Return the address of a tile's content, relative to the tileset."""
    return f"content/{name}.glb"


def write_tileset(folder: Path, root: DetailTile, sidecar: GeorefSidecar) -> None:
    """Write `tileset.json` into the folder of the contents; the file appears whole or not at all.

    Args:
        folder: the contents lie below it.
        root: in the frame of the sidecar.
        sidecar: place of that frame on Earth; it is in `asset.extras`, too.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(tileset_document(root, sidecar), separators=(",", ":"), ensure_ascii=False)
    replace_text(folder / TILESET, text + "\n")


def tileset_document(root: DetailTile, sidecar: GeorefSidecar) -> dict[str, Any]:
    """Return the content of `tileset.json`. Only the root has a transform: that of the frame to EPSG:4978."""
    extensions = {"3DTILES_content_gltf": {"extensionsUsed": [SPLATS, SPZ_IN_GLTF]}}
    extensions["3DTILES_content_gltf"]["extensionsRequired"] = [SPLATS, SPZ_IN_GLTF]
    diagonal = float(np.linalg.norm(root.bounds[1] - root.bounds[0]))
    return {
        "asset": {"version": "1.1", "extras": {"georef": sidecar.model_dump(mode="json", by_alias=True)}},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": extensions,
        "geometricError": max(_UNSEEN_FACTOR * diagonal, 2 * root.error_m),
        "root": {"transform": sidecar.ecef_from_file().matrix().T.ravel().tolist(), **_tile(root)},
    }


def _tile(tile: DetailTile) -> dict[str, Any]:
    middle, half = tile.bounds.mean(axis=0), (tile.bounds[1] - tile.bounds[0]) / 2
    document: dict[str, Any] = {
        "boundingVolume": {"box": [*middle.tolist(), *np.diag(half).ravel().tolist()]},
        "geometricError": tile.error_m,
        "refine": "REPLACE",
        "content": {"uri": content_uri(tile.name)},
    }
    if tile.children:
        document["children"] = [_tile(child) for child in tile.children]
    return document
