"""Mesh: on the true surface and without gaps, open where nothing was measured, with the photographs' colours."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from plyfile import PlyData

from pipelines.core.errors import ResourceError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, MESH, MESH_GLB
from pipelines.core.types import joined_rows
from pipelines.core.workspace import Workspace
from pipelines.deliver import mesh as stage
from pipelines.formats.georef_sidecar import MeshCrsSidecar, MeshSidecar, sidecar_path
from pipelines.formats.mesh_files import read_mesh_ply, write_mesh_glb, write_mesh_obj, write_mesh_ply
from pipelines.geodesy.enu import ecef_from_enu, enu_from_ecef
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.surface.fusion import FusionSettings, fused_squares
from pipelines.surface.mesh import (
    RawMesh,
    closed,
    compact,
    distances_from_mesh,
    edges_of,
    holes_of,
    parts_of,
    vertex_normals,
    without_islands,
)
from pipelines.surface.mesh_rims import border_of, with_long_rims
from pipelines.surface.poisson import (
    MeasuredPoints,
    certain_points,
    closed_gap_m,
    near_points,
    poisson_depth,
    poisson_mesh,
    rim_m,
    simplified,
    surface_sigma_at,
)
from pipelines.surface.surface_views import SurfaceViews
from pipelines.surface.texture import photographed_colours, textured
from pipelines.survey.navigation import load_survey
from tests.depth_scenes import BOX_M, CAMERA, DOWN, UP, depth_map, looking_down
from tests.refusals import refused
from tests.splat_scenes import ground_height
from tests.trained_workspaces import own_copy

GEO_FROM_MODEL = Similarity(1.0, np.eye(3), np.array([1000.3, -500.2, 20.1]))
CENTERS = looking_down(8)
PIXEL_M = 36 / CAMERA.fx
SETTINGS = FusionSettings(PIXEL_M, 2 * PIXEL_M, 3)
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

    model = SimpleNamespace(
        similarity=GEO_FROM_MODEL,
        indices=lambda _split: list(range(len(CENTERS))),
        cameras=[SimpleNamespace(exposure=None)] * len(CENTERS),
    )
    renderer: Any = SimpleNamespace(
        model=model,
        poses=poses,
        surface=surface,
        images=SimpleNamespace(image=photograph, pinhole=lambda _index: CAMERA),
    )
    return SurfaceViews(renderer, folder, colours=True)


def points_of(views: SurfaceViews) -> MeasuredPoints:
    cloud = joined_rows(list(fused_squares(views, GEO_FROM_MODEL, SETTINGS)))
    return MeasuredPoints(cloud.position, cloud.normal, cloud.sigma_m, PIXEL_M)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> SurfaceViews:
    return surface_views(tmp_path_factory.mktemp("maps"))


@pytest.fixture(scope="module")
def whole(views: SurfaceViews, tmp_path_factory: pytest.TempPathFactory) -> RawMesh:
    return poisson_mesh(points_of(views), PIXEL_M, tmp_path_factory.mktemp("poisson"))


@pytest.fixture(scope="module")
def simple(whole: RawMesh, tmp_path_factory: pytest.TempPathFactory) -> RawMesh:
    return simplified(without_islands(whole, 1.0)[0], PIXEL_M / 2, tmp_path_factory.mktemp("simple"))


def plane(side_m: float, hole_m: float = 0.0, spacing_m: float = 0.25) -> MeasuredPoints:
    """Return points of level ground around (20, 0), without those in a disc in its middle."""
    axis = np.arange(-side_m / 2, side_m / 2, spacing_m)
    position = np.stack([*np.meshgrid(axis, axis), np.zeros((len(axis),) * 2)], axis=-1).reshape(-1, 3)
    position = position[np.hypot(*position.T[:2]) >= hole_m / 2] + [20.0, 0.0, 0.0]
    return MeasuredPoints(position, np.tile(UP, (len(position), 1)), np.full(len(position), 0.03), spacing_m)


def open_edges(mesh: RawMesh) -> np.ndarray:
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    sides, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    return sides[count == 1]


def test_vertices_lie_on_the_plane_and_the_roof(whole: RawMesh) -> None:
    at, up = whole.vertices - GEO_FROM_MODEL.translation, vertex_normals(whole)[:, 2]
    reach = np.abs(at[:, :2]).max(axis=1)
    # No view shows the walls, so that the solver rounds the roof: over four of its cells, of two voxels at most.
    roof, ground = (reach < 2 * PIXEL_M) & (at[:, 2] > BOX_M / 2), (reach > BOX_M + 8 * PIXEL_M) & (reach < 12)
    assert roof.sum() > 3 and ground.sum() > 100
    assert np.abs(at[roof, 2] - BOX_M).max() < 0.3 * PIXEL_M
    assert np.sqrt(np.mean(at[ground, 2] ** 2)) < 0.05 * PIXEL_M
    assert (up[ground] > 0.97).all() and (up[roof] > 0.9).all()  # seen from above, no face is seen from behind


def test_walls_that_no_view_shows_are_closed(whole: RawMesh, simple: RawMesh) -> None:
    """Cameras look straight down on a box whose walls are less high than the gap that is closed."""
    assert closed_gap_m(PIXEL_M) > BOX_M
    for mesh in (whole, simple):
        rim = mesh.vertices[open_edges(mesh)].mean(axis=1) - GEO_FROM_MODEL.translation
        assert np.abs(rim[:, :2]).max(axis=1).min() > 10  # where fewer than three of the views end
    assert len(simple.faces) < len(whole.faces) / 3


@pytest.mark.slow
@pytest.mark.usefixtures("children_here")
@pytest.mark.parametrize(("side_m", "spacing_m"), [(40.0, 0.25), (40.0, 0.5)])
def test_narrow_gaps_are_closed_and_wide_ones_listed(side_m: float, spacing_m: float, tmp_path: Path) -> None:
    narrow, wide = 0.8 * closed_gap_m(spacing_m), 2 * closed_gap_m(spacing_m)
    whole, holed = (plane(side_m, hole_m, spacing_m) for hole_m in (narrow, wide))
    mesh = poisson_mesh(whole, spacing_m, tmp_path)
    assert holes_of(mesh) == []
    mesh = poisson_mesh(holed, spacing_m, tmp_path)
    (hole,) = [hole for hole in holes_of(mesh) if hole.width_m > spacing_m]
    np.testing.assert_allclose(hole.middle[:2], [20, 0], atol=2 * spacing_m)
    # The rim goes into the gap by at most what `rim_m` says, less a face of a cell of two voxels.
    reach = hole.width_m - (wide - 2 * rim_m(spacing_m))
    assert -0.01 < reach < 6 * spacing_m
    assert list(tmp_path.iterdir()) == []


def test_sigma_grows_with_the_way_from_measured_points() -> None:
    points = plane(40.0, 10.0)
    on, above, within = np.array([[30.1, 0.1, 0.0], [30.1, 0.1, 0.04], [20.0, 0.0, 0.0]])
    sigma_m = surface_sigma_at(np.array([on, above, within]), points)
    np.testing.assert_allclose(sigma_m, [0.03, 0.05, 5.0], rtol=0.02)


def test_uncertain_points_count_only_where_no_others_are() -> None:
    for radius_m, kept in (
        (1.0, False),
        (8.0, True),
    ):  # the middle is nearer and farther than the gap that is closed
        points = plane(20.0)
        distance = np.hypot(points.position[:, 0] - 20, points.position[:, 1])
        sigma_m = np.where(distance < radius_m, 0.2, 0.03)
        used = certain_points(MeasuredPoints(points.position, points.normal, sigma_m, points.spacing_m))
        assert (np.hypot(used.position[:, 0] - 20, used.position[:, 1]).min() < 0.3) == kept
        assert (sigma_m == 0.03).sum() <= len(used.position) < len(points.position)


@pytest.mark.usefixtures("children_here")
@pytest.mark.parametrize("sigma_m", [0.2, 0.4])
def test_no_gap_is_left_before_uncertain_points(sigma_m: float, tmp_path: Path) -> None:
    """Ground whose east fewer photographs see, as beyond the edge of one: it is measured from end to end."""
    points = plane(40.0)
    east = points.position[:, 0] > np.median(points.position[:, 0])
    uncertain = MeasuredPoints(points.position, points.normal, np.where(east, sigma_m, 0.03), points.spacing_m)
    assert len(certain_points(uncertain).position) < len(points.position)  # a strip of them is left out
    mesh = poisson_mesh(uncertain, points.spacing_m, tmp_path)
    assert holes_of(mesh) == []
    assert parts_of(mesh)[0] == 1


def test_depth_gives_cells_of_a_voxel() -> None:
    for side_m, voxel_m in ((40.0, 0.25), (300.0, 0.1), (1000.0, 0.02)):
        cell_m = 1.1 * side_m / 2 ** poisson_depth(plane(side_m, spacing_m=side_m / 100), voxel_m)
        assert 0.95 * voxel_m < cell_m < 2 * voxel_m or side_m / voxel_m > 2**14
    assert poisson_depth(plane(1.0), 10.0) == 5


def test_surface_far_from_points_is_cut() -> None:
    """A sphere around a plane: all its faces are farther than the rim, and its part is too far to be a gap."""
    points, ball = plane(10.0), trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    far = RawMesh(ball.vertices + np.array([20.0, 0.0, 0.0]), np.array(ball.faces, dtype=np.int64))
    assert len(near_points(far, points).faces) == 0


def test_what_one_view_shows_is_left_out(tmp_path: Path) -> None:
    """A plate 16 m above the ground in one of eight maps: the others look through it."""
    points = points_of(surface_views(tmp_path, floater=True))
    assert points.position[:, 2].max() - GEO_FROM_MODEL.translation[2] < BOX_M + PIXEL_M


@pytest.mark.usefixtures("children_here")
def test_steps_of_a_border_are_no_edges_of_the_simplified_mesh(tmp_path: Path) -> None:
    """Faces of a level grid that end at a slanted line: few edges along it are left, within a cell of it."""
    side, slope = 60, 0.37
    column, row = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side)))
    vertices = np.column_stack([column, row, np.zeros(side * side)]).astype(float)
    first = np.flatnonzero((column < side - 1) & (row < side - 1))
    faces = np.concatenate(
        [
            np.column_stack([first, first + 1, first + side]),
            np.column_stack([first + 1, first + side + 1, first + side]),
        ]
    )
    below = vertices[:, 1] < 20 + slope * vertices[:, 0]
    stepped = compact(RawMesh(vertices, faces[below[faces].all(axis=1)]))
    simple = simplified(stepped, 0.5, tmp_path)
    assert len(holes_of(simple)) == 0
    _, before = edges_of(stepped.faces)
    _, after = edges_of(simple.faces)
    assert (after == 1).sum() < 0.15 * (before == 1).sum()
    off = (20 + slope * simple.vertices[:, 0] - simple.vertices[:, 1]) / np.hypot(1, slope)
    assert off.min() > -0.5  # beyond the line, by a part of a cell
    assert distances_from_mesh(stepped.vertices, simple, 1.0).max() < 1.5


@pytest.mark.parametrize(("wave_m", "least", "most"), [(0.2, 8, 24), (2.0, 60, 120)])
def test_borders_lose_vertices_within_a_tolerance(wave_m: float, least: int, most: int) -> None:
    """A square with a square hole, whose sides wave: those straight within the tolerance need their ends alone."""
    side = 60
    column, row = (axis.ravel().astype(float) for axis in np.meshgrid(np.arange(side), np.arange(side)))
    first = np.flatnonzero((column < side - 1) & (row < side - 1))
    corners = np.stack([first, first + 1, first + side, first + side + 1], axis=1)
    hole = ((np.abs(column[corners] - 30) < 8) & (np.abs(row[corners] - 30) < 8)).any(axis=1)
    corners = corners[~hole]
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [1, 3, 2]]])
    waves = wave_m / 2 * np.sin(0.9 * column)
    mesh = compact(RawMesh(np.column_stack([column, row + 0.1 * waves, waves]), faces))
    found = with_long_rims(mesh, 0.25)
    _, count = edges_of(found.faces)
    assert count.max() == 2
    assert least <= (count == 1).sum() <= most < len(border_of(mesh)) / 2
    assert len(holes_of(found)) == 1
    assert (vertex_normals(found)[:, 2] > 0).all()  # no face has turned over
    border = np.unique(border_of(mesh))
    assert distances_from_mesh(mesh.vertices[border], found, 0.1).max() <= 0.25 + 1e-9


@pytest.mark.usefixtures("children_here")
def test_simplification_keeps_its_error(tmp_path: Path) -> None:
    """A sphere of 5 m: the measured error is that of the chords; the bound is on distances from planes."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=5.0)
    mesh = RawMesh(np.array(ball.vertices), np.array(ball.faces, dtype=np.int64))
    for error_m in (0.01, 0.05):
        simple = simplified(mesh, error_m, tmp_path)
        off = distances_from_mesh(mesh.vertices, simple, 0.1)
        inner = 5.0 - np.linalg.norm(simple.vertices[simple.faces].mean(axis=1), axis=1)
        assert 0.2 * inner.max() < off.max() < 10 * error_m
        assert np.sqrt(np.mean(off**2)) < error_m / 2
        assert len(simple.faces) < len(mesh.faces) / 2
    np.testing.assert_allclose(distances_from_mesh(2 * mesh.vertices[:50], mesh, 0.1), 5.0, rtol=1e-6)


