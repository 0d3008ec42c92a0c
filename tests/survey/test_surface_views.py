"""Surface as the training cameras see it: kept on disk, continued after an interruption, in metres of `geo`."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.surface.surface_views import SurfaceViews
from tests.depth_scenes import BOX_M, CAMERA, DOWN, depth_map, looking_down
from tests.refusals import refused

CENTERS = looking_down(5)
TRAINING = [0, 1, 3, 4]
# The model's east points elsewhere on Earth, and its metre is twice a metre; its up is up.
GEO_FROM_MODEL = Similarity(2.0, exp_so3(np.array([0.0, 0.0, 0.7])), np.array([100.0, 50.0, 3.0]))


class Renderer:
    """Stands in for the renderer of the trained model: exact depths, the camera's number as colour."""

    def __init__(self, fails_at: int = -1) -> None:
        self.rendered: list[int] = []
        self.fails_at = fails_at
        self.images: Any = SimpleNamespace(pinhole=lambda _index: CAMERA)
        poses = CameraPoses(np.tile(DOWN, (5, 1, 1)), np.array(CENTERS))
        self.poses = poses
        self.model = SimpleNamespace(
            similarity=GEO_FROM_MODEL, indices=lambda split: TRAINING if split == "train" else [2]
        )

    def surface(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        if index == self.fails_at:
            raise KeyboardInterrupt
        self.rendered.append(index)
        return depth_map(CENTERS[index]), np.full((CAMERA.height, CAMERA.width, 3), 10 * index, np.uint8)


def opened(renderer: Renderer, folder: Path, *, colours: bool = True) -> SurfaceViews:
    return SurfaceViews(renderer, folder, colours=colours)  # type: ignore[arg-type]


def test_views_are_those_of_the_training_cameras(tmp_path: Path) -> None:
    views = opened(Renderer(), tmp_path / "maps")
    assert len(views) == 4
    for number, camera in enumerate(TRAINING):
        view = views.view(number)
        assert view.camera == camera
        np.testing.assert_array_equal(view.depth_m, depth_map(CENTERS[camera]))
        assert view.rgb is not None
        assert view.rgb.shape == (CAMERA.height, CAMERA.width, 3)
        assert (view.rgb == 10 * camera).all()
        rows, columns = np.nonzero(view.depth_m > 35)
        np.testing.assert_allclose(view.points(rows, columns)[:, 2], 36 - view.depth_m[rows, columns], atol=1e-5)
    assert opened(Renderer(), tmp_path / "plain", colours=False).view(0).rgb is None


def test_interrupted_maps_are_continued(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        opened(Renderer(fails_at=3), tmp_path)
    with (tmp_path / "depths.f32").open("ab") as handle:
        handle.write(b"half a map")
    renderer = Renderer()
    views = opened(renderer, tmp_path)
    assert renderer.rendered == [3, 4]
    for number, camera in enumerate(TRAINING):
        np.testing.assert_array_equal(views.view(number).depth_m, depth_map(CENTERS[camera]))
    complete = Renderer()
    opened(complete, tmp_path)
    assert complete.rendered == []


def test_unconfirmed_depths_are_left_out(tmp_path: Path) -> None:
    """The render is plain where the photograph has a pattern: only where that has none, the depth stays."""
    renderer = Renderer()
    pattern = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)
    pattern[:, :40:2] = 160
    renderer.images.image = lambda _index: pattern
    depth = SurfaceViews(renderer, tmp_path, confirmed=True).view(0).depth_m  # type: ignore[arg-type]
    assert (depth[:, :32] == 0).all()
    np.testing.assert_array_equal(depth[:, 48:], depth_map(CENTERS[0])[:, 48:])


def test_support_is_in_metres_on_earth(tmp_path: Path) -> None:
    """Points 0.1 model metres above the roof: all four views pass 0.2 m below them."""
    points = np.array([[0.5, -1.0, BOX_M + 0.1], [-2.0, 0.3, BOX_M + 0.1]])
    support = opened(Renderer(), tmp_path).support(points)
    np.testing.assert_array_equal(support.views, 4)
    np.testing.assert_allclose(support.mean_up_m, -0.2, atol=1e-4)
    np.testing.assert_array_equal(opened(Renderer(), tmp_path).support(points, tolerance=0.001).views, 0)


def test_full_disk_is_an_error_before_rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 28))
    renderer = Renderer()
    with refused("disk-full", InputError):
        opened(renderer, tmp_path)
    assert renderer.rendered == []
