"""Weights of the depth loss: they grow with contrast, where the surface goes on."""

from __future__ import annotations

import numpy as np

from pipelines.train.surface import depth_loss_weights

HEIGHT, WIDTH = 60, 80


def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Return a photograph of a slanted wall before a further one, with equal boards on the wall and at its edge."""
    rng = np.random.default_rng(3)
    rgb = (120 + rng.integers(-6, 7, (HEIGHT, WIDTH, 1))).repeat(3, axis=2).astype(np.uint8)
    for row, column in ((20, 20), (40, 49)):
        rgb[row - 2 : row + 2, column - 2 : column + 2] = 250
    columns = np.arange(WIDTH)
    depth = np.where(columns < 50, 1 / (0.1 + 0.0005 * columns), 1 / (0.06 + 0.0005 * columns))
    return rgb, np.tile(depth.astype(np.float32), (HEIGHT, 1))


def test_details_weigh_more_than_the_wall_around_them() -> None:
    rgb, depth = pictures()
    weight = depth_loss_weights(rgb, depth)
    assert weight[5:55, 10:40].min() >= 1.0
    assert weight[20, 20] > 3 * np.median(weight[:, 10:40])


def test_photographs_of_any_exposure_weigh_alike() -> None:
    rgb, depth = pictures()
    darker = (rgb.astype(np.float64) / 2).round().astype(np.uint8)
    bright, dark = depth_loss_weights(rgb, depth), depth_loss_weights(darker, depth)
    # Rounding to whole grey levels moves a contrast of some 3 levels by a tenth.
    assert np.abs(dark / bright - 1)[:, 10:40].mean() < 0.1


def test_edges_and_gaps_of_the_surface_weigh_least() -> None:
    rgb, depth = pictures()
    weight = depth_loss_weights(rgb, depth)
    assert (weight[:, 47:53] == weight.min()).all() and weight.min() < 1
    depth[17:19, 17:19] = 0
    assert depth_loss_weights(rgb, depth)[20, 20] == weight.min()
    assert (depth_loss_weights(rgb, np.zeros_like(depth)) == 1).all()  # nothing to compare with
