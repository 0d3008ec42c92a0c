"""Bar charts: a picture, whatever the figures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.report.plots.charts import BarChart, write_bars

BLUE, ORANGE = (0x2B, 0x6C, 0xB0), (0xDD, 0x8A, 0x3B)


def picture(path: Path, *panels: BarChart) -> np.ndarray:
    """What is drawn, RGB."""
    write_bars(path, panels)
    image = cv2.imread(str(path))
    assert image is not None
    return image[..., ::-1]


def columns(image: np.ndarray, colour: tuple[int, int, int]) -> list[int]:
    """Heights in pixels of the bars of a colour, from left to right."""
    height = (image == colour).all(axis=2).sum(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (height > 2).astype(int), [0]])))
    return [int(np.median(height[a:b])) for a, b in edges.reshape(-1, 2) if b - a > 10]


def panel(*heights: float | None) -> BarChart:
    return BarChart("title", "metres", tuple("ABCD"[: len(heights)]), {"horizontal": heights})


def test_bars_are_as_high_as_their_figures(tmp_path: Path) -> None:
    heights = columns(picture(tmp_path / "bars.png", panel(0.1, 0.2, 0.4)), BLUE)
    np.testing.assert_allclose(heights, np.array([0.25, 0.5, 1.0]) * heights[2], atol=4)


def test_figures_of_other_orders_of_magnitude_show_too(tmp_path: Path) -> None:
    heights = columns(picture(tmp_path / "bars.png", panel(0.01, 0.1, 25.0)), BLUE)
    assert len(heights) == 3
    assert heights[0] > 0.04 * heights[2]  # a linear axis would leave a fraction of a pixel


def test_series_stand_side_by_side_and_gaps_stay_gaps(tmp_path: Path) -> None:
    two = BarChart("title", "m", ("A", "B"), {"horizontal": (1.0, None), "vertical": (0.5, 0.7)})
    image = picture(tmp_path / "bars.png", two)
    legend = 1  # a patch of each colour under the axis, over which its column counts
    assert len(columns(image[: int(0.85 * len(image))], BLUE)) == 1
    assert len(columns(image[: int(0.85 * len(image))], ORANGE)) == 1 + legend


@pytest.mark.parametrize("heights", [(), (None, None), (0.0, 0.0), (0.0, 3.0), (-1.0, 2.0), (5e-9, 1e9)])
def test_odd_figures_are_drawn_without_a_warning(heights: tuple[float | None, ...], tmp_path: Path) -> None:
    assert picture(tmp_path / "bars.png", panel(*heights)).std() > 1  # not an empty page


def test_equal_figures_give_equal_files(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_bars(tmp_path / name, [panel(1.0, 2.0), panel(3.0)])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]