def test_watertight_mesh_is_a_solid(simple: RawMesh) -> None:
    solid, of_surface = closed(simple, 2.0)
    np.testing.assert_array_equal(solid.faces[:of_surface], simple.faces)
    body = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert body.is_watertight and body.is_winding_consistent
    # All that is below the surface, down to a base 2 m below. Bays of the rim, closed by walls, may count as holes.
    a, b, c = (simple.vertices[simple.faces[:, k], :] for k in range(3))
    plan_m2 = np.cross(b - a, c - a)[:, 2] / 2
    heights = (a + b + c)[:, 2] / 3 - solid.vertices[:, 2].min()
    assert body.volume == pytest.approx(plan_m2 @ heights, rel=0.02)


def test_islands_are_left_out() -> None:
    far = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    ground = trimesh.creation.box((10.0, 10.0, 1.0))
    vertices = np.concatenate([ground.vertices, far.vertices + 20])
    mesh = RawMesh(vertices, np.concatenate([ground.faces, far.faces + len(ground.vertices)]).astype(np.int64))
    kept, left_out = without_islands(mesh, 1.0)
    assert (len(kept.faces), left_out) == (12, 1)
    assert len(without_islands(mesh, 0.0)[0].faces) == len(mesh.faces)


def test_colours_are_those_of_the_photographs(views: SurfaceViews, whole: RawMesh) -> None:
    rgb, known = photographed_colours(whole.vertices, vertex_normals(whole), views, GEO_FROM_MODEL)
    at = whole.vertices - GEO_FROM_MODEL.translation
    # No view shows the walls, and few the ground around the views.
    reach = np.abs(at[:, :2]).max(axis=1)
    flat = (reach < 2 * PIXEL_M) | ((reach > BOX_M + 8 * PIXEL_M) & (reach < 12))
    assert known[flat].mean() > 0.98
    clear = known & (np.abs(at[:, 0]) > 2 * PIXEL_M)
    assert (rgb[clear & (at[:, 0] > 0)] == EAST).all()
    assert (rgb[clear & (at[:, 0] < 0)] == WEST).all()


