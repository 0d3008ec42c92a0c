"""The surface of a rendered hill: right, kept on disk, and made again when what it depends on changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipelines.splat.initialise import InitialisationOptions
from pipelines.surface.depth_maps import DepthMaps
from pipelines.survey.photographs import ImageCache, save_array
from pipelines.survey.scene import SparseScene, make_scene, photographs
from pipelines.train.initial_gaussians import TrainingScene, depth_loss_points, fallback_points, initial_gaussians
from pipelines.train.surface import SceneSurface, spread_evenly
from tests.scenes import GEO_FROM_LOCAL, write_workspace
from tests.splat_scenes import CAMERA, Rendered, ground_height, make_rendered

pytestmark = pytest.mark.usefixtures("one_thread")

# A pixel of these small photographs is half a metre wide on the ground, neighbours are 20° to 50° apart: a quarter
# of a pixel is 0.25 m of height.
QUARTER_PX_M = 0.25


def _photograph(rendered: Rendered, folder: Path) -> None:
    """Pictures of the textured hill by ray casting: rendered Gaussians, ordered by their centres, bulge."""
    folder.mkdir()
    noise = np.random.default_rng(5).uniform(0, 255, (160, 160, 3)).astype(np.float32)
    texture = np.clip(4 * cv2.GaussianBlur(noise, (0, 0), 1.2) - 380, 0, 255)
    x, y = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    fx, fy, cx, cy = CAMERA.params
    in_cam = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    scene = rendered.scene
    for name, center, rotation in zip(scene.names, scene.center_in_geo, scene.geo_from_cam, strict=True):
        ray = in_cam @ rotation.T
        height = np.zeros(x.shape)
        for _ in range(30):  # the hill is flatter than any ray: this converges
            place = center + ((height - center[2]) / ray[..., 2])[..., None] * ray
            height = ground_height(place[..., 0], place[..., 1])
        column, row = ((place[..., axis] / 0.5 + 80).astype(np.float32) for axis in (0, 1))
        picture = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        (folder / name).write_bytes(cv2.imencode(".png", picture.round().astype(np.uint8))[1].tobytes())


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rendered, SparseScene, ImageCache]:
    rendered = make_rendered()
    root = tmp_path_factory.mktemp("hill")
    _photograph(rendered, root / "photos")
    workspace = write_workspace(root, rendered.survey, rendered.sparse)
    scene = make_scene(rendered.sparse, rendered.survey, GEO_FROM_LOCAL, np.zeros(3))
    return rendered, scene, photographs(rendered.sparse, rendered.survey, workspace, 640)


@pytest.fixture(scope="module")
def maps(material: tuple[Rendered, SparseScene, ImageCache], tmp_path_factory: pytest.TempPathFactory) -> DepthMaps:
    found = DepthMaps(tmp_path_factory.mktemp("surface"), *material[1:])
    found.build()
    return found


@pytest.fixture(scope="module")
def surface(maps: DepthMaps) -> SceneSurface:
    return SceneSurface(maps)


def test_surface_is_the_hill(
    maps: DepthMaps, surface: SceneSurface, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    errors, seen = [], []
    for index in material[1].train:
        points = surface.points(int(index))
        near = points[(np.abs(points[:, :2]) < 26).all(axis=1)]
        errors.append(near[:, 2] - ground_height(near[:, 0], near[:, 1]))
        seen.append((maps.depth(int(index)) > 0).mean())
    error = np.abs(np.concatenate(errors))
    assert np.median(error) < QUARTER_PX_M
    assert (error < 4 * QUARTER_PX_M).mean() > 0.9
    assert np.mean(seen) > 0.3


def test_sample_is_thinned_and_coloured(surface: SceneSurface) -> None:
    some = surface.sample(300, seed=0)
    assert 150 < len(some.rgb) <= 300
    assert some.rgb.std() > 20  # not all alike
    np.testing.assert_array_equal(some.point_in_model, surface.sample(300, seed=0).point_in_model)


def test_sample_knows_the_slope_of_the_hill(surface: SceneSurface) -> None:
    some = surface.sample(2000, seed=0)
    near = (np.abs(some.point_in_model[:, :2]) < 26).all(axis=1) & np.isfinite(some.normal_in_model).all(axis=1)
    assert near.sum() > 300
    x, y, step = some.point_in_model[near, 0], some.point_in_model[near, 1], 0.5
    slope = [
        (ground_height(x + step, y) - ground_height(x - step, y)) / (2 * step),
        (ground_height(x, y + step) - ground_height(x, y - step)) / (2 * step),
    ]
    true = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=1)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(np.abs((true * some.normal_in_model[near]).sum(axis=1)), 0, 1)))
    # A quarter of a pixel of height against four pixels across is 3.6°.
    assert np.median(angle) < 2 * 3.6


def test_fallback_points_lie_at_the_height_of_the_sfm_points(
    surface: SceneSurface, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    scene = material[1]
    east = fallback_points(scene, surface.maps, 300, 0, lambda points: points[:, 0] > 0)
    assert 150 < len(east.rgb) <= 300 and east.rgb.std() > 20
    assert (east.point_in_model[:, 0] > 0).all() and np.isnan(east.normal_in_model).all()
    near = east.point_in_model[(np.abs(east.point_in_model[:, :2]) < 26).all(axis=1)]
    # Heights are those of the nine nearest of some hundred points, metres apart on slopes of up to a half.
    assert np.median(np.abs(near[:, 2] - ground_height(near[:, 0], near[:, 1]))) < 4 * QUARTER_PX_M
    nothing = fallback_points(scene, surface.maps, 0, 0, lambda points: points[:, 0] > 0)
    assert len(nothing.rgb) == 0


def test_maps_are_kept_and_continued(maps: DepthMaps, material: tuple[Rendered, SparseScene, ImageCache]) -> None:
    first = sorted(maps.folder.iterdir())
    before = {path: path.stat().st_mtime_ns for path in first}
    lost = first[3]
    content = lost.read_bytes()
    lost.unlink()
    again = DepthMaps(maps.folder.parent, *material[1:])
    again.build()
    assert lost.read_bytes() == content
    assert sorted(maps.folder.iterdir()) == first  # nothing of what is on the way stays
    assert all(path.stat().st_mtime_ns == before[path] for path in first if path != lost)


def test_another_scene_has_other_maps(maps: DepthMaps, material: tuple[Rendered, SparseScene, ImageCache]) -> None:
    _, scene, images = material
    fewer = replace(scene, train=scene.train[:-1])
    assert DepthMaps(maps.folder.parent, fewer, images).folder != maps.folder


def test_another_processor_finds_the_maps(
    maps: DepthMaps, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    """The last bits of a solution are those of its processor."""
    _, scene, images = material

    def with_translations(offset: float, factor: float) -> SparseScene:
        sparse = scene.sparse
        translation = factor * sparse.translation_cam_from_local + offset
        points = factor * sparse.point_in_local
        return replace(scene, sparse=replace(sparse, translation_cam_from_local=translation, point_in_local=points))

    other = with_translations(0.0, 1 + 1e-15)
    assert not np.array_equal(other.point_in_model, scene.point_in_model)
    assert DepthMaps(maps.folder.parent, other, images).folder == maps.folder
    # A tenth of a millimetre is less than a hundredth of a pixel here, and seen all the same.
    assert DepthMaps(maps.folder.parent, with_translations(1e-4, 1.0), images).folder != maps.folder


def test_test_views_show_nothing_of_the_surface(
    maps: DepthMaps, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    held_out = {f"{int(index):06d}" for index in material[1].test}
    assert not held_out & {path.name.split(".")[0] for path in maps.folder.iterdir()}


def test_gaussians_start_on_the_surface(
    surface: SceneSurface, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    _, scene, images = material
    options = InitialisationOptions(sh_degree=0)
    without = initial_gaussians(TrainingScene(scene, images), options, 3000, 0)
    start = initial_gaussians(TrainingScene(scene, images, surface), options, 3000, 0)
    assert len(without) < len(start) <= 3000
    place = start.means.numpy()
    near = place[(np.abs(place[:, :2]) < 26).all(axis=1)]
    assert np.median(np.abs(near[:, 2] - ground_height(near[:, 0], near[:, 1]))) < QUARTER_PX_M


def test_gaussians_start_as_discs_however_many_sfm_points_there_are(
    surface: SceneSurface, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    _, scene, images = material
    most = len(scene.point_in_model)  # as many as there may be: balls at all of them would leave no room for discs
    start = initial_gaussians(TrainingScene(scene, images, surface), InitialisationOptions(sh_degree=0), most, 0)
    scale = start.log_scales.exp()
    discs = int((scale.amin(dim=1) < 0.2 * scale.amax(dim=1)).sum())
    sfm = torch.from_numpy(scene.point_in_model).float()
    on_hill = (sfm[:, :2].abs() < 20).all(dim=1)
    balls = int((torch.cdist(sfm[on_hill], start.means).amin(dim=1) < 1e-4).sum())
    assert discs > most // 4  # most of the start is the surface's, and normals are known of more than half of that
    assert balls < 0.1 * on_hill.sum()


def test_fewer_start_on_a_surface_of_which_less_is_known(
    maps: DepthMaps, surface: SceneSurface, material: tuple[Rendered, SparseScene, ImageCache], tmp_path: Path
) -> None:
    _, scene, images = material
    part = DepthMaps(tmp_path, scene, images)
    for path in maps.folder.glob("*.depth.npy"):
        depth = np.load(path)
        depth[:, depth.shape[1] // 4 :] = 0
        save_array(part.folder / path.name, depth)
    most, options = 3000, InitialisationOptions(sh_degree=0)

    def discs(found: SceneSurface) -> int:
        scale = initial_gaussians(TrainingScene(scene, images, found), options, most, 0).log_scales.exp()
        return int((scale.amin(dim=1) < 0.2 * scale.amax(dim=1)).sum())

    quarter = SceneSurface(part)
    assert quarter.known_share() < 0.3 * surface.known_share()
    # Known of a quarter of the pixels, it starts with no more than a third of the Gaussians: trees have the others.
    assert 0 < discs(quarter) < most / 3 < discs(surface)


def test_depth_loss_points_are_those_of_the_view(
    surface: SceneSurface, material: tuple[Rendered, SparseScene, ImageCache]
) -> None:
    _, scene, images = material
    known = depth_loss_points(TrainingScene(scene, images, surface), torch.device("cpu"))
    train, test = int(scene.train[0]), int(scene.test[0])
    seen = len(np.unique(scene.sparse.obs_point[scene.sparse.obs_image == train]))
    assert len(known(train).point_in_model) > seen
    assert len(known(test).point_in_model) == len(np.unique(scene.sparse.obs_point[scene.sparse.obs_image == test]))


def test_spreading_keeps_few_enough_and_covers_all() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 1, (5000, 3)), rng.uniform(9, 10, (50, 3))])
    kept = spread_evenly(points, np.full(len(points), 0.01), 200)
    assert 60 < len(kept) <= 200
    assert (kept >= 5000).sum() > 10  # the sparse corner has its cubes too
    np.testing.assert_array_equal(spread_evenly(points[:10], np.ones(10), 200), np.arange(10))
