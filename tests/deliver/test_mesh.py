"""Mesh: on the true surface, the same in one chunk or in many, closed on request, with the photographs' colours."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scipy.spatial import KDTree

from pipelines.core.errors import ResourceError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, MESH
from pipelines.core.workspace import Workspace
from pipelines.deliver import mesh as stage
from pipelines.formats.georef_sidecar import MeshCrsSidecar, MeshSidecar, sidecar_path
from pipelines.formats.mesh_files import write_mesh_glb, write_mesh_obj, write_mesh_ply
from pipelines.geodesy.enu import ecef_from_enu, enu_from_ecef
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.surface import tsdf
from pipelines.surface.mesh import closed, distances, simplified, surface_mesh, vertex_normals, without_islands
from pipelines.surface.surface_views import SurfaceViews
from pipelines.surface.texture import TexturedMesh, colours_of, textured
from pipelines.surface.tsdf import GridSettings, RawMesh, occupied_cells
from pipelines.survey.calibrated import load_survey
from tests.depth_scenes import BOX_M, CAMERA, DOWN, depth_map, looking_down
from tests.refusals import refused
from tests.splat_scenes import ground_height

GEO_FROM_MODEL = Similarity(1.0, np.eye(3), np.array([1000.3, -500.2, 20.1]))
CENTERS = looking_down(8)
PIXEL_M = 36 / CAMERA.fx
SETTINGS = GridSettings(PIXEL_M, PIXEL_M, 2 * PIXEL_M, 3)
EAST, WEST = (200, 40, 10), (20, 60, 180)  # colours of the photographs on either side of the origin


def surface_views(folder: Path, *, floater: bool = False) -> SurfaceViews:
    """Return the views of ground and box; with a floater, one map shows a plate high above the ground."""
    poses = CameraPoses(np.tile(DOWN, (len(CENTERS), 1, 1)), np.array(CENTERS))

    def depth(index: int) -> np.ndarray:
        values = depth_map(CENTERS[index])
        if floater and index == 0:
            values[5:25, 5:25] = 20.0
        return values

    def photograph(index: int) -> np.ndarray:
        u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
        ray = CAMERA.rays(np.stack([u, v], axis=-1)) @ DOWN
        east = CENTERS[index][0] + depth_map(CENTERS[index]) * ray[..., 0]
        return np.where(east[..., None] > 0, EAST, WEST).astype(np.uint8)

    def surface(index: int) -> tuple[np.ndarray, np.ndarray]:
        return depth(index), photograph(index)

    trained = SimpleNamespace(
        poses=poses,
        geo_from_model=GEO_FROM_MODEL,
        indices=lambda _split: list(range(len(CENTERS))),
        model=SimpleNamespace(cameras=[SimpleNamespace(exposure=None)] * len(CENTERS)),
    )
    renderer: Any = SimpleNamespace(
        trained=trained,
        pinholes=SimpleNamespace(of=lambda _index: CAMERA),
        surface=surface,
        images=SimpleNamespace(image=photograph),
    )
    return SurfaceViews(renderer, folder)


def mesh_of(views: SurfaceViews, error_m: float = 0.0, settings: GridSettings = SETTINGS) -> RawMesh:
    cells = occupied_cells(views, GEO_FROM_MODEL, settings, everywhere)
    return surface_mesh(views, GEO_FROM_MODEL, settings, cells, error_m=error_m, inside=everywhere).mesh


def everywhere(places: np.ndarray) -> np.ndarray:
    return np.ones(len(places), dtype=bool)


def open_edges(mesh: RawMesh) -> np.ndarray:
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    sides, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    return sides[count == 1]


def test_vertices_lie_on_the_plane_and_the_roof(tmp_path: Path) -> None:
    mesh = mesh_of(surface_views(tmp_path))
    at, up = mesh.vertices - GEO_FROM_MODEL.translation, vertex_normals(mesh)[:, 2]
    reach = np.abs(at[:, :2]).max(axis=1)
    roof, ground = reach < BOX_M - 2 * PIXEL_M, (reach > BOX_M + 4 * PIXEL_M) & (reach < 15)
    assert roof.sum() > 50 and ground.sum() > 1500
    # The distance to a plane is linear on the grid, so that its zero is exact: to float32 of depths of 36 m.
    np.testing.assert_allclose(at[roof, 2], BOX_M, atol=1e-3 * PIXEL_M)
    np.testing.assert_allclose(at[ground, 2], 0, atol=1e-3 * PIXEL_M)
    assert (up[ground] > 0.999).all()
    # Nothing lies further from ground, roof and the edges between them than the truncation.
    assert at[:, 2].min() > -PIXEL_M and at[:, 2].max() < BOX_M + PIXEL_M


def test_chunks_have_no_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = surface_views(tmp_path)
    whole = mesh_of(views)
    monkeypatch.setattr(tsdf, "_CHUNK", 3)
    monkeypatch.setattr(tsdf, "_SQUARE", 1)
    parts = mesh_of(views)
    assert len(parts.faces) == len(whole.faces)
    assert len(open_edges(parts)) == len(open_edges(whole))
    # float32 resolves places in a chunk of 64 voxels to 4e-6 voxels.
    distance, _ = KDTree(parts.vertices).query(whole.vertices)
    assert distance.max() < 1e-4 * PIXEL_M
    # Simplified squares still meet: the ground in the middle has no open edge.
    simple = mesh_of(views, PIXEL_M / 2)
    at = simple.vertices[open_edges(simple)].mean(axis=1) - GEO_FROM_MODEL.translation
    reach = np.abs(at[:, :2]).max(axis=1)
    assert not ((reach > BOX_M + 4 * PIXEL_M) & (reach < 12)).any()
    assert len(simple.faces) < len(whole.faces) / 3


def test_what_one_view_shows_is_carved(tmp_path: Path) -> None:
    """A plate 16 m above the ground in one of eight maps: the others look through it."""
    two = GridSettings(PIXEL_M, PIXEL_M, 2 * PIXEL_M, 2)
    for settings in (SETTINGS, two):
        mesh = mesh_of(surface_views(tmp_path / str(settings.min_views), floater=True), settings=settings)
        assert mesh.vertices[:, 2].max() - GEO_FROM_MODEL.translation[2] < BOX_M + PIXEL_M
    nine = GridSettings(PIXEL_M, PIXEL_M, 2 * PIXEL_M, 9)
    assert len(mesh_of(surface_views(tmp_path / "nine"), settings=nine).faces) == 0


def test_simplification_keeps_its_error() -> None:
    """A sphere of 5 m: the measured error is that of the chords; the bound is on distances from planes."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=5.0)
    mesh = RawMesh(np.array(ball.vertices), np.array(ball.faces, dtype=np.int64))
    for error_m in (0.01, 0.05):
        simple = simplified(mesh, error_m)
        off = distances(mesh.vertices, simple, 0.1)
        inner = 5.0 - np.linalg.norm(simple.vertices[simple.faces].mean(axis=1), axis=1)
        assert 0.2 * inner.max() < off.max() < 5 * error_m
        assert np.sqrt(np.mean(off**2)) < error_m / 2
        assert len(simple.faces) < len(mesh.faces) / 2
    np.testing.assert_allclose(distances(2 * mesh.vertices[:50], mesh, 0.1), 5.0, rtol=1e-6)


