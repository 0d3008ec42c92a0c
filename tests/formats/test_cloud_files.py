"""Clouds as LAZ and PLY: what independent readers find is what was written, in the CRS that was asked for."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio.crs
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData
from pyproj import CRS

from pipelines.formats.cloud_ply import CloudPlyWriter, CloudPoints
from pipelines.formats.las import DEGREE_STEP, METRE_STEP, LazWriter
from pipelines.geodesy.crs import parse_crs

UTM = CRS("EPSG:32632").to_wkt("WKT1_GDAL")


def covariance(rng: np.random.Generator, count: int) -> np.ndarray:
    """Covariances in plan; nothing is known of the heights."""
    half = rng.normal(0, 0.1, (count, 3, 3))
    cov = half @ np.swapaxes(half, 1, 2)
    cov[:, 2] = cov[:, :, 2] = np.nan
    return cov.astype(np.float32)


def points(count: int, near: np.ndarray, spread: np.ndarray, seed: int = 0) -> CloudPoints:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    return CloudPoints(
        near + spread * rng.uniform(-1, 1, (count, 3)),
        (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32),
        rng.integers(0, 256, (count, 3), dtype=np.uint8),
        covariance(rng, count),
        rng.integers(0, 3, count, dtype=np.uint8),
    )


def write(path: Path, near: np.ndarray, *parts: CloudPoints, wkt1: str = UTM, angular: bool = False) -> None:
    with LazWriter(path, wkt1=wkt1, angular=angular, near=near, software="test 1", text="heights: σ") as writer:
        for part in parts:
            writer.write(part)


@settings(max_examples=25, deadline=None)
@given(
    east=st.floats(-2e7, 2e7), north=st.floats(-2e7, 2e7), up=st.floats(-500, 9000), size=st.floats(0.01, 1e5)
)  # fmt: skip
def test_coordinates_are_off_by_half_a_step_at_most(
    tmp_path_factory: pytest.TempPathFactory, east: float, north: float, up: float, size: float
) -> None:
    path, near = tmp_path_factory.mktemp("las") / "c.laz", np.array([east, north, up])
    given_points = points(50, near, np.full(3, size))
    write(path, near, given_points)
    las = laspy.read(path)
    # A double of 2e7 has steps of 4e-9.
    np.testing.assert_allclose(np.asarray(las.xyz), given_points.position, rtol=0, atol=METRE_STEP / 2 + 1e-8)


def test_degrees_are_written_to_a_tenth_of_a_millimetre(tmp_path: Path) -> None:
    near = np.array([-179.9, -89.0, 1620.0])
    given_points = points(100, near, np.array([1e-2, 1e-2, 50]))
    write(tmp_path / "c.laz", near, given_points, angular=True)
    off = np.abs(np.asarray(laspy.read(tmp_path / "c.laz").xyz) - given_points.position).max(axis=0)
    assert (off <= np.array([DEGREE_STEP, DEGREE_STEP, METRE_STEP]) / 2 + 1e-13).all()


def test_all_dimensions_come_back_from_several_parts(tmp_path: Path) -> None:
    near = np.array([400_000.0, 5_100_000.0, 600.0])
    parts = [points(count, near, np.full(3, 80.0), count) for count in (7, 0, 30)]
    write(tmp_path / "c.laz", near, *parts)
    las = laspy.read(tmp_path / "c.laz")
    assert las.header.point_count == 37
    np.testing.assert_array_equal(las.header.offsets, near)
    for column, (colour, axis) in enumerate(zip(("red", "green", "blue"), ("nx", "ny", "nz"), strict=True)):
        np.testing.assert_array_equal(las[colour] // 257, np.concatenate([part.rgb for part in parts])[:, column])
        np.testing.assert_array_equal(las[axis], np.concatenate([part.normal for part in parts])[:, column])
    np.testing.assert_array_equal(las["sigma_h"], np.concatenate([part.sigma_h_m for part in parts]))
    assert np.isnan(las["sigma_v"]).all()
    cov = np.concatenate([part.cov_m2 for part in parts])
    for name, (row, column) in {"ee": (0, 0), "en": (0, 1), "nn": (1, 1), "eu": (0, 2), "uu": (2, 2)}.items():
        np.testing.assert_array_equal(las[f"cov_{name}"], cov[:, row, column])
    assert set(las.return_number) == set(las.number_of_returns) == {1}
    assert (las.header.generating_software, las.header.creation_date) == ("test 1", date.today())
    text = las.header.vlrs.get_by_id("LASF_Spec", (3,))[0]
    assert text.record_data_bytes().rstrip(b"\0").decode() == "heights: σ"


@pytest.mark.parametrize(
    "name",
    ["EPSG:32632", "EPSG:32632+3855", "EPSG:7405", "EPSG:2263+6360", "EPSG:4979", "EPSG:4978", "EPSG:4326+5773"],
)
def test_readers_find_the_crs_that_was_asked_for(tmp_path: Path, name: str) -> None:
    """By laspy with pyproj, and by rasterio with GDAL: both parts, also ellipsoidal heights."""
    near, asked = np.array([7.0, 46.0, 600.0]), parse_crs(name)
    write(tmp_path / "c.laz", near, points(3, near, np.ones(3)), wkt1=asked.wkt1, angular=asked.is_geographic)
    header = laspy.open(tmp_path / "c.laz").header
    assert header.global_encoding.wkt
    found = header.parse_crs()
    assert found == CRS(name)
    assert len(found.axis_info) == len(CRS(name).axis_info)
    wkt1 = header.vlrs.get_by_id("LASF_Projection")[0].string
    assert rasterio.crs.CRS.from_wkt(wkt1) == rasterio.crs.CRS.from_wkt(CRS(name).to_wkt())


def test_ply_holds_whole_coordinates(tmp_path: Path) -> None:
    near = np.array([400_000.0, 5_100_000.0, 600.0])
    parts = [points(count, near, np.full(3, 80.0), count) for count in (12, 100)]
    with CloudPlyWriter(tmp_path / "c.ply", ["CRS: EPSG:32632", "two\nlines"]) as writer:
        for part in parts:
            writer.write(part)
    ply = PlyData.read(tmp_path / "c.ply")
    vertex = ply["vertex"]
    assert vertex.count == 112
    written = np.concatenate([part.position for part in parts])
    np.testing.assert_array_equal(np.column_stack([vertex[axis] for axis in "xyz"]), written)
    np.testing.assert_array_equal(vertex["green"], np.concatenate([part.rgb for part in parts])[:, 1])
    np.testing.assert_array_equal(vertex["nz"], np.concatenate([part.normal for part in parts])[:, 2])
    np.testing.assert_array_equal(vertex["sigma_h"], np.concatenate([part.sigma_h_m for part in parts]))
    assert ply.comments[:2] == ["CRS: EPSG:32632", "two lines"]
