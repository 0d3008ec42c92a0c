"""Levels of detail: from the distance at which a viewer shows it, a level looks like the Gaussians themselves."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import max_pool2d

from pipelines.formats.splat_ply import SplatArrays
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.level_of_detail import Tiler, build_tiles, scene_box, shadow_areas
from pipelines.splat.rasterizer.api import RasterSettings, Render
from pipelines.splat.rasterizer.cpu import CpuRasterizer

CAMERA = Pinhole(96, 96, 120.0, 120.0, 48.0, 48.0)
PIXELS = 16.0  # of the error, from where on CesiumJS replaces a tile by its children


def painted_ground(count: int = 6000) -> SplatArrays:
    """Return flat Gaussians on a square of 20 m with stripes of colours."""
    rng = np.random.default_rng(1)
    means = np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.normal(0, 0.02, count)])
    quats = np.tile(np.array([1.0, 0, 0, 0]), (count, 1))
    scales = np.tile(np.log([0.2, 0.2, 0.01]), (count, 1)) + rng.normal(0, 0.2, (count, 3))
    colour = 0.5 + 0.4 * np.sin(means[:, :1] / 2 + np.array([0.0, 2.0, 4.0]))
    parts = (means, quats, scales, np.full(count, 1.5), ((colour - 0.5) / 0.2820948)[:, None])
    return SplatArrays(*(part.astype(np.float32) for part in parts))


def seen_from(splat: SplatArrays, distance_m: float) -> Render:
    """Render from a place 45° above the ground, looking at its middle."""
    half = np.sqrt(0.5)
    cam_from_model = np.eye(4)
    cam_from_model[:3] = [[1, 0, 0, 0], [0, -half, -half, 0], [0, half, -half, distance_m]]
    gaussians = Gaussians(**{name: torch.tensor(values) for name, values in vars(splat).items()})
    settings = RasterSettings(sh_degree=0)
    return CpuRasterizer().render(gaussians, torch.tensor(cam_from_model).float(), CAMERA, settings)


def test_levels_look_like_what_they_stand_for() -> None:
    ground, contents = painted_ground(), dict[str, SplatArrays]()

    def write(name: str, content: SplatArrays, *, is_leaf: bool) -> None:
        contents[name] = content

    root = build_tiles([ground], scene_box(ground.means), Tiler(10_000, write))
    levels = [tile for tile in root.all() if tile.children]
    assert len(levels) == 2
    for tile in levels:
        assert tile.count <= 0.5 * tile.children[0].count
        distance_m = tile.error_m * CAMERA.fx / PIXELS
        truth, shown = seen_from(ground, distance_m), seen_from(contents[tile.name], distance_m)
        # Cells are four pixels wide there: that far from its edge, the ground is closed and has its colours.
        # Stripes of 12.6 m lose 1 − exp(−½ (2π / 12.6 m · σ)²) of their contrast, 5 % for the coarsest σ of 0.6 m.
        closed = -max_pool2d(-truth.alpha.squeeze()[None], kernel_size=9, stride=1, padding=4)[0] > 0.95
        assert closed.sum() > 1000
        assert shown.alpha.squeeze()[closed].mean() > 0.98
        error = (shown.colour - truth.colour)[closed]
        assert error.mean().abs() < 0.01
        assert error.square().mean().sqrt() < 0.05
        assert abs(float(shown.alpha.sum() / truth.alpha.sum()) - 1) < 0.05


def test_area_of_shadows_is_the_mean_over_directions() -> None:
    """Against the integral over a sphere: the shadow along d has the area 2π √(dᵀ adj(Σ) d)."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sigmas = np.array([[1.0, 1, 1], [1, 1, 1e-3], [3, 1, 0.2], [5, 0.1, 0.1]])
    adjugate = np.stack([np.roll(row, 1) * np.roll(row, 2) for row in sigmas]) ** 2
    expected = 2 * np.pi * np.sqrt(directions**2 @ adjugate.T).mean(axis=0)
    # Thomsen's formula is right within 1.1 %; 20 000 directions leave 0.6 % at most (σ of |cos| is 0.29, mean 0.5).
    np.testing.assert_allclose(shadow_areas(sigmas), expected, rtol=0.02)
