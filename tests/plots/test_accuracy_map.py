"""The accuracy map: places, directions and σ as given, read off the pixels of the picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.plots.accuracy_map import MapPoints, NamedPlaces, SigmaRaster, write_accuracy_map

LEAST, LARGEST, EMPTY = (0x44, 0x01, 0x54), (0xFD, 0xE7, 0x25), (0xE8, 0xE8, 0xE8)  # ends of viridis; no scene
CONTROL = (0xDD, 0x8A, 0x3B)
NO_POINTS = MapPoints()


def raster(sigma_h_m: np.ndarray, *, corner: tuple[float, float] = (0.0, 0.0), cell_m: float = 1.0) -> SigmaRaster:
    """A raster whose vertical σ is twice the horizontal one, upside down."""
    return SigmaRaster(sigma_h_m, 2 * sigma_h_m[::-1], np.array(corner), cell_m)


def maps(path: Path, sigma: SigmaRaster, points: MapPoints = NO_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """The left and the right half of the picture, RGB."""
    write_accuracy_map(path / "accuracy.png", sigma, points)
    image = cv2.imread(str(path / "accuracy.png"))
    assert image is not None
    left, right = np.array_split(image[..., ::-1], 2, axis=1)
    return left, right


def block(image: np.ndarray, colour: tuple[int, int, int]) -> tuple[slice, slice]:
    """Rows and columns of the largest area of a colour."""
    mask = (np.abs(image.astype(int) - colour) <= 1).all(axis=2).astype(np.uint8)  # rounding of a colour map
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    x, y, width, height, _ = stats[1 + stats[1:, cv2.CC_STAT_AREA].argmax()].tolist()
    return slice(y, y + height), slice(x, x + width)


def middle(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Column and row of the middle of the largest area of a colour."""
    rows, columns = block(image, colour)
    return np.array([(columns.start + columns.stop) / 2, (rows.start + rows.stop) / 2])


def test_north_is_up_and_east_is_right(tmp_path: Path) -> None:
    sigma = np.full((4, 4), np.nan)
    sigma[0, 0], sigma[3, 2] = 0.01, 0.05  # south-west; two columns east and three rows north of it
    left, right = maps(tmp_path, raster(sigma))
    east, south = middle(left, LARGEST) - middle(left, LEAST)
    rows, columns = block(left, LEAST)
    side = columns.stop - columns.start
    assert east == pytest.approx(2 * side, abs=3)
    assert south == pytest.approx(-3 * side, abs=3)
    assert rows.stop - rows.start == pytest.approx(side, abs=2)  # a metre is as long in both directions
    # The vertical σ, which is the other way round here, has the right-hand map.
    east, south = middle(right, LARGEST) - middle(right, LEAST)
    assert south == pytest.approx(3 * side, abs=3)


def test_cells_without_scene_are_empty(tmp_path: Path) -> None:
    sigma = np.full((3, 3), 0.02)
    sigma[0, 0] = 0.01
    sigma[1, 1] = np.nan
    left, _ = maps(tmp_path, raster(sigma))
    column, row = ((middle(left, LEAST) + 1) + [1, -1] * np.array(2 * [cell_side(left)])).astype(int)
    assert tuple(left[row, column]) == EMPTY


def cell_side(image: np.ndarray) -> int:
    """Pixels of a cell that is alone in its colour."""
    _, columns = block(image, LEAST)
    return columns.stop - columns.start


@pytest.mark.parametrize(("size_m", "corner"), [(0.2, (-1.0, 2.0)), (100.0, (-2200.0, 14_000.0))])
def test_points_lie_where_they_are(size_m: float, corner: tuple[float, float], tmp_path: Path) -> None:
    """On a small scene and on a large one, away from the origin."""
    sigma = np.full((6, 8), 0.05)
    sigma[0, 0] = 0.01
    place = np.array(corner) + size_m * np.array([5.5, 3.5])  # the middle of a cell
    points = MapPoints(np.array([corner]), NamedPlaces(place[None]), NamedPlaces(np.array([corner]) + size_m))
    left, right = maps(tmp_path, raster(sigma, corner=corner, cell_m=size_m), points)
    plain, _ = maps(tmp_path, raster(sigma, corner=corner, cell_m=size_m))
    offset = middle(left, CONTROL) - middle(plain, LEAST)
    np.testing.assert_allclose(offset, [5 * cell_side(plain), -3 * cell_side(plain)], atol=4)
    assert (right == CONTROL).all(axis=2).sum() > 20


def test_all_kinds_of_points_are_in_the_legend(tmp_path: Path) -> None:
    sigma = np.full((5, 5), 0.05)
    point = np.array([[2.5, 2.5]])
    heights = []
    for points in (NO_POINTS, MapPoints(point), MapPoints(point, NamedPlaces(point + 1), NamedPlaces(point - 1))):
        left, right = maps(tmp_path, raster(sigma), points)
        foot = np.concatenate([left, right], axis=1)[-45:]
        heights.append(int((foot < 200).any(axis=2).any(axis=0).sum()))  # columns that are written on
    assert heights[0] == 0 < heights[1] < heights[2]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "sigma",
    [
        np.full((1, 1), 0.3),
        np.full((1, 48), 1e-4),
        np.full((48, 1), 1e4),
        np.array([[np.nan, 0.0], [0.0, np.nan]]),
        np.array([[1e-9, 1e9]]),
    ],
    ids=["one cell", "strip east", "strip north", "zeros", "wide range"],
)
def test_odd_scenes_are_drawn_without_a_warning(sigma: np.ndarray, tmp_path: Path) -> None:
    cameras = np.random.default_rng(0).uniform(-5, 50, (1500, 2))
    left, right = maps(tmp_path, raster(sigma), MapPoints(cameras, check=NamedPlaces(cameras[:3])))
    assert min(left.shape[:2]) > 400
    assert right.std() > 1


def test_equal_scenes_give_equal_files(tmp_path: Path) -> None:
    sigma = raster(np.random.default_rng(1).uniform(0.01, 0.02, (20, 30)))
    for name in ("a.png", "b.png"):
        write_accuracy_map(tmp_path / name, sigma, MapPoints(check=NamedPlaces(np.array([[3.0, 4.0]]))))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]
