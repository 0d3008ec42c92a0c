"""The cloud as COPC: every point once, with all its dimensions, in an octree that another library reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from pipelines.formats.cloud_ply import CloudPoints
from pipelines.formats.copc import write_copc
from pipelines.formats.las import LazWriter

pytest.importorskip("copclib")
laspy = pytest.importorskip("laspy")
COUNT, SIDE_M = 30_000, np.array([80.0, 50.0, 6.0])
DIMENSIONS = (
    "X",
    "Y",
    "Z",
    "red",
    "green",
    "blue",
    "classification",
    "nx",
    "ny",
    "nz",
    "sigma_h",
    "sigma_v",
    "cov_eu",
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder, rng = tmp_path_factory.mktemp("copc"), np.random.default_rng(0)
    position = rng.uniform(0, 1, (COUNT, 3)) * SIDE_M + [399_000.0, 5_620_000.0, 300.0]
    half = rng.normal(0, 0.02, (COUNT, 3, 3)).astype(np.float32)
    points = CloudPoints(
        position,
        rng.normal(size=(COUNT, 3)).astype(np.float32),
        rng.integers(0, 255, (COUNT, 3)).astype(np.uint8),
        half @ half.transpose(0, 2, 1),
        rng.integers(1, 3, COUNT).astype(np.uint8),
    )
    laz, copc = folder / "cloud.laz", folder / "cloud.copc.laz"
    wkt = CRS("EPSG:32632").to_wkt("WKT1_GDAL")
    with LazWriter(laz, wkt1=wkt, angular=False, near=position[0], software="test") as writer:
        writer.write(points)
    assert write_copc(laz, copc) > 4
    return laz, copc


def places(points: object) -> np.ndarray:
    return np.stack([np.asarray(getattr(points, axis)) for axis in "xyz"], axis=-1)


def rows(points: object) -> np.ndarray:
    """Return the dimensions (N, D) of points in the order of their places."""
    columns = np.stack([np.asarray(points[name], np.float64) for name in DIMENSIONS], axis=-1)  # type: ignore[index]
    return columns[np.lexsort(columns.T)]


def test_every_point_comes_back_with_all_dimensions(files: tuple[Path, Path]) -> None:
    laz, copc = files
    given = laspy.read(laz)
    with laspy.CopcReader.open(copc) as reader:
        found = reader.query()
        assert (reader.header.scales == given.header.scales).all() and (
            reader.header.offsets == given.header.offsets
        ).all()
    np.testing.assert_array_equal(rows(found), rows(given))
    plain = laspy.read(copc)  # by a reader of LAZ
    np.testing.assert_array_equal(rows(plain), rows(given))
    assert plain.header.parse_crs().to_epsg() == 32632
    assert "σ" not in str(plain.header.point_format.extra_dimension_names) and plain.header.point_count == COUNT


def test_levels_and_boxes_give_their_part(files: tuple[Path, Path]) -> None:
    """The first level covers the scene with one point a cell; a box gives the points inside it, and no other."""
    with laspy.CopcReader.open(files[1]) as reader:
        every, first = places(reader.query()), places(reader.query(level=0))
        middle = every.mean(axis=0)
        box = laspy.copc.Bounds(middle - 5, middle + 5)
        inside = places(reader.query(bounds=box))
    cells = np.floor((first - every.min(axis=0)) / (SIDE_M.max() / 128) + 1e-9)
    assert 1000 < len(first) < COUNT and len(np.unique(cells, axis=0)) > 0.97 * len(first)
    assert (np.ptp(first, axis=0) > 0.98 * SIDE_M).all()
    least, most = ((np.abs(every - middle) <= 5 + off).all(axis=1).sum() for off in (-1e-3, 1e-3))  # its steps
    assert 100 < least <= len(inside) <= most
    assert (np.abs(inside - middle) <= 5.001).all()


def test_few_points_are_one_node(tmp_path: Path) -> None:
    one = np.array([[10.0, 20.0, 30.0]])
    points = CloudPoints(
        one,
        one.astype(np.float32),
        np.zeros((1, 3), np.uint8),
        np.zeros((1, 3, 3), np.float32),
        np.ones(1, np.uint8),
    )
    with LazWriter(tmp_path / "a.laz", wkt1="", angular=False, near=one[0], software="test") as writer:
        writer.write(points)
    assert write_copc(tmp_path / "a.laz", tmp_path / "a.copc.laz") == 1
    np.testing.assert_allclose(np.asarray(laspy.read(tmp_path / "a.copc.laz").xyz), one)
