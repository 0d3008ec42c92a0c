"""The tiles: read as a web globe reads them, every Gaussian is once where the survey put it."""

from __future__ import annotations

import bisect
import hashlib
import json
import shutil
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipelines.core.errors import InputError
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import BLOCK_RECORD, GAUSSIANS
from pipelines.core.types import joined_rows, rows_of
from pipelines.core.workspace import StageRun
from pipelines.deliver.options import ExportTilesOptions
from pipelines.deliver.splat import codec_arrays, load_splat
from pipelines.deliver.tiles import read_glb, run, write_glb, write_whole
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.formats.splat_ply import SplatArrays, write_splat_ply
from pipelines.splat.level_of_detail import DetailTile, within_budget
from pipelines.survey.block_plan import BlockCell, BlockRecord, MergedBlock
from tests.delivered_scenes import block_training, splat_arrays, true_ecef, write_trained
from tests.refusals import numbers, refused, said

COUNT = 2600
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # glTF's axes to those of 3D Tiles
STEP_M = np.sqrt(3) * 0.5 / 4096 + 1e-4  # of SPZ along each axis, and float32 of the frame `model`


@pytest.fixture(scope="module")
def scene() -> SplatArrays:
    return splat_arrays(COUNT, extent_m=20.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, scene: SplatArrays) -> StageRun:
    stage = write_trained(tmp_path_factory.mktemp("tiles") / "ws", scene, "tiles")
    summary = run(stage, ExportTilesOptions(max_tile_gaussians=1000))
    assert summary.values["gaussians"] == summary.values["glb_gaussians"] == COUNT
    assert summary.values["tiles"] == len(all_tiles(document(stage)["root"]))
    return stage


def document(stage: StageRun) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((stage.out / "tileset.json").read_text(encoding="utf-8"))
    return content


def all_tiles(tile: dict[str, Any]) -> list[dict[str, Any]]:
    return [tile, *(below for child in tile.get("children", []) for below in all_tiles(child))]


