"""The accuracy map: places, directions and σ as given, read off the pixels of the picture."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.report.plots.maps import (
    MapPoints,
    SigmaRaster,
    exaggeration,
    write_accuracy_map,
)
from pipelines.report.plots.plans import MapCoordinates, NamedPlaces, write_axes
from pipelines.report.plots.style import new_figure

LEAST, LARGEST, EMPTY = (0x44, 0x01, 0x54), (0xFD, 0xE7, 0x25), (0xE8, 0xE8, 0xE8)  # ends of viridis; no scene
CONTROL = (0xDD, 0x8A, 0x3B)
NO_POINTS = MapPoints()
LEFT, TOP = 170, 120
INSIDE = np.s_[TOP:520, LEFT:560]  # of half a picture of a square scene: nothing but the map


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


def dark(image: np.ndarray) -> np.ndarray:
    """Mask of the pixels as dark as an arrow."""
    return (image < 0x60).all(axis=2)


@pytest.mark.parametrize("east_m", [0.02, -0.02])
def test_errors_are_arrows_in_their_direction(east_m: float, tmp_path: Path) -> None:
    """East and west on the left map; up on the right one, whatever the horizontal error is."""
    bright = np.full((20, 20), 0.05)
    bright[0, 0] = bright[-1, 0] = 0.01
    sigma, place = raster(bright), np.array([[10.0, 10.0]])
    error = np.array([[east_m, 0.0, 0.03]])
    plain = maps(tmp_path, sigma, MapPoints(check=NamedPlaces(place)))
    drawn = maps(tmp_path, sigma, MapPoints(check=NamedPlaces(place, (), error)))
    added = []
    for before, after in zip(plain, drawn, strict=True):
        rows, columns = np.nonzero((dark(after) & ~dark(before))[INSIDE])  # the map, without its title
        added.append((columns, rows))
    (columns, rows), (right_columns, right_rows) = added
    assert np.ptp(columns) > 5 * np.ptp(rows) > 0 and np.ptp(right_rows) > 3 * np.ptp(right_columns) > 0
    spot = middle_of_signs(plain[0])
    assert np.sign(columns.mean() + LEFT - spot[0]) == np.sign(east_m)
    assert right_rows.mean() + TOP < middle_of_signs(plain[1])[1]


def middle_of_signs(image: np.ndarray) -> np.ndarray:
    """Column and row of the middle of the map's only sign, a white disc."""
    mask = (image[INSIDE] > 250).all(axis=2).astype(np.uint8)
    _, _, _, middles = cv2.connectedComponentsWithStats(mask)
    return np.asarray(middles[1] + np.array([LEFT, TOP]))


@given(
    lengths=st.lists(st.floats(1e-5, 1e3), min_size=1, max_size=30),
    side_m=st.floats(1.0, 1e5),
)
def test_arrows_are_exaggerated_by_a_round_number(lengths: list[float], side_m: float) -> None:
    """The arrow that decides is between a twentieth and a seventh of the map, as 1, 2, 5 and 10 are 2.5 apart."""
    factor = exaggeration(np.array([*lengths, np.nan]), side_m)
    assert factor is not None
    assert f"{factor:.0e}"[0] in "125"
    decides = min(max(lengths), 4 * float(np.median(lengths)))
    assert 0.055 < factor * decides / side_m < 0.141


def test_nothing_measured_is_no_arrow() -> None:
    assert exaggeration(np.array([np.nan]), 100.0) is None
    assert exaggeration(np.array([]), 100.0) is None
    assert exaggeration(np.zeros(3), 100.0) is None


@pytest.mark.parametrize("turn", [0.1, -0.03, 0.0])
def test_ticks_are_round_coordinates_of_the_edges(turn: float) -> None:
    """Of a CRS that is turned and shifted against the map, as a grid is away from its meridian."""

    def grid(place: np.ndarray) -> np.ndarray:
        return np.asarray(place @ np.array([[1.0, turn], [-turn, 1.0]]) + [500_000, 900])

    axes = new_figure((4, 4), None).add_axes((0.1, 0.1, 0.8, 0.8))
    axes.set_xlim(-50, 50)
    axes.set_ylim(-20, 80)
    write_axes(axes, MapCoordinates("EPSG:1", ("easting", "northing"), "m", grid), (5, 5))
    labels = [float(label.get_text()) for label in axes.get_xticklabels()]
    assert len(labels) >= 3 and all(value % 10 == 0 for value in labels)
    on_edge = grid(np.column_stack([axes.get_xticks(), np.full(len(labels), -20.0)]))
    np.testing.assert_allclose(on_edge[:, 0], labels, atol=1e-6)
    up = grid(np.column_stack([np.full(len(axes.get_yticks()), -50.0), axes.get_yticks()]))[:, 1]
    np.testing.assert_allclose(up, [float(label.get_text()) for label in axes.get_yticklabels()], atol=1e-6)
    assert axes.get_xlabel() == "easting in m (EPSG:1)"
    degrees = MapCoordinates("WGS84", ("longitude", "latitude"), "°", lambda place: 7 + place / 111_320)
    write_axes(axes, degrees, (4, 4))
    assert all(re.fullmatch(r"(6\.999|7\.000)\d*", label.get_text()) for label in axes.get_xticklabels())


@pytest.mark.filterwarnings("error")
def test_names_are_written_and_no_markup(tmp_path: Path) -> None:
    sigma, place = raster(np.full((20, 20), 0.05)), np.array([[10.0, 10.0]])
    plain, _ = maps(tmp_path, sigma, MapPoints(control=NamedPlaces(place)))
    named, _ = maps(tmp_path, sigma, MapPoints(control=NamedPlaces(place, ("$P_1$",))))
    rows, columns = np.nonzero((plain != named).any(axis=2))
    assert 30 < np.ptp(columns) < 90 and 8 < np.ptp(rows) < 30  # five letters, as they stand
