"""Point cloud: on the true surface, one point a voxel, the same in one square or in many, with an honest σ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import laspy
import numpy as np
import pytest
from plyfile import PlyData

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json
from pipelines.core.progress import SILENT
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, CLOUD
from pipelines.core.workspace import Workspace
from pipelines.deliver import surface
from pipelines.deliver.surface import shared_squares
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.geodesy.enu import enu_from_ecef
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.surface import fusion
from pipelines.surface.fusion import FusionSettings, SurfaceCloud, fused_squares, pixel_on_surface_m
from pipelines.surface.surface_views import SurfaceViews
from pipelines.survey.navigation import load_survey
from tests.depth_scenes import BOX_M, CAMERA, DOWN, depth_map, looking_down
from tests.refusals import numbers, refused
from tests.splat_scenes import ground_height
from tests.trained_workspaces import own_copy

GEO_FROM_MODEL = Similarity(1.0, np.eye(3), np.array([1000.0, -500.0, 20.0]))
CENTERS = looking_down(8)
PIXEL_M = 36 / CAMERA.fx
SETTINGS = FusionSettings(PIXEL_M, 2 * PIXEL_M, 3)


def surface_views(folder: Path, offset_m: np.ndarray | float = 0.0) -> SurfaceViews:
    """Return the views of ground and box; each map lies off by its own number of metres."""
    offset = np.broadcast_to(offset_m, len(CENTERS))
    rgb = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)

    def surface(index: int) -> tuple[np.ndarray, np.ndarray]:
        depth = depth_map(CENTERS[index])
        return np.where(depth > 0, depth + np.float32(offset[index]), 0), rgb

    poses = CameraPoses(np.tile(DOWN, (len(CENTERS), 1, 1)), np.array(CENTERS))
    renderer: Any = SimpleNamespace(
        model=SimpleNamespace(similarity=GEO_FROM_MODEL, indices=lambda _split: list(range(len(CENTERS)))),
        poses=poses,
        images=SimpleNamespace(pinhole=lambda _index: CAMERA),
        surface=surface,
    )
    return SurfaceViews(renderer, folder, colours=True)


def cloud(views: SurfaceViews, settings: FusionSettings = SETTINGS) -> SurfaceCloud:
    parts = list(fused_squares(views, GEO_FROM_MODEL, settings))
    return SurfaceCloud(*(np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])))


def test_points_lie_on_the_plane_and_the_roof(tmp_path: Path) -> None:
    result = cloud(surface_views(tmp_path))
    at = result.position - GEO_FROM_MODEL.translation
    level = result.normal[:, 2] > 0.999
    roof = level & (np.abs(at[:, :2]).max(axis=1) < BOX_M - 2 * PIXEL_M)
    ground = level & (np.abs(at[:, :2]).max(axis=1) > BOX_M + 4 * PIXEL_M)
    assert roof.sum() > 50
    assert ground.sum() > 2000
    # float32 resolves depths of 36 m to 4e-6 m.
    np.testing.assert_allclose(at[roof, 2], BOX_M, atol=1e-4)
    np.testing.assert_allclose(at[ground, 2], 0, atol=1e-4)
    assert (result.rgb == 90).all()
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1, rtol=1e-12)


def test_each_voxel_holds_one_point(tmp_path: Path) -> None:
    views = surface_views(tmp_path)
    for spacing_m in (PIXEL_M, 3.7 * PIXEL_M):
        result = cloud(views, FusionSettings(spacing_m, 2 * PIXEL_M, 3))
        voxel = np.floor(result.position / spacing_m)
        assert len(np.unique(voxel, axis=0)) == len(voxel)
        # The ground that three views share is covered without holes: a point in nearly each of its voxels.
        inner = np.unique(
            voxel[(np.abs(result.position - GEO_FROM_MODEL.translation) < 15).all(axis=1)][:, :2], axis=0
        )
        assert len(inner) > 0.95 * (30 / spacing_m) ** 2 * 0.9


def test_squares_have_no_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = surface_views(tmp_path, np.random.default_rng(2).normal(0, 0.03, len(CENTERS)))
    whole = cloud(views)
    monkeypatch.setattr(fusion, "_MOST_CANDIDATES", 3000)
    parts = list(fused_squares(views, GEO_FROM_MODEL, SETTINGS))
    assert len(parts) > 8
    together = np.concatenate([part.position for part in parts])
    assert len(together) == len(whole.position)
    order = [np.lexsort(np.round(position, 6).T) for position in (together, whole.position)]
    np.testing.assert_allclose(together[order[0]], whole.position[order[1]], atol=1e-9)


def test_noise_of_the_views_is_averaged_and_stated(tmp_path: Path) -> None:
    """Maps that lie off by 5 cm each: the point is at the mean of those that see it, and σ is their spread."""
    offset = np.random.default_rng(5).normal(0, 0.05, len(CENTERS))
    result = cloud(surface_views(tmp_path, offset))
    at = result.position - GEO_FROM_MODEL.translation
    middle = (np.abs(at[:, :2]).max(axis=1) < BOX_M - 2 * PIXEL_M) & (result.normal[:, 2] > 0.99)
    # Maps are off along z, away from the camera: downwards. All eight cameras see the roof.
    np.testing.assert_allclose(at[middle, 2], BOX_M - offset.mean(), atol=0.01)
    # The rays' own share: a quarter of a pixel, over the RMS angle of the rays and √8.
    rays = np.array(CENTERS) - [0, 0, BOX_M]
    resultant = np.linalg.norm((rays / np.linalg.norm(rays, axis=1, keepdims=True)).mean(axis=0))
    intersection = 0.25 * (36 - BOX_M) / CAMERA.fx / np.sqrt(2 * (1 - resultant)) / np.sqrt(8)
    np.testing.assert_allclose(result.sigma_m[middle], np.hypot(np.std(offset), intersection), rtol=0.1)


def test_what_few_views_show_is_left_out(tmp_path: Path) -> None:
    """Two of eight maps lie off by 3 m: six others look through what they show."""
    offset = np.zeros(len(CENTERS))
    offset[[2, 6]] = -3.0
    result = cloud(surface_views(tmp_path, offset))
    level = result.normal[:, 2] > 0.999
    height = result.position[level, 2] - GEO_FROM_MODEL.translation[2]
    off_m = np.minimum(np.abs(height), np.abs(height - BOX_M))
    assert (off_m < 1e-3).mean() > 0.995
    nine = FusionSettings(PIXEL_M, 2 * PIXEL_M, 9)
    assert len(cloud(surface_views(tmp_path / "again"), nine).position) == 0


def test_the_fused_surface_is_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second deliverable reads what the first one fused; other settings, another place, or a part are fused."""
    views = surface_views(tmp_path)
    next(shared_squares(views, GEO_FROM_MODEL, SETTINGS, SILENT))  # and no more: nothing is kept of a part
    fused = list(fused_squares(views, GEO_FROM_MODEL, SETTINGS))
    first = list(shared_squares(views, GEO_FROM_MODEL, SETTINGS, SILENT))
    monkeypatch.setattr(surface, "fused_squares", lambda *_: iter(()))
    again = list(shared_squares(views, GEO_FROM_MODEL, SETTINGS, SILENT))
    assert len(fused) == len(first) == len(again) > 0
    for parts in zip(fused, first, again, strict=True):
        for name, values in vars(parts[0]).items():
            assert all(np.array_equal(vars(part)[name], values) for part in parts)
    elsewhere = replace(GEO_FROM_MODEL, scale=1.5)
    assert not list(shared_squares(views, elsewhere, SETTINGS, SILENT))
    assert not list(shared_squares(views, GEO_FROM_MODEL, replace(SETTINGS, min_views=4), SILENT))