def gltf_of(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    content: dict[str, Any] = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    return content


def in_ecef(stage: StageRun, path: Path) -> np.ndarray:
    """Places of a content by the matrices of tileset and glTF alone."""
    root = np.array(document(stage)["root"]["transform"]).reshape(4, 4).T
    node = np.array(gltf_of(path)["nodes"][0]["matrix"]).reshape(4, 4).T
    means = read_glb(path).means.astype(np.float64)
    return (np.column_stack([means, np.ones(len(means))]) @ (root @ Y_UP @ node).T)[:, :3]


def test_leaves_hold_every_gaussian_once_at_its_place(made: StageRun, scene: SplatArrays) -> None:
    leaves = [tile for tile in all_tiles(document(made)["root"]) if "children" not in tile]
    assert len(leaves) > 3
    places = np.concatenate([in_ecef(made, made.out / tile["content"]["uri"]) for tile in leaves])
    expected = true_ecef(scene)
    _assert_same_places(places, expected)
    _assert_same_places(in_ecef(made, made.out / "splat.glb"), expected)


def _assert_same_places(places: np.ndarray, expected: np.ndarray) -> None:
    distance, index = cKDTree(expected).query(places)
    np.testing.assert_array_equal(np.sort(index), np.arange(len(expected)))
    assert distance.max() < STEP_M


@pytest.fixture
def in_blocks(tmp_path: Path, scene: SplatArrays) -> StageRun:
    """Workspace whose Gaussians two blocks have trained: the first 1700, and the others."""
    stage = write_trained(tmp_path / "ws", scene, "tiles")
    numbers = (1700, COUNT - 1700)
    blocks = tuple(MergedBlock(cell=BlockCell(), training=block_training(count)) for count in numbers)
    save_json(BlockRecord(blocks=blocks, seams=()), stage.workspace.root / BLOCK_RECORD)
    return stage


def test_tiles_come_from_blocks(in_blocks: StageRun, scene: SplatArrays) -> None:
    """No leaf holds Gaussians of two blocks, so that one block at a time is in memory; all are there once."""
    run(in_blocks, ExportTilesOptions(max_tile_gaussians=1000))
    leaves = [tile for tile in all_tiles(document(in_blocks)["root"]) if "children" not in tile]
    places = [in_ecef(in_blocks, in_blocks.out / tile["content"]["uri"]) for tile in leaves]
    _assert_same_places(np.concatenate(places), true_ecef(scene))
    _assert_same_places(in_ecef(in_blocks, in_blocks.out / "splat.glb"), true_ecef(scene))
    # Gaussians far outside the scene have leaves of their own, whichever block has trained them.
    of_scene = [part for part, tile in zip(places, leaves, strict=True) if "/s" in tile["content"]["uri"]]
    assert len(of_scene) > 3
    tree = cKDTree(true_ecef(scene))
    for part in of_scene:
        assert len(set((tree.query(part)[1] >= 1700).tolist())) == 1


def test_blocks_of_other_gaussians_are_refused(in_blocks: StageRun) -> None:
    write_splat_ply(in_blocks.workspace.root / GAUSSIANS, splat_arrays(COUNT - 1, extent_m=20.0))
    with refused("blocks-mismatch", InputError) as error:
        run(in_blocks, ExportTilesOptions())
    assert {2600, 2599} <= set(numbers(error.value.message)) and error.value.path.name == "blocks.json"


def test_tileset_says_what_a_globe_must_know(made: StageRun) -> None:
    content = document(made)
    assert content["asset"]["version"] == "1.1"
    assert content["extensionsUsed"] == ["3DTILES_content_gltf"]
    extensions = content["extensions"]["3DTILES_content_gltf"]
    assert extensions["extensionsRequired"] == gltf_of(made.out / "splat.glb")["extensionsRequired"]
    georef = content["asset"]["extras"]["georef"]
    assert georef == json.loads((made.out / "tileset.json.georef.json").read_text(encoding="utf-8"))
    assert georef["crsId"] == "EPSG:4978"
    assert georef["verticalDatum"]["name"] == "EGM2008"
    assert georef["georeferenceSigma"]["sigma_h_m"] > 0
    assert gltf_of(made.out / "splat.glb")["asset"]["extras"]["georef"] == georef
    transform = load_json(GeorefSidecar, sidecar_path(made.out / "tileset.json")).ecef_from_file().matrix()
    np.testing.assert_array_equal(np.array(content["root"]["transform"]).reshape(4, 4).T, transform)
    assert content["geometricError"] > 2 * content["root"]["geometricError"]


def test_tiles_are_inside_their_boxes_and_refine(made: StageRun) -> None:
    for tile in all_tiles(document(made)["root"]):
        assert tile["refine"] == "REPLACE"
        splat = read_glb(made.out / tile["content"]["uri"])
        box = np.array(tile["boundingVolume"]["box"]).reshape(4, 3)
        middle, half = box[0], np.diag(box[1:])
        assert (np.abs(splat.means - middle) <= half).all()
        assert (tile["geometricError"] > 0) == ("children" in tile)
        for child in tile.get("children", []):
            assert "transform" not in child
            assert child["geometricError"] <= tile["geometricError"] / 2
            inner = np.array(child["boundingVolume"]["box"]).reshape(4, 3)
            assert (np.abs(inner[0] - middle) + np.diag(inner[1:]) <= half + 1e-9).all()


def test_a_splat_too_large_for_one_file_is_shown_by_its_tiles(made: StageRun, scene: SplatArrays) -> None:
    def tile(content: dict[str, Any]) -> DetailTile:
        name, children = Path(content["content"]["uri"]).stem, content.get("children", [])
        count = len(read_glb(made.out / content["content"]["uri"]))
        below = tuple(map(tile, children))
        return DetailTile(name, count, content["geometricError"], np.zeros((2, 3)), below)

    root = tile(document(made)["root"])
    whole = (made.out / "splat.glb").read_bytes()
    count = write_whole(
        made.out,
        [scene],
        root,
        load_json(GeorefSidecar, sidecar_path(made.out / "tileset.json")),
        len(scene),
        most=1500,
    )
    assert root.count < count <= 1500
    assert len(read_glb(made.out / "splat.glb")) == count
    (made.out / "splat.glb").write_bytes(whole)


def test_plain_tiles_hold_the_gaussians_exactly(tmp_path: Path, scene: SplatArrays) -> None:
    stage = write_trained(tmp_path / "ws", scene, "tiles")
    summary = run(stage, ExportTilesOptions(max_tile_gaussians=1000, compression="none"))
    assert summary.values["glb_gaussians"] == COUNT
    assert (stage.out / "index.html").exists()
    extensions = document(stage)["extensions"]["3DTILES_content_gltf"]
    assert extensions == {"extensionsUsed": ["KHR_gaussian_splatting"]}
    leaves = [tile for tile in all_tiles(document(stage)["root"]) if "children" not in tile]
    places = np.concatenate([in_ecef(stage, stage.out / tile["content"]["uri"]) for tile in leaves])
    distance, index = cKDTree(true_ecef(scene)).query(places)
    np.testing.assert_array_equal(np.sort(index), np.arange(COUNT))
    assert distance.max() < 1e-5  # float32 at 60 m from the origin, twice
    read = joined_rows([read_glb(stage.out / tile["content"]["uri"]) for tile in leaves])
    expected = rows_of(codec_arrays(load_splat(stage.workspace, ExportTilesOptions()).gaussians), index)
    np.testing.assert_array_equal(read.sh, expected.sh)
    np.testing.assert_allclose(read.log_scales, expected.log_scales, atol=1e-6)
    np.testing.assert_allclose(read.logit_opacities, expected.logit_opacities, atol=1e-4)
    np.testing.assert_allclose(read.quats_wxyz, expected.quats_wxyz, atol=1e-6)
    whole = read_glb(stage.out / "splat.glb")
    assert len(whole) == COUNT and "extensionsRequired" not in gltf_of(stage.out / "splat.glb")


def test_every_tile_is_found_through_the_index_of_the_archive(tmp_path: Path, scene: SplatArrays) -> None:
    """As the specification of 3TZ tells readers: hash of the path, bisection, local header, name, content."""
    stage = write_trained(tmp_path / "ws", scene, "tiles")
    run(stage, ExportTilesOptions(max_tile_gaussians=1000, archive=True))
    data = (stage.out / "tiles.3tz").read_bytes()
    with zipfile.ZipFile(stage.out / "tiles.3tz") as archive:
        assert archive.testzip() is None
        entries = archive.infolist()
        index = archive.read("@3dtilesIndex1@")
    assert entries[-1].filename == "@3dtilesIndex1@" and not entries[-1].comment
    assert {entry.compress_type for entry in entries} == {zipfile.ZIP_STORED}
    records = [(*struct.unpack_from("<QQ", index, at), index[at + 16 : at + 24]) for at in range(0, len(index), 24)]
    hashes = [record[:2] for record in records]
    assert hashes == sorted(hashes) and len(hashes) == len(entries) - 1
    uris = [tile["content"]["uri"] for tile in all_tiles(document(stage)["root"])]
    assert {entry.filename for entry in entries[:-1]} == {"tileset.json", *uris}
    for name in ("tileset.json", *uris):
        found = bisect.bisect_left(hashes, struct.unpack("<QQ", hashlib.md5(name.encode()).digest()))
        (at,) = struct.unpack("<Q", records[found][2])
        signature, _, flags, method, _, crc, packed, size, length, extra = struct.unpack_from(
            "<IHHHIIIIHH", data, at
        )
        assert (signature, flags, method, packed) == (0x04034B50, 0, 0, size)
        assert data[at + 30 : at + 30 + length].decode() == name
        content = data[at + 30 + length + extra :][:size]
        assert content == (stage.out / name).read_bytes() and zlib.crc32(content) == crc


def test_a_large_scene_has_coarser_steps(tmp_path: Path) -> None:
    splat = splat_arrays(5)
    splat.means[0] = [-9000, 2100, 30]
    write_glb(tmp_path / "a.glb", splat)
    np.testing.assert_allclose(read_glb(tmp_path / "a.glb").means, splat.means, atol=0.5 / 2**9 + 1e-3)


def test_a_disk_that_is_too_small_is_said_before_the_work(
    tmp_path: Path, scene: SplatArrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = write_trained(tmp_path / "ws", scene, "tiles")
    usage = type(shutil.disk_usage(tmp_path))(2**40, 2**40, 10_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with refused("disk-space", InputError) as error:
        run(stage, ExportTilesOptions())
    assert 2600 in numbers(error.value.message) and "--sh-degree" in error.value.message
    assert list(stage.out.iterdir()) == []


def test_page_shows_ellipsoidal_heights_where_a_grid_is_missing(made: StageRun, tmp_path: Path) -> None:
    """The tiles need no grid, and must not fail without one; a CRS that the user asks for must."""
    page = (made.out / "index.html").read_text(encoding="utf-8")
    assert "heights are ellipsoidal, because Heights above EGM2008" in page
    assert '"name":"h"' in page
    stage = StageRun(made.workspace, tmp_path)
    with pytest.raises(InputError, match="grid"):
        run(stage, ExportTilesOptions(crs="EPSG:32630+3855"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("budget", "compression"), [(1000, "spz"), (2500, "spz"), (2500, "none")])
def test_all_levels_stay_within_the_budget(
    tmp_path: Path, scene: SplatArrays, budget: int, compression: str
) -> None:
    stage = write_trained(tmp_path / "ws", scene, "tiles")
    options = {"max_tile_gaussians": 1000, "budget": budget, "compression": compression}
    summary = run(stage, ExportTilesOptions.model_validate(options))
    tiles = all_tiles(document(stage)["root"])
    counts = {tile["content"]["uri"]: len(read_glb(stage.out / tile["content"]["uri"])) for tile in tiles}
    assert sum(counts.values()) == summary.values["held"] <= budget
    # No other contents are left, the levels' sums are those of the files, and the whole is in the one glb.
    assert {f"content/{path.name}" for path in (stage.out / "content").iterdir()} == set(counts)
    levels = summary.values["levels"]
    assert [sum(level[name] for level in levels) for name in ("tiles", "gaussians")] == [
        len(tiles),
        sum(counts.values()),
    ]
    sizes = [(stage.out / name).stat().st_size for name in counts]
    assert sum(level["bytes"] for level in levels) == sum(sizes)
    assert summary.values["glb_gaussians"] == COUNT
    finest = sum(counts[tile["content"]["uri"]] for tile in tiles if "children" not in tile)
    assert finest == summary.values["finest"] < COUNT
    sentence = said(summary.warnings, "tiles-coarser")
    assert numbers(sentence)[:3] == [finest, COUNT, budget]


def test_finest_tiles_are_left_out_everywhere_alike() -> None:
    """The tile with the largest error gets its children first; the tree stays one."""

    def tile(name: str, count: int, error_m: float, *children: DetailTile) -> DetailTile:
        return DetailTile(name, count, error_m, np.zeros((2, 3)), children)

    fine = [tile(f"a{k}", 50, 0.0) for k in range(2)], [tile(f"b{k}", 30, 0.0) for k in range(2)]
    root = tile("r", 10, 8.0, tile("a", 40, 4.0, *fine[0]), tile("b", 20, 2.0, *fine[1]))
    names = {most: sorted(one.name for one in within_budget(root, most).all()) for most in (5, 70, 169, 170, 230)}
    assert names[5] == ["r"]
    assert names[70] == names[169] == ["a", "b", "r"]
    assert names[170] == ["a", "a0", "a1", "b", "r"]
    assert names[230] == sorted(one.name for one in root.all())
    assert [len(level) for level in root.levels()] == [1, 2, 4]