def test_watertight_mesh_is_a_solid(tmp_path: Path) -> None:
    mesh, islands = without_islands(mesh_of(surface_views(tmp_path), PIXEL_M / 2), 1.0)
    assert islands == 0 or len(open_edges(mesh))
    solid, of_surface = closed(mesh, 2.0)
    np.testing.assert_array_equal(solid.faces[:of_surface], mesh.faces)
    body = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert body.is_watertight and body.is_winding_consistent
    # What is covered, down to a base 2 m below, and the hole where the box hides the ground, as wide as the box.
    a, b, c = (mesh.vertices[mesh.faces[:, k], :] for k in range(3))
    plan_m2 = np.cross(b - a, c - a)[:, 2] / 2
    heights = (a + b + c)[:, 2] / 3 - solid.vertices[:, 2].min()
    hole_m3 = body.volume - plan_m2 @ heights
    assert (2 * BOX_M) ** 2 * 2.0 < hole_m3 < (2 * BOX_M + 6 * PIXEL_M) ** 2 * 2.2


def test_islands_are_left_out() -> None:
    far = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    ground = trimesh.creation.box((10.0, 10.0, 1.0))
    vertices = np.concatenate([ground.vertices, far.vertices + 20])
    mesh = RawMesh(vertices, np.concatenate([ground.faces, far.faces + len(ground.vertices)]).astype(np.int64))
    kept, left_out = without_islands(mesh, 1.0)
    assert (len(kept.faces), left_out) == (12, 1)
    assert len(without_islands(mesh, 0.0)[0].faces) == len(mesh.faces)


def shown(folder: Path) -> TexturedMesh:
    views = surface_views(folder)
    return textured(mesh_of(views, PIXEL_M / 2), views, GEO_FROM_MODEL, PIXEL_M)


def test_colours_are_those_of_the_photographs(tmp_path: Path) -> None:
    views = surface_views(tmp_path)
    mesh = mesh_of(views)
    rgb, known = colours_of(mesh.vertices, vertex_normals(mesh), views, GEO_FROM_MODEL)
    assert known.mean() > 0.98
    east = mesh.vertices[:, 0] - GEO_FROM_MODEL.translation[0]
    clear = known & (np.abs(east) > 2 * PIXEL_M)
    assert (rgb[clear & (east > 0)] == EAST).all()
    assert (rgb[clear & (east < 0)] == WEST).all()


