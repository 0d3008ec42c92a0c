"""Depth read off a render: which of its depths, and between its pixels."""

from __future__ import annotations

import numpy as np
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.rasterizer.api import Render, ScreenStats
from pipelines.splat.surface import depth_at, measured_depth

PINHOLE = Pinhole(24, 18, 20.0, 20.0, 12.0, 9.0)


def test_depth_is_bilinear_between_pixel_centres() -> None:
    depth = torch.arange(24.0)[None] + 100 * torch.arange(18.0)[:, None]
    xy = torch.tensor([[0.0, 0.0], [0.025, -0.05], [0.7, 0.0]], dtype=torch.float64)
    sampled, seen = depth_at(depth, torch.ones(18, 24), xy, PINHOLE)
    # The principal point is the corner between pixels 11 and 12, rows 8 and 9; half a pixel right, one up.
    np.testing.assert_allclose(sampled[:2], [11.5 + 850, 12.0 + 750], rtol=1e-6)
    assert seen.tolist() == [1.0, 1.0, 0.0]
    assert depth_at(depth, torch.full((18, 24), 0.3), xy, PINHOLE)[1].tolist() == [0.0, 0.0, 0.0]


def test_measured_depth_is_the_mean_where_there_is_but_one_surface() -> None:
    median = torch.tensor([[10.0, 10.0, 10.0, 0.0]])
    # On one surface; one with haze behind it; haze before it, far off; haze alone.
    expected = torch.tensor([[10.01, 10.05, 7.0, 3.0]])
    sigma = torch.tensor([[0.02, 0.2, 4.0, 2.0]])
    stats = ScreenStats(torch.empty(0))
    view = Render(median, median, stats, expected, sigma.square(), median)
    torch.testing.assert_close(measured_depth(view), torch.tensor([[10.01, 10.0, 10.0, 0.0]]))