def test_other_readers_see_mesh_and_texture(views: SurfaceViews, whole: RawMesh, tmp_path: Path) -> None:
    result = textured(whole, views, GEO_FROM_MODEL, PIXEL_M)
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
    assert geometry.visual.material.doubleSided
    for loaded, picture in (
        (geometry, geometry.visual.material.baseColorTexture),
        (obj, obj.visual.material.image),
    ):
        image = np.asarray(picture.convert("RGB"))
        place = loaded.visual.uv[loaded.faces].mean(axis=1)
        row = ((1 - place[:, 1]) * len(image)).astype(int)
        rgb = image[row, (place[:, 0] * image.shape[1]).astype(int)]
        corners = np.asarray(loaded.vertices)[loaded.faces][..., 0]
        # Clear of the border between the colours, and of the places that no view shows: walls, and the outer rim.
        reach = np.abs(vertices[result.mesh.faces][..., :2]).max(axis=2)
        flat = (reach < BOX_M / 2).all(axis=1) | ((reach > BOX_M + 4 * PIXEL_M) & (reach < 13)).all(axis=1)
        corners = np.where(flat[:, None], corners, 0)
        clear_east, clear_west = corners.min(axis=1) > 2 * PIXEL_M, corners.max(axis=1) < -2 * PIXEL_M
        assert clear_east.sum() > 20 and clear_west.sum() > 20
        assert (rgb[clear_east] == EAST).all(axis=1).mean() > 0.97
        assert (rgb[clear_west] == WEST).all(axis=1).mean() > 0.97
    write_mesh_ply(
        tmp_path / "crs.ply",
        vertices + 5e6,
        result.mesh.faces,
        np.full(vertices.shape, 7),
        double=True,
        sigma=(vertices[:, 0], vertices[:, 1]),
    )
    ply = PlyData.read(tmp_path / "crs.ply")
    np.testing.assert_array_equal(ply["vertex"]["x"], vertices[:, 0] + 5e6)
    np.testing.assert_array_equal(ply["vertex"]["sigma_v"], vertices[:, 1].astype(np.float32))
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), result.mesh.faces)
    read, faces = read_mesh_ply(tmp_path / "crs.ply")
    np.testing.assert_array_equal(read, vertices + 5e6)
    np.testing.assert_array_equal(faces, result.mesh.faces)