def test_pixel_on_the_ground_is_depth_over_focal_length(tmp_path: Path) -> None:
    assert pixel_on_surface_m(surface_views(tmp_path), GEO_FROM_MODEL) == pytest.approx(PIXEL_M, rel=1e-6)


def test_a_model_without_surface_is_refused(tmp_path: Path) -> None:
    with refused("no-common-surface", DegenerateGeometryError) as error:
        pixel_on_surface_m(surface_views(tmp_path, -1e9), GEO_FROM_MODEL)
    assert numbers(str(error.value)) == [8]


@pytest.mark.slow
def test_cloud_of_a_trained_survey_lies_on_its_ground(
    trained: list[tuple[Workspace, Workspace]], tmp_path: Path
) -> None:
    root = tmp_path / "ws"
    workspace = own_copy(trained[0][0], root)
    values = run_stage(workspace, BY_NAME["export-cloud"], {"crs": "EPSG:4978", "ply": True}).manifest.values
    assert len(list((workspace.cache / "rendered").iterdir())) == 1  # for the next deliverable
    files = {path.name for path in (root / "cloud").iterdir()}
    pair = {"cloud.laz", "cloud.laz.georef.json", "cloud.ply", "cloud.ply.georef.json"}
    assert files == pair | {"cloud.laz.iso.xml", "cloud.ply.iso.xml", "manifest.json"}
    las, ply = laspy.read(workspace.path(CLOUD)), PlyData.read(root / "cloud/cloud.ply")["vertex"]
    assert las.header.point_count == ply.count == values["points"] > 5000
    sidecar = load_json(CrsSidecar, sidecar_path(workspace.path(CLOUD)))
    position = np.asarray(las.xyz)
    np.testing.assert_allclose(sidecar.bounds, [position.min(axis=0), position.max(axis=0)], atol=1e-3)
    assert sidecar.sigma is not None
    assert sidecar.sigma.median_sigma_v_m == pytest.approx(np.median(las["sigma_v"]), rel=0.02)
    in_geo = enu_from_ecef(position, load_survey(workspace).origin)
    seen_from_all_sides = np.hypot(in_geo[:, 0], in_geo[:, 1]) < 20
    above_m = in_geo[:, 2] - ground_height(in_geo[:, 0], in_geo[:, 1])
    # The hill is made of level discs of 0.9 m: a pixel of 0.47 m shows their upper sides and rims.
    assert np.sqrt(np.mean(above_m[seen_from_all_sides] ** 2)) < values["spacing_m"]
    # Normals along the axes of the CRS: here those of the Earth-centred frame, where up is away from the middle.
    normal = np.column_stack([las["nx"], las["ny"], las["nz"]])
    up = position / np.linalg.norm(position, axis=1, keepdims=True)
    assert np.median(np.einsum("ni,ni->n", normal, up)) > 0.95
