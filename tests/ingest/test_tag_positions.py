"""Positions, heights and headings of photographs whose tags contradict each other, against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.exif import DjiTags, GpsTag, PhotoTags, read_tags
from pipelines.formats.image_file import ImageFile
from pipelines.geodesy import enu
from pipelines.geometry.rotations import geo_from_cam
from pipelines.ingest.exif_poses import poses_from_tags
from pipelines.ingest.flight_record import ImagePoses
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.survey_assembly import fix_sessions, require_placed
from tests.formats.test_xmp import packet
from tests.photos import ASCII, BYTE, RATIONAL, SHORT, Entry, Exif, dji_xmp, gps_entries, jpeg
from tests.refusals import codes, numbers, refused, said

COUNT = 8
LAT = 47.123456 + np.array([0, 21, 43, 62, 61, 44, 20, 1]) * 1.013e-5
LON = 8.654321 + np.array([0, 1, 0, 2, 31, 30, 32, 31]) * 1.017e-5
HEIGHT = 512.31 + np.array([0, 3, 1, 4, 2, 6, 5, 7]) * 0.117


def photos(**columns: object) -> list[Photo]:
    """Return photographs 3 s apart, with tags of which each column is one value or one for each photograph."""
    found = []
    for row in range(COUNT):
        tags = {name: value[row] if isinstance(value, list) else value for name, value in columns.items()}
        found.append(
            Photo(f"{row}.jpg", ImageFile(64, 48, str(row)), PhotoTags(timestamp_s=1e9 + 3.0 * row, **tags))  # type: ignore[arg-type]
        )
    return found


def gps(
    lat: np.ndarray = LAT, lon: np.ndarray = LON, alt: np.ndarray = HEIGHT, source: str = "EXIF"
) -> list[GpsTag]:
    rows = zip(lat, lon, alt, strict=True)
    return [GpsTag(float(a), float(b), float(c), None, "", source) for a, b, c in rows]  # type: ignore[arg-type]


def xmp(lat: np.ndarray = LAT, lon: np.ndarray = LON, alt: np.ndarray = HEIGHT) -> list[tuple[GpsTag, ...]]:
    return [(tag,) for tag in gps(lat, lon, alt, "XMP")]


def read(found: list[Photo], options: IngestOptions | None = None) -> tuple[ImagePoses, Remarks]:
    remarks = Remarks()
    return poses_from_tags(found, options or IngestOptions(), remarks), remarks


def off_m(poses: ImagePoses, lat: np.ndarray = LAT, lon: np.ndarray = LON, alt: np.ndarray = HEIGHT) -> float:
    truth = enu.ecef_from_lla(np.column_stack([lat, lon, alt]))
    return float(np.nanmax(np.linalg.norm(poses.position_in_ecef - truth, axis=1)))


@pytest.mark.parametrize("step", [1 / 60, 1 / 3600, 1e-4])
def test_coarser_digits_lose(step: float) -> None:
    cut = [np.trunc(values / step) * step for values in (LAT, LON)]
    lat, lon = cut
    poses, remarks = read(photos(gps=gps(lat, lon), more_gps=xmp()))
    assert off_m(poses) < 0.01
    assert remarks.assumptions or remarks.cautions
    poses, _ = read(photos(gps=gps(), more_gps=xmp(*cut)))
    assert off_m(poses) < 0.01


@pytest.mark.parametrize("step", [1 / 3600, 1 / 60 / 100, 1e-3])
def test_coarse_digits_alone_are_part_of_sigma(step: float) -> None:
    lat, lon = (values + np.linspace(0, 20 * step, COUNT) for values in (LAT, LON))
    cut = [np.trunc(values / step) * step for values in (lat, lon)]
    poses, remarks = read(photos(gps=gps(cut[0], cut[1])))
    expected = step * 111_320 / np.sqrt(3)
    np.testing.assert_allclose(poses.sigma_enu_m[:, 0], np.hypot(2.5, expected), rtol=0.01)
    assert codes(remarks.cautions) == ["position-digits"]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("wrong", ["EXIF", "XMP"])
def test_a_lost_sign_is_south_or_west(axis: int, wrong: str) -> None:
    right, lost = [-LAT, -LON], [-LAT, -LON]
    lost[axis] = -lost[axis]
    in_exif, in_xmp = (lost, right) if wrong == "EXIF" else (right, lost)
    poses, remarks = read(photos(gps=gps(in_exif[0], in_exif[1]), more_gps=xmp(*in_xmp)))
    assert off_m(poses, -LAT, -LON) < 0.01
    assert codes(remarks.cautions) == ["position-sign"]


@pytest.mark.parametrize("wrong", ["EXIF", "XMP"])
@pytest.mark.parametrize(
    ("code", "heights"),
    [
        ("height-zero", HEIGHT * 0.0),
        ("height-feet", (HEIGHT + np.arange(COUNT)) / 0.3048),
        ("height-relative", HEIGHT - 460.0),
        ("height-stands-still", np.full(COUNT, 520.0)),
    ],
)
def test_heights_that_are_none(code: str, heights: np.ndarray, wrong: str) -> None:
    true = HEIGHT + np.arange(COUNT)
    in_exif, in_xmp = (heights, true) if wrong == "EXIF" else (true, heights)
    drone = [DjiTags(relative_altitude_m=float(each - 460.0)) for each in HEIGHT]
    poses, remarks = read(photos(gps=gps(alt=in_exif), more_gps=xmp(alt=in_xmp), dji=drone))
    assert off_m(poses, alt=true) < 0.01
    assert codes(remarks.cautions) == [code]


@pytest.mark.parametrize(("height", "common_m"), [(900.0, 0.0), (60.0, 120.0)])
def test_heights_of_both_signs(height: float, common_m: float) -> None:
    """Ground lower than any land decides; otherwise σ reaches from one sign to the other."""
    heights = height + np.arange(COUNT) * 0.1
    poses, remarks = read(photos(gps=gps(alt=-heights), more_gps=xmp(alt=heights)))
    assert off_m(poses, alt=heights) < 0.01
    assert codes(remarks.cautions) == ["height-sign"]
    assert poses.common_sigma_m[1] == pytest.approx(common_m, abs=2.0)


@pytest.mark.parametrize(("east_m", "up_m"), [(4.25, 0.0), (60.0, 0.0), (0.0, 47.3)])
def test_a_constant_between_sources_is_part_of_the_common_sigma(east_m: float, up_m: float) -> None:
    lon = LON + east_m / 111_320 / np.cos(np.radians(LAT))
    # A stated datum: one that is assumed has a σ of its own.
    options = IngestOptions(vertical="ellipsoidal")
    poses, remarks = read(photos(gps=gps(), more_gps=xmp(lon=lon, alt=HEIGHT + up_m)), options)
    (caution,) = remarks.cautions
    assert caution.code == ("position-sources-apart" if east_m else "height-sources-apart")
    assert numbers(caution.sentence)[0] == pytest.approx(max(east_m, up_m), abs=0.1)
    (session,), _ = fix_sessions(poses, options, Remarks())
    np.testing.assert_allclose(
        session.sigma_common_m, [np.hypot(1.5, east_m)] * 2 + [np.hypot(3.0, up_m)], rtol=0.02
    )


def test_a_source_that_stands_still_is_old() -> None:
    old = LAT.copy(), LON.copy()
    for axis in old:
        axis[2:] = axis[2]
    poses, remarks = read(photos(gps=gps(*old), more_gps=xmp()))
    assert off_m(poses) < 0.01 and codes(remarks.cautions) == ["position-stands-still"]
    poses, _ = read(photos(gps=gps(), more_gps=xmp(*old)))
    assert off_m(poses) < 0.01


@pytest.mark.parametrize("wrong", ["EXIF", "XMP"])
def test_of_one_photograph_the_neighbours_decide(wrong: str) -> None:
    blunder = LAT.copy()
    blunder[3] += 2e-3
    in_exif, in_xmp = (blunder, LAT) if wrong == "EXIF" else (LAT, blunder)
    poses, remarks = read(photos(gps=gps(in_exif), more_gps=xmp(in_xmp)))
    assert off_m(poses) < 0.01
    assert "3.jpg" in said(remarks.cautions, "position-sources-blunders")


def test_sources_that_agree_to_their_digits_say_nothing() -> None:
    lat, lon = (np.round(values, 7) for values in (LAT, LON))
    poses, remarks = read(photos(gps=gps(), more_gps=xmp(lat, lon, np.round(HEIGHT, 2))))
    assert off_m(poses) < 0.01 and not remarks.cautions and not remarks.warnings


def test_a_void_status_is_said() -> None:
    tags = gps()
    tags[2:4] = [replace(tag, void=True) for tag in tags[2:4]]
    poses, remarks = read(photos(gps=tags))
    assert poses.located.tolist() == [row not in {2, 3} for row in range(COUNT)]
    assert "2.jpg, 3.jpg" in said(remarks.warnings, "gps-status-void")
    poses, remarks = read(photos(gps=[replace(tag, void=True) for tag in tags]))
    assert poses.located.all() and codes(remarks.cautions) == ["gps-status-void"]
    status = dji_xmp(GpsLatitude="47.1", GpsLongitude="8.6", AbsoluteAltitude="+500", GpsStatus="Invalid")
    assert [tag.void for tag in read_tags(jpeg(xmp=status)).positions] == [True]


@pytest.mark.parametrize("row", [0, 4])
def test_one_height_of_zero_is_none(row: int) -> None:
    heights = HEIGHT.copy()
    heights[row] = 0.0
    poses, remarks = read(photos(gps=gps(alt=heights)))
    assert np.flatnonzero(~poses.located).tolist() == [row]
    assert f"{row}.jpg" in said(remarks.warnings, "height-zero")
    near_sea = np.array([0.0, 0.4, 1.2, 2.0, 3.0, 2.2, 1.0, 0.3])
    poses, _ = read(photos(gps=gps(alt=near_sea)))
    assert poses.located.all()


def test_accuracies_of_pix4d_are_sigma() -> None:
    poses, _ = read(photos(gps=gps(), dji=DjiTags(sigma_h_m=1.97, sigma_v_m=2.69)))
    np.testing.assert_allclose(poses.sigma_enu_m, [[1.97, 1.97, 2.69]] * COUNT, rtol=1e-3)
    assert set(poses.sigma_source) == {"file"}


@pytest.mark.parametrize(
    ("tags", "height"),
    [
        ([(5, ASCII, "1"), (6, RATIONAL, [(396_000, 1000)])], -396.0),
        ([(5, ASCII, "Below Sea Level"), (6, RATIONAL, [(396_000, 1000)])], -396.0),
        ([(5, ASCII, "0"), (6, RATIONAL, [(396_000, 1000)])], 396.0),
        ([(5, BYTE, 1), (6, RATIONAL, [(2**32 - 396_000, 1000)])], -396.0),  # unsigned, and wrapped
        ([(5, BYTE, 0), (6, SHORT, 2**16 - 396)], -396.0),
        ([(5, BYTE, 1), (6, ASCII, "396 m")], -396.0),
        ([(5, BYTE, 0), (6, ASCII, "1000 ft")], 304.8),
        ([(5, BYTE, 1), (6, ASCII, "-396")], -396.0),  # a sign in both
    ],
)
def test_altitudes_of_a_wrong_form_are_read_and_said(tags: list[Entry], height: float) -> None:
    found = read_tags(jpeg(exif=Exif(gps=[*gps_entries(31.5, 35.5, None), *tags])))
    assert found.gps is not None and found.gps.alt_m == pytest.approx(height, abs=1e-6)
    assert len(found.corrections) == 1 or height > 0.0 or tags[1][1] == ASCII


@pytest.mark.parametrize(
    ("side", "value", "expected"),
    [
        ((1, ASCII, "S"), (2, ASCII, "33.41234"), -33.41234),
        ((1, ASCII, "N"), (2, ASCII, "33,24.7404S"), -33.41234),
        ((1, ASCII, "N"), (2, RATIONAL, [(2**32 - 334_123_400, 10**7)]), -33.41234),
        ((1, ASCII, "N"), (2, ASCII, "-33.41234"), -33.41234),
        ((1, ASCII, "S"), (2, ASCII, "-33.41234"), -33.41234),
    ],
)
def test_latitudes_of_a_wrong_form(side: Entry, value: Entry, expected: float) -> None:
    found = read_tags(jpeg(exif=Exif(gps=[side, value, *gps_entries(33.0, 70.5)[2:]])))
    assert found.gps is not None and found.gps.lat_deg == pytest.approx(expected, abs=1e-7)
    assert found.corrections


def headings(gimbal: np.ndarray, flight: np.ndarray, pitch: float = -90.0) -> list[DjiTags]:
    return [
        DjiTags(gimbal_yaw_pitch_roll_deg=(float(a), pitch, 0.0), flight_yaw_deg=float(b))
        for a, b in zip(gimbal, flight, strict=True)
    ]


TRACK = np.array([0.0, 0, 0, 0, 180, 180, 180, 180])
LINES = 47.1 + np.array([0, 2, 4, 6, 6, 4, 2, 0]) * 1e-4, 8.6 + np.array([0, 0, 0, 0, 5, 5, 5, 5]) * 1e-4


@pytest.mark.parametrize("offset", [-54.0, -39.0, 85.0])
def test_a_gimbal_beside_the_track_is_corrected_by_the_aircraft(offset: float) -> None:
    poses, remarks = read(photos(gps=gps(*LINES), dji=headings(TRACK + offset, TRACK + 1.0)))
    expected = np.array([geo_from_cam((yaw, -90.0, 0.0)) for yaw in TRACK + 1.0])
    np.testing.assert_allclose(poses.enu_from_cam, expected, atol=0.02)
    np.testing.assert_allclose(poses.sigma_attitude_deg, 5.0)
    assert abs(offset - 1.0) == pytest.approx(numbers(said(remarks.cautions, "headings-apart"))[1], abs=1.0)


@pytest.mark.parametrize(
    ("turned", "pitch", "roll"), [(180.0, -90.0, 180.0), (179.1, -85.6, 179.1), (-130.0, -89.7, 130.0)]
)
def test_yaw_and_roll_of_a_gimbal_at_nadir_count_together(turned: float, pitch: float, roll: float) -> None:
    """At pitch −90° a roll turns the image as the same yaw does: no heading disagrees, nothing is turned."""
    drone = [
        DjiTags(gimbal_yaw_pitch_roll_deg=(float(yaw) + turned, pitch, roll), flight_yaw_deg=float(yaw))
        for yaw in TRACK
    ]
    poses, remarks = read(photos(gps=gps(*LINES), dji=drone))
    expected = geo_from_cam([(yaw + turned, pitch, roll) for yaw in TRACK])
    np.testing.assert_allclose(poses.enu_from_cam, expected, atol=1e-12)
    assert np.isnan(poses.sigma_attitude_deg).all() and not remarks.cautions


def test_where_the_track_tells_nothing_sigma_covers_both() -> None:
    poses, remarks = read(photos(gps=gps(*LINES), dji=headings(TRACK * 0 + 140.0, TRACK * 0 + 90.0)))
    np.testing.assert_allclose(poses.sigma_attitude_deg, 50.0)
    assert codes(remarks.cautions) == ["headings-apart"]


def test_an_aircraft_beside_the_track_leaves_the_gimbal_right() -> None:
    poses, remarks = read(photos(gps=gps(*LINES), dji=headings(TRACK, TRACK + 70.0)))
    assert np.isnan(poses.sigma_attitude_deg).all() and codes(remarks.cautions) == ["headings-apart"]


def pix4d_xmp(yaw: float, pitch: str = "4.2", roll: str = "-1.5", others: str = "") -> bytes:
    names = "".join(
        f"<Camera:{name}>{value}</Camera:{name}>"
        for name, value in (("Yaw", yaw), ("Pitch", pitch), ("Roll", roll), ("GPSXYAccuracy", "2.3"))
    )
    space = 'xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:DLS="http://micasense.com/DLS/1.0/"'
    return packet(f'<rdf:Description rdf:about="" {space}>{names}{others}</rdf:Description>')


def of_packets(packets: list[bytes]) -> list[DjiTags]:
    found = [read_tags(jpeg(xmp=one)).dji for one in packets]
    return [one for one in found if one is not None]


def test_attitudes_in_pix4d_tags_look_down_at_pitch_zero() -> None:
    """As of a Sequoia on a fixed wing, its nose 4° up and turned into the wind: the camera looks ahead."""
    crab = TRACK - 25.0 * np.cos(np.radians(TRACK))
    poses, remarks = read(photos(gps=gps(*LINES), dji=of_packets([pix4d_xmp(yaw) for yaw in crab])))
    view, top = poses.enu_from_cam[:, :, 2], -poses.enu_from_cam[:, :, 1]
    heading = np.degrees(np.arctan2(top[:, 0], top[:, 1]))
    assert np.abs((heading - crab + 180) % 360 - 180).max() < 0.2
    np.testing.assert_allclose(view[:, 2], -np.cos(np.radians(4.2)) * np.cos(np.radians(1.5)), atol=1e-9)
    forward = np.column_stack([np.sin(np.radians(crab)), np.cos(np.radians(crab))])
    np.testing.assert_allclose((view[:, :2] * forward).sum(axis=1), np.sin(np.radians(4.2)), atol=1e-3)
    # The left wing down (roll −1.5°) turns the view to the right.
    right = np.column_stack([np.cos(np.radians(crab)), -np.sin(np.radians(crab))])
    np.testing.assert_allclose((view[:, :2] * right).sum(axis=1), np.sin(np.radians(1.5)), atol=1e-3)
    np.testing.assert_allclose(poses.sigma_attitude_deg, 5.0)
    assert codes(remarks.cautions) == []
    assert "pitch-as-of-gimbal" not in codes(remarks.assumptions)


@pytest.mark.parametrize(
    ("pitch", "roll", "view", "code"),
    [
        ("66.04", "0", (0.0, np.sin(np.radians(66.04)), -np.cos(np.radians(66.04))), None),  # ahead: Autel
        ("-90", "0", (0.0, 0.0, -1.0), "pitch-as-of-gimbal"),  # a gimbal's angles in these tags
        ("0/100", "0/100", None, None),  # as cameras without an attitude write
    ],
)
def test_pitches_in_pix4d_tags(pitch: str, roll: str, view: tuple[float, ...] | None, code: str | None) -> None:
    poses, remarks = read(photos(gps=gps(*LINES), dji=of_packets([pix4d_xmp(0.0, pitch, roll)] * 8)))
    if view is None:
        assert np.isnan(poses.enu_from_cam).all()
    else:
        np.testing.assert_allclose(poses.enu_from_cam[0, :, 2], view, atol=1e-9)
    assert ("pitch-as-of-gimbal" in codes(remarks.assumptions)) == (code is not None)


def test_a_sensor_of_light_has_no_attitude_of_the_camera() -> None:
    """MicaSense states the attitude of its sun sensor in a namespace of its own, in radians."""
    others = "<DLS:Yaw>1.57</DLS:Yaw><DLS:Pitch>0.05</DLS:Pitch><DLS:Roll>0.01</DLS:Roll>"
    packets = [pix4d_xmp(0.0, "0", "0", others)] * 8
    assert all(one.mount_yaw_pitch_roll_deg is None for one in of_packets(packets))


@pytest.mark.parametrize(("yaw", "is_said"), [(4.0, False), (60.0, True)])
def test_two_attitudes_in_xmp_are_compared(yaw: float, *, is_said: bool) -> None:
    drone = [
        replace(one, gimbal_yaw_pitch_roll_deg=(0.0, -90.0, 0.0)) for one in of_packets([pix4d_xmp(yaw, "0")] * 8)
    ]
    poses, remarks = read(photos(gps=gps(*LINES), dji=drone))
    np.testing.assert_allclose(poses.enu_from_cam[0], geo_from_cam((0.0, -90.0, 0.0)), atol=1e-9)
    assert codes(remarks.cautions) == ["attitudes-apart"] * is_said


def test_an_attitude_in_pix4d_tags_beside_the_track_is_corrected_by_the_aircraft() -> None:
    drone = [
        replace(one, flight_yaw_deg=float(yaw))
        for one, yaw in zip(of_packets([pix4d_xmp(yaw + 90.0, "0", "0.1") for yaw in TRACK]), TRACK, strict=True)
    ]
    poses, remarks = read(photos(gps=gps(*LINES), dji=drone))
    top = -poses.enu_from_cam[:, :, 1]
    assert np.abs((np.degrees(np.arctan2(top[:, 0], top[:, 1])) - TRACK + 180) % 360 - 180).max() < 0.1
    assert codes(remarks.cautions) == ["headings-apart"]


@pytest.mark.parametrize(("offset", "pitch"), [(9.0, -90.0), (90.0, -30.0)])
def test_headings_of_sound_flights_are_not_blamed(offset: float, pitch: float) -> None:
    """Turns and compasses explain some degrees; a gimbal that looks aside has a heading of its own."""
    poses, remarks = read(photos(gps=gps(*LINES), dji=headings(TRACK + offset, TRACK, pitch)))
    assert np.isnan(poses.sigma_attitude_deg).all() and not remarks.cautions


def test_without_positions_the_error_tells_what_there_is() -> None:
    drone = DjiTags(gimbal_yaw_pitch_roll_deg=(1.0, -90.0, 0.0), relative_altitude_m=53.0)
    with refused("no-positions", InputError) as error:
        require_placed(False, photos(make="Maker", model="Camera", dji=drone))
    assert "Maker Camera" in str(error.value)
    assert 53.0 in numbers(str(error.value)) and str(error.value).count(str(COUNT)) >= 2