def test_too_little_memory_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "free_main_memory_bytes", lambda: 1 << 30)
    assert stage._memory_excess(1000, 0.1, stated=True) < 1
    with refused("mesh-memory", ResourceError):
        stage._memory_excess(10_000_000, 0.1, stated=True)
    # Voxels that nobody has stated become larger: a fourth of the points fits where the excess is four.
    excess = stage._memory_excess(10_000_000, 0.1, stated=False)
    assert stage._memory_excess(int(10_000_000 / excess), 0.1 * excess**0.5, stated=False) <= 1


def test_edges_and_vertices_are_those_of_plain_sorting() -> None:
    faces = np.random.default_rng(0).integers(0, 60, (200, 3))
    mesh = RawMesh(np.random.default_rng(1).random((70, 3)), faces)
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    for found, expected in zip(
        edges_of(faces), np.unique(pairs, axis=0, return_inverse=True, return_counts=True)[1:], strict=True
    ):
        np.testing.assert_array_equal(found, expected.ravel())
    used, of_used = np.unique(faces, return_inverse=True)
    np.testing.assert_array_equal(compact(mesh).vertices, mesh.vertices[used])
    np.testing.assert_array_equal(compact(mesh).faces, of_used.reshape(-1, 3))
    assert len(edges_of(np.zeros((0, 3), np.int64))[1]) == 0