def test_other_readers_see_mesh_and_texture(tmp_path: Path) -> None:
    result = shown(tmp_path / "maps")
    vertices = result.mesh.vertices - GEO_FROM_MODEL.translation
    parts = (vertices, result.mesh.faces, result.uv, result.image)
    write_mesh_glb(tmp_path / "mesh.glb", *parts, extras={"georef": {}})
    write_mesh_obj(tmp_path / "mesh.obj", *parts)
    glb = trimesh.load(tmp_path / "mesh.glb", force="scene")
    obj = trimesh.load(tmp_path / "mesh.obj", force="mesh", process=False)
    assert (tmp_path / "mesh.mtl").is_file() and (tmp_path / "mesh.png").is_file()
    ((node),) = glb.graph.nodes_geometry
    turn, name = glb.graph[node]
    geometry: Any = glb.geometry[name]
    # y is up: height becomes y, north −z.
    up = trimesh.transform_points(geometry.vertices, turn)
    np.testing.assert_allclose(up, np.column_stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]]), atol=1e-5)
    for loaded, picture in (
        (geometry, geometry.visual.material.baseColorTexture),
        (obj, obj.visual.material.image),
    ):
        image = np.asarray(picture.convert("RGB"))
        place = loaded.visual.uv[loaded.faces].mean(axis=1)
        row = ((1 - place[:, 1]) * len(image)).astype(int)
        rgb = image[row, (place[:, 0] * image.shape[1]).astype(int)]
        corners = np.asarray(loaded.vertices)[loaded.faces][..., 0]
        # A face of two texels and more, clear of the border between the colours.
        clear_east, clear_west = corners.min(axis=1) > 2 * PIXEL_M, corners.max(axis=1) < -2 * PIXEL_M
        assert (rgb[clear_east] == EAST).all(axis=1).mean() > 0.97
        assert (rgb[clear_west] == WEST).all(axis=1).mean() > 0.97
    write_mesh_ply(tmp_path / "crs.ply", vertices + 5e6, result.mesh.faces, np.full(vertices.shape, 7), double=True)
    ply = PlyData.read(tmp_path / "crs.ply")
    np.testing.assert_array_equal(ply["vertex"]["x"], vertices[:, 0] + 5e6)
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), result.mesh.faces)


def test_too_little_memory_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "free_main_memory_bytes", lambda: 1 << 30)
    stage._require_memory(1000, 0.1)
    with refused("mesh-memory", ResourceError):
        stage._require_memory(10_000_000, 0.1)


@pytest.mark.slow
def test_mesh_of_a_trained_survey_lies_on_its_ground(
    trained: list[tuple[Workspace, Workspace]], tmp_path: Path
) -> None:
    root = tmp_path / "ws"
    shutil.copytree(trained[0][0].root, root, symlinks=True)
    workspace = Workspace(root)
    options = {"crs": "EPSG:4978", "watertight": True, "obj": True}
    values = run_stage(workspace, BY_NAME["export-mesh"], options).manifest.values
    assert {path.name for path in (root / "mesh").iterdir()} == {
        "manifest.json", "mesh.ply", "mesh.glb", "mesh.obj", "mesh.mtl", "mesh.png", "mesh_crs.ply",
        *(
            f"{name}{suffix}"
            for name in ("mesh.ply", "mesh.glb", "mesh.obj", "mesh_crs.ply")
            for suffix in (".georef.json", ".iso.xml")
        ),
    }  # fmt: skip
    body = trimesh.load(workspace.path(MESH), force="mesh", process=False)
    assert body.is_watertight and len(body.faces) == values["faces"]
    sidecar = load_json(MeshSidecar, sidecar_path(workspace.path(MESH)))
    assert sidecar.mesh.largest_simplification_error_m == values["largest_simplification_error_m"]
    assert 0 < sidecar.mesh.rms_simplification_error_m < values["voxel_m"] / 2
    in_crs = PlyData.read(root / "mesh/mesh_crs.ply")["vertex"]
    xyz = np.column_stack([in_crs[axis] for axis in "xyz"])
    # float32 resolves 4e-6 m within 64 m of the origin.
    np.testing.assert_allclose(sidecar.ecef_from_file().apply(np.asarray(body.vertices)), xyz, atol=1e-4)
    assert load_json(MeshCrsSidecar, sidecar_path(root / "mesh/mesh_crs.ply")).crs == "EPSG:4978"
    origin = load_survey(workspace).origin
    at = enu_from_ecef(xyz, origin)
    np.testing.assert_allclose(ecef_from_enu(at, origin), xyz, atol=1e-6)
    above = at[:, 2] - ground_height(at[:, 0], at[:, 1])
    middle = (np.hypot(at[:, 0], at[:, 1]) < 20) & (at[:, 2] > at[:, 2].min() + values["voxel_m"])
    # The hill is made of level discs of 0.9 m, whose rims a pixel of 0.47 m shows.
    assert np.sqrt(np.mean(above[middle] ** 2)) < values["voxel_m"]
