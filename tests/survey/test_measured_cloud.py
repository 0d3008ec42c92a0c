"""Clouds of LiDAR in the survey's frame: what was written on Earth is what is found, whatever file and chunk."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from pipelines.core.errors import InputError
from pipelines.formats.cloud_ply import CloudPlyWriter, CloudPoints, open_cloud_ply
from pipelines.formats.las import open_las
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geodesy.vertical import parse_vertical
from pipelines.surface import measured_cloud
from pipelines.surface.measured_cloud import CloudReader, Thinning, read_thinned
from pipelines.survey.options import CloudCrs
from tests.refusals import codes, numbers, refused

ORIGIN = Origin(lat_deg=46.02, lon_deg=7.75, alt_m=1620.0)
UTM = "EPSG:32632"
STEP_M = 1e-3  # of the files below


def write_las(
    path: Path, position: np.ndarray, *, crs: str | None = UTM, point_format: int = 6, **dimensions: np.ndarray
) -> None:
    header = laspy.LasHeader(version="1.4" if point_format >= 6 else "1.2", point_format=point_format)
    header.scales, header.offsets = np.full(3, STEP_M), np.round(position[0])
    if crs is not None and point_format >= 6:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(CRS(crs).to_wkt("WKT1_GDAL")))
    elif crs is not None:
        header.add_crs(CRS(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = position.T
    for name, values in dimensions.items():
        las[name] = values
    las.write(path)


def town(count: int, seed: int = 0) -> np.ndarray:
    """Points in geo within 200 m."""
    return np.random.default_rng(seed).uniform([-200, -200, -20], [200, 200, 40], (count, 3))


def in_crs(position_in_geo: np.ndarray, crs: str = UTM) -> np.ndarray:
    return parse_crs(crs).xyz_from_lla(lla_from_enu(position_in_geo, ORIGIN))


def cloud_points(position: np.ndarray) -> CloudPoints:
    none = np.full((len(position), 3, 3), np.nan, np.float32)
    zeros = np.zeros((len(position), 3))
    no_class = np.zeros(len(position), np.uint8)
    return CloudPoints(position, zeros.astype(np.float32), zeros.astype(np.uint8), none, no_class)


def all_points(path: Path, stated: CloudCrs = CloudCrs()) -> np.ndarray:  # noqa: B008
    return np.concatenate([chunk.position_in_geo for chunk in CloudReader(path, stated).chunks(ORIGIN)])


@pytest.mark.parametrize("point_format", [1, 6])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_points_return_to_their_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, point_format: int
) -> None:
    monkeypatch.setattr(measured_cloud, "_CHUNK", 64)  # several chunks
    given_points = town(300)
    write_las(tmp_path / f"c.{suffix}", in_crs(given_points), point_format=point_format)
    # Half a step of the file along each axis.
    np.testing.assert_allclose(all_points(tmp_path / f"c.{suffix}"), given_points, rtol=0, atol=0.6 * STEP_M)


def test_our_own_ply_returns(tmp_path: Path) -> None:
    given_points = town(100)
    with CloudPlyWriter(tmp_path / "c.ply", ["a cloud"]) as writer:
        writer.write(cloud_points(in_crs(given_points)))
    found = all_points(tmp_path / "c.ply", CloudCrs(crs=UTM))
    np.testing.assert_allclose(found, given_points, rtol=0, atol=1e-6)


def test_noise_overlap_and_withheld_points_are_dropped(tmp_path: Path) -> None:
    classes = np.array([2, 7, 18, 6, 1, 2], np.uint8)
    overlap, withheld = np.array([0, 0, 0, 1, 0, 0], np.uint8), np.array([0, 0, 0, 0, 1, 0], np.uint8)
    points = town(6)
    write_las(tmp_path / "c.laz", in_crs(points), classification=classes, overlap=overlap, withheld=withheld)
    write_las(tmp_path / "old.las", in_crs(points), point_format=1, classification=np.where(overlap, 12, classes))
    files = CloudReader(tmp_path / "c.laz", CloudCrs())
    np.testing.assert_allclose(next(files.chunks(ORIGIN)).position_in_geo, points[[0, 5]], atol=0.6 * STEP_M)
    assert (files.tally.noise, files.tally.overlap, files.tally.withheld) == (2, 1, 1)
    np.testing.assert_allclose(all_points(tmp_path / "old.las"), points[[0, 4, 5]], atol=0.6 * STEP_M)


def test_a_folder_of_tiles_is_one_cloud(tmp_path: Path) -> None:
    tiles, points = tmp_path / "tiles", town(40)
    (tiles / "north").mkdir(parents=True)
    write_las(tiles / "a.laz", in_crs(points[:25]))
    write_las(tiles / "north" / "b.LAS", in_crs(points[25:]))
    (tiles / "readme.txt").write_text("no cloud")
    np.testing.assert_allclose(all_points(tiles), points, rtol=0, atol=0.6 * STEP_M)


@settings(max_examples=8, deadline=None)
@given(voxel=st.floats(0.05, 50), most=st.integers(3, 400), seed=st.integers(0, 99))
def test_each_voxel_keeps_one_measured_point(
    tmp_path_factory: pytest.TempPathFactory, voxel: float, most: int, seed: int
) -> None:
    """Kept points are measured points in different voxels, within the limit; their weights count all points."""
    folder, points = tmp_path_factory.mktemp("voxels"), town(300, seed)
    write_las(folder / "c.laz", in_crs(points))
    whole = all_points(folder / "c.laz")
    cloud = read_thinned(CloudReader(folder / "c.laz", CloudCrs()), ORIGIN, Thinning(voxel, most))
    assert len(cloud) <= most and cloud.weight.sum() == 300 and cloud.voxel_m >= voxel
    assert {tuple(row) for row in cloud.position_in_geo} <= {tuple(row) for row in whole}
    voxels = np.unique(np.floor(cloud.position_in_geo / cloud.voxel_m), axis=0)
    assert len(voxels) == len(cloud)
    assert len(cloud) == len(np.unique(np.floor(whole / cloud.voxel_m), axis=0)) or cloud.voxel_m > voxel


def test_a_box_limits_the_cloud(tmp_path: Path) -> None:
    points = town(300)
    write_las(tmp_path / "c.laz", in_crs(points))
    low, high = np.array([-50.0, 0.0, -100.0]), np.array([80.0, 90.0, 100.0])
    cloud = read_thinned(CloudReader(tmp_path / "c.laz", CloudCrs()), ORIGIN, Thinning(0.01, 1000, low, high))
    assert len(cloud) == ((points >= low) & (points <= high)).all(axis=1).sum()
    with refused("no-overlap", InputError) as error:
        read_thinned(CloudReader(tmp_path / "c.laz", CloudCrs()), ORIGIN, Thinning(1, 9, high, high + 1))
    assert numbers(error.value.message)[0] == 300


def test_heights_count_from_the_stated_datum(tmp_path: Path) -> None:
    points = town(20)
    write_las(tmp_path / "flat.laz", in_crs(points))
    assert codes(CloudReader(tmp_path / "flat.laz", CloudCrs()).assumptions) == ["lidar-heights"]
    stated = CloudReader(tmp_path / "flat.laz", CloudCrs(vertical=parse_vertical("ellipsoidal")))
    assert not stated.assumptions
    # The grid of this geoid is not part of PROJ: nothing may be taken in its place.
    missing = CloudReader(tmp_path / "flat.laz", CloudCrs(vertical=parse_vertical("EPSG:5728")))
    with pytest.raises(InputError, match="not installed"):
        next(missing.chunks(ORIGIN))
    write_las(tmp_path / "compound.laz", in_crs(points), crs="EPSG:32632+5728")
    with pytest.raises(InputError, match="not installed"):
        next(CloudReader(tmp_path / "compound.laz", CloudCrs()).chunks(ORIGIN))


def test_files_without_crs_need_one(tmp_path: Path) -> None:
    points = town(5)
    write_las(tmp_path / "c.las", in_crs(points), crs=None)
    with refused("crs-unknown", InputError) as raised:
        CloudReader(tmp_path / "c.las", CloudCrs())
    assert raised.value.path == tmp_path / "c.las" and "--lidar-crs" in str(raised.value)
    np.testing.assert_allclose(all_points(tmp_path / "c.las", CloudCrs(crs=UTM)), points, atol=0.6 * STEP_M)
    (tmp_path / "scan.ptx").write_bytes(b"1")
    with refused("format-unknown", InputError):
        CloudReader(tmp_path / "scan.ptx", CloudCrs())


def test_single_precision_of_large_coordinates_is_refused(tmp_path: Path) -> None:
    points = in_crs(town(5)).astype("<f4")
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    (tmp_path / "c.ply").write_bytes((head + "end_header\n").encode() + points.tobytes())
    with refused("single-precision", InputError):
        all_points(tmp_path / "c.ply", CloudCrs(crs=UTM))


def damaged(path: Path, place: int, form: str, value: int) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, place, value)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("place", "form", "value"),
    [
        (0, "<I", 0),  # signature
        (96, "<I", 2**31),  # offset of the points
        (100, "<I", 2**31),  # number of records
        (105, "<H", 0),  # bytes of a point
        (247, "<Q", 10**12),  # number of points
    ],
)
def test_headers_that_promise_too_much_are_refused(tmp_path: Path, place: int, form: str, value: int) -> None:
    write_las(tmp_path / "c.laz", in_crs(town(50)))
    damaged(tmp_path / "c.laz", place, form, value)
    with pytest.raises(InputError):
        open_las(tmp_path / "c.laz")


@settings(max_examples=40, deadline=None)
@given(
    kind=st.sampled_from(["laz", "las", "ply"]),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=6),
    cut=st.floats(0.05, 1),
)
def test_any_bytes_give_points_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, kind: str, edits: list[tuple[float, int]], cut: float
) -> None:
    path, points = tmp_path_factory.mktemp("hostile") / f"c.{kind}", in_crs(town(40))
    if kind == "ply":
        with CloudPlyWriter(path, []) as writer:
            writer.write(cloud_points(points))
    else:
        write_las(path, points)
    data = bytearray(path.read_bytes())
    for where, value in edits:
        data[int(where * (len(data) - 1))] = value
    path.write_bytes(data[: max(int(cut * len(data)), 1)])
    try:
        file = open_cloud_ply(path) if kind == "ply" else open_las(path)
        read = sum(len(chunk) for chunk in file.chunks(16))
    except InputError as error:
        assert error.path == path
    else:
        assert read == file.count