@pytest.mark.parametrize(("faces", "double"), [(0, False), (7, True)])
def test_mesh_files_are_those_that_plyfile_writes(faces: int, double: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write_mesh_ply(
        tmp_path / "own.ply", rng.random((9, 3)), rng.integers(0, 9, (faces, 3)),
        rng.integers(0, 255, (9, 3)).astype(np.uint8), double=double, sigma=(rng.random(9), rng.random(9)),
    )  # fmt: skip
    PlyData.read(str(tmp_path / "own.ply")).write(str(tmp_path / "plyfile.ply"))
    assert (tmp_path / "own.ply").read_bytes() == (tmp_path / "plyfile.ply").read_bytes()


@pytest.mark.slow
def test_mesh_of_a_trained_survey_lies_on_its_ground(
    trained: list[tuple[Workspace, Workspace]], tmp_path: Path
) -> None:
    root = tmp_path / "ws"
    workspace = own_copy(trained[0][0], root)
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
    assert body.is_watertight and len(body.faces) > values["faces"]
    sidecar = load_json(MeshSidecar, sidecar_path(workspace.path(MESH)))
    assert sidecar.mesh.faces == len(body.faces) and sidecar.mesh.largest_simplification_error_m == 0
    textured_file = load_json(MeshSidecar, sidecar_path(workspace.path(MESH_GLB))).mesh
    assert textured_file.faces == values["faces"]
    assert textured_file.largest_simplification_error_m == values["largest_simplification_error_m"]
    assert 0 < textured_file.rms_simplification_error_m < values["voxel_m"] / 2
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
