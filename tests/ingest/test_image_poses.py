"""Positions of images: where they come from, how good they are said to be, and which height they mean."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.exif import DjiTags, GpsTag, PhotoTags, read_tags
from pipelines.formats.image_file import ImageFile
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geodesy import enu
from pipelines.geometry.rotations import geo_from_cam
from pipelines.ingest.exif_poses import poses_from_tags
from pipelines.ingest.flight_record import RECEIVER_SIGMA_M, ImagePoses
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.table_poses import poses_from_table
from tests.photos import BYTE, Exif, gps_entries, jpeg
from tests.refusals import codes, numbers, refused, said

GPS = GpsTag(46.02, 7.75, 1620.0, None, "")


def default_sigmas(remarks: Remarks, receiver: str) -> list[list[float]]:
    """Numbers of the default σ of a receiver: how many positions, and metres."""
    given = [one.sentence for one in remarks.assumptions if one.code == "default-position-sigma"]
    return [numbers(sentence) for sentence in given if f"({receiver})" in sentence]


def _photos(*tags: PhotoTags) -> list[Photo]:
    return [Photo(f"{index}.jpg", ImageFile(64, 48, str(index)), one) for index, one in enumerate(tags)]


def _table(names: tuple[str, ...] | None = ("0.jpg", "1.jpg"), **changes: object) -> PoseTable:
    table = PoseTable(
        path=Path("t.csv"),
        source="csv",
        lines=np.array([2, 3]),
        names=names,
        time_s=np.array([100.0, 101.0]),
        xyz=np.array([[7.75, 46.02, 1620.0], [7.7502, 46.02, 1622.0]]),
        geographic=True,
    )
    return replace(table, **changes)  # type: ignore[arg-type]


def _lla(poses: ImagePoses) -> np.ndarray:
    return enu.lla_from_ecef(poses.position_in_ecef)


def test_sigma_by_receiver_and_precedence() -> None:
    def dji(flag: int, sigma: tuple[float, float, float] | None = None) -> PhotoTags:
        return PhotoTags(gps=GPS, dji=DjiTags(rtk_flag=flag, rtk_sigma_enu_m=sigma))

    photos = _photos(
        dji(50),
        dji(34),
        dji(16),
        dji(50, (0.011, 0.012, 0.025)),
        PhotoTags(gps=replace(GPS, sigma_h_m=1.2)),
        PhotoTags(gps=GPS),
    )
    remarks = Remarks()
    poses = poses_from_tags(photos, IngestOptions(), remarks)
    expected = [
        [0.02, 0.02, 0.03],
        [0.5, 0.5, 1.0],
        [2.5, 2.5, 5.0],
        [0.011, 0.012, 0.025],
        [1.2, 1.2, 2.4],
        [2.5, 2.5, 5.0],
    ]
    np.testing.assert_allclose(poses.sigma_enu_m, expected)
    assert poses.sigma_source == ("default", "default", "default", "file", "file", "default")
    assert [1.0, 0.02, 0.03] in default_sigmas(remarks, "RTK fixed")

    remarks = Remarks()
    overridden = poses_from_tags(photos, IngestOptions(sigma_h=0.7), remarks)
    assert [1.0, 0.03] in default_sigmas(remarks, "RTK fixed")
    np.testing.assert_allclose(overridden.sigma_enu_m[:, :2], 0.7)
    assert overridden.sigma_enu_m[3, 2] == 0.025
    assert set(overridden.sigma_source) == {"option"}


def test_exif_heights_are_assumed_not_refused() -> None:
    poses = poses_from_tags(_photos(PhotoTags(gps=GPS)), IngestOptions(), Remarks())
    assert poses.vertical.name == "ellipsoidal" and not poses.vertical.stated
    assert "often above a geoid" in poses.vertical.note
    stated = poses_from_tags(_photos(PhotoTags(gps=GPS)), IngestOptions(vertical="ellipsoidal"), Remarks())
    assert stated.vertical.stated


def test_exif_heights_stated_above_a_geoid_need_its_grid() -> None:
    with refused("grid-not-installed", InputError) as error:
        poses_from_tags(_photos(PhotoTags(gps=GPS)), IngestOptions(vertical="EGM96"), Remarks())
    assert "us_nga_egm96_15.tif" in str(error.value)


def test_a_gimbal_is_kept_with_or_without_position() -> None:
    tags = PhotoTags(dji=DjiTags(gimbal_yaw_pitch_roll_deg=(45.0, -89.9, 0.0)))
    poses = poses_from_tags(_photos(tags, PhotoTags()), IngestOptions(), Remarks())
    assert not poses.located.any()
    np.testing.assert_allclose(poses.enu_from_cam[0], geo_from_cam([45.0, -89.9, 0.0]), atol=1e-14)
    assert np.isnan(poses.enu_from_cam[1]).all()


def test_images_without_altitude_are_noted() -> None:
    remarks = Remarks()
    photos = _photos(PhotoTags(gps=replace(GPS, alt_m=None)), PhotoTags(gps=GPS))
    assert poses_from_tags(photos, IngestOptions(), remarks).located.tolist() == [False, True]
    assert "(1): 0.jpg." in said(remarks.warnings, "image-without-altitude")


@pytest.mark.parametrize(("reference", "stated"), [(0, False), (2, True)])
def test_a_reference_to_sea_level_is_told(reference: int, stated: bool) -> None:
    entries = [entry for entry in gps_entries(46.02, 7.75, 620.0) if entry[0] != 5]
    tags = read_tags(jpeg(exif=Exif(gps=[*entries, (5, BYTE, reference)])))
    poses = poses_from_tags(_photos(tags), IngestOptions(), Remarks())
    assert not poses.vertical.stated and ("sea level" in poses.vertical.note) == stated
    assert _lla(poses)[0, 2] == pytest.approx(620.0, abs=1e-3)


@pytest.mark.parametrize(
    ("datum", "code", "lat", "lon", "least_m"),
    [
        ("TOKYO", 4301, 35.68, 139.77, 400.0),
        ("NAD-27", 4267, 34.05, -118.25, 80.0),
        ("ED50", 4230, 46.0, 7.7, 100.0),
    ],
)
def test_positions_of_another_datum_are_transformed(
    datum: str, code: int, lat: float, lon: float, least_m: float
) -> None:
    remarks = Remarks()
    tag = replace(GPS, lat_deg=lat, lon_deg=lon, datum=datum)
    poses = poses_from_tags(_photos(PhotoTags(gps=tag)), IngestOptions(), remarks)
    to_wgs84 = pyproj.Transformer.from_crs(code, 4326, always_xy=True)
    expected_lon, expected_lat = to_wgs84.transform(lon, lat)
    moved_m = 111_320.0 * np.hypot(expected_lat - lat, (expected_lon - lon) * np.cos(np.radians(lat)))
    assert moved_m > least_m, "the test is worth something only where the datums are apart"
    # The same operation but for grids that depend on the place: 5 m is their published accuracy.
    apart_m = 111_320.0 * np.abs(_lla(poses)[0, :2] - [expected_lat, expected_lon]).max()
    assert apart_m < 5.0
    assert datum in said(remarks.assumptions, "exif-datum")
    assert remarks.transformations[0].crs == f"EPSG:{code}"


@pytest.mark.parametrize("datum", ["GCJ-02", "TOKYO"])
def test_an_unknown_datum_and_one_of_elsewhere_are_cautions_with_its_sigma(datum: str) -> None:
    remarks = Remarks()
    tag = replace(GPS, lat_deg=46.0, lon_deg=7.7, datum=datum)
    poses = poses_from_tags(_photos(PhotoTags(gps=tag)), IngestOptions(), remarks)
    np.testing.assert_allclose(_lla(poses)[0, :2], [46.0, 7.7], atol=1e-9)
    assert [caution.code for caution in remarks.cautions] == ["exif-datum-unknown"]
    assert poses.common_sigma_m[0] >= 500.0


def test_height_is_of_exif_or_else_of_xmp() -> None:
    flat, dji = replace(GPS, alt_m=None), DjiTags(absolute_altitude_m=198.31)
    photos = _photos(PhotoTags(gps=flat, dji=dji), PhotoTags(gps=GPS, dji=dji), PhotoTags(dji=dji))
    poses = poses_from_tags(photos, IngestOptions(), Remarks())
    assert poses.located.tolist() == [True, True, False]
    np.testing.assert_allclose(_lla(poses)[:2, 2], [198.31, 1620.0], rtol=0, atol=1e-8)


def test_a_table_by_name_wins_over_exif_and_does_not_mix_with_it() -> None:
    remarks = Remarks()
    photos = _photos(*[PhotoTags(gps=replace(GPS, lat_deg=46.02), timestamp_s=5.0)] * 3)
    poses = poses_from_table(_table(), photos, IngestOptions(), remarks)
    assert poses.located.tolist() == [True, True, False]
    np.testing.assert_allclose(_lla(poses)[1], [46.02, 7.7502, 1622.0], rtol=0, atol=1e-9)
    assert poses.time_s.tolist() == [100.0, 101.0, 5.0]
    assert codes(remarks.warnings) == ["images-without-position"]
    assert "t.csv (1): 2.jpg." in remarks.warnings[0].sentence
    assert "t.csv are WGS84 (EPSG:4326)" in said(remarks.assumptions, "crs-assumed")
    np.testing.assert_allclose(poses.sigma_enu_m[0], np.array(RECEIVER_SIGMA_M["unknown receiver"])[[0, 0, 1]])


def test_a_table_by_time_interpolates_along_the_line() -> None:
    remarks = Remarks()
    photos = _photos(
        PhotoTags(timestamp_s=100.5, time_source="assumed UTC"), PhotoTags(timestamp_s=105.0), PhotoTags()
    )
    poses = poses_from_table(_table(names=None), photos, IngestOptions(), remarks)
    assert poses.located.tolist() == [True, False, False]
    ends = enu.ecef_from_lla([[46.02, 7.75, 1620.0], [46.02, 7.7502, 1622.0]])
    np.testing.assert_allclose(poses.position_in_ecef[0], ends.mean(axis=0), rtol=0, atol=1e-7)
    assert "EXIF" in said(remarks.assumptions, "time-zone")
    assert "(1): 2.jpg." in said(remarks.warnings, "image-without-time")
    assert "t.csv (2): 1.jpg, 2.jpg." in said(remarks.warnings, "images-without-position")


def test_clocks_that_never_meet_are_explained() -> None:
    with refused("times-apart", InputError) as error:
        poses_from_table(_table(names=None), _photos(PhotoTags(timestamp_s=3700.0)), IngestOptions(), Remarks())
    assert "1970-01-01 00:01:40 UTC to " in str(error.value) and "--max-gap" in str(error.value)
    with refused("images-without-times", InputError):
        poses_from_table(_table(names=None), _photos(PhotoTags()), IngestOptions(), Remarks())


def test_rows_without_a_time_do_not_count(tmp_path: Path) -> None:
    times = np.array([100.0, np.nan])
    photos = _photos(PhotoTags(timestamp_s=100.0), PhotoTags(timestamp_s=100.5))
    poses = poses_from_table(_table(names=None, time_s=times), photos, IngestOptions(), Remarks())
    assert poses.located.tolist() == [True, False]
    with refused("file-without-times", InputError) as error:
        poses_from_table(_table(names=None, time_s=times * np.nan), photos, IngestOptions(), Remarks())
    assert str(error.value).startswith("t.csv [timestamp]: ")


def test_missing_heights_are_taken_from_exif() -> None:
    remarks = Remarks()
    xyz = np.array([[7.75, 46.02, np.nan], [7.7502, 46.02, np.nan]])
    table = _table(xyz=xyz, geographic=None, crs_text="EPSG:4326", source="geo.txt", path=Path("geo.txt"))
    poses = poses_from_table(table, _photos(PhotoTags(gps=GPS), PhotoTags()), IngestOptions(), remarks)
    assert poses.located.tolist() == [True, False]
    assert _lla(poses)[0, 2] == pytest.approx(1620.0, abs=1e-8)
    assert said(remarks.assumptions, "heights-from-exif").startswith("1 heights that geo.txt")
    assert "(1): geo.txt:3." in said(remarks.warnings, "row-without-height")
    with refused("no-heights", InputError):
        poses_from_table(table, _photos(PhotoTags(), PhotoTags()), IngestOptions(), Remarks())


@pytest.mark.parametrize(
    ("changes", "options", "code", "says"),
    [
        ({"geographic": False}, IngestOptions(), "crs-missing", r"t\.csv: .*--crs"),
        ({}, IngestOptions(crs="EPSG:32632"), "crs-not-geographic", r"\[--crs\]: t\.csv .* EPSG:32632"),
        ({}, IngestOptions(crs="EPSG:0"), "crs-unknown", r"\[--crs\]: .*'EPSG:0'"),
        (
            {},
            IngestOptions(crs="EPSG:4979", vertical="EGM96"),
            "vertical-against-crs",
            r"\[--vertical\]: .*--crs EPSG:4979, .*ellipsoidal",
        ),
        (
            {"geographic": False},
            IngestOptions(crs="EPSG:32632"),
            "degrees-in-projection",
            r"t\.csv:2: .*EPSG:32632",
        ),
    ],
)
def test_statements_about_the_crs_that_exclude_each_other(
    changes: dict[str, object], options: IngestOptions, code: str, says: str
) -> None:
    with refused(code, InputError) as error:
        poses_from_table(_table(**changes), _photos(PhotoTags(), PhotoTags()), options, Remarks())
    assert re.search(says, str(error.value))


def test_a_file_that_states_its_datum_keeps_it_and_says_so() -> None:
    remarks = Remarks()
    table = _table(geographic=None, crs_text="EPSG:4979", path=Path("geo.txt"))
    options = IngestOptions(vertical="EGM96")
    assert (
        poses_from_table(table, _photos(PhotoTags(), PhotoTags()), options, remarks).vertical.name == "ellipsoidal"
    )
    assert "geo.txt are ellipsoidal" in said(remarks.assumptions, "vertical-unused")


def test_feet_and_the_accuracy_of_a_datum_are_told() -> None:
    remarks = Remarks()
    xyz = np.array([[1450000.0, 540000.0, 1000.0], [1450010.0, 540000.0, 1000.0]])
    poses = poses_from_table(
        _table(xyz=xyz, geographic=False),
        _photos(PhotoTags(), PhotoTags()),
        IngestOptions(crs="EPSG:2264"),
        remarks,
    )
    assert _lla(poses)[0, 2] == pytest.approx(1000.0 * 1200 / 3937)
    assert "EPSG:2264 are in US survey foot" in said(remarks.assumptions, "height-unit")
    assert " 4 m" in said(remarks.assumptions, "crs-transformation")
    assert "us_noaa_nchpgn.tif" in said(remarks.warnings, "better-grid-missing")
