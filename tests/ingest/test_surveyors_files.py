"""Files of surveyors' programs end as the same survey as OpenDroneMap's: same places, marks and σ."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from pipelines.core.errors import InconsistencyError, InputError
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_lla, enu_from_ecef
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.formats.test_surveyors_tables import DEGREES, SECOND, TAIL, WEEK, WGS84
from tests.photos import FLIGHT_START_S, Exif, dji_xmp, gps_entries, jpeg, write_flight
from tests.refusals import codes, refused, said

PLACES = {"G1": (46.0201, 7.7501, 100.0), "G2": (46.0199, 7.7502, 101.0)}  # latitude, longitude, ellipsoidal height
MARKS = {"G1": [("IMG_0000.JPG", 10.5, 20.25), ("IMG_0001.JPG", 12.5, 21.0)], "G2": [("IMG_0001.JPG", 30.0, 31.0)]}
MARK_TABLE = "".join(f"{image},{name},{x},{y}\n" for name, marks in MARKS.items() for image, x, y in marks)
# A national grid whose register has the northing first, and UTM, whose register has the easting first.
NORTH_FIRST, EAST_FIRST = "EPSG:3416", "EPSG:32632"


def odm() -> str:
    rows = (
        f"{lon} {lat} {alt} {x} {y} {image} {name}\n"
        for name, (lat, lon, alt) in PLACES.items()
        for image, x, y in MARKS[name]
    )
    return "EPSG:4979\n" + "".join(rows)


def pix4d(*, header: str = "", order: tuple[int, ...] = (0, 1, 2), crs: str = "EPSG:4326") -> str:
    """Rows with the coordinates of `crs` in an order of northing, easting, height."""
    forward = Transformer.from_crs("EPSG:4979", crs, always_xy=True)
    text = header
    for name, (lat, lon, alt) in PLACES.items():
        east, north = forward.transform(lon, lat)
        text += f"{name},{','.join(f'{(north, east, alt)[at]:.9f}' for at in order)}\n"
    return text


def metashape_reference() -> str:
    rows = "".join(f"{name},{lon},{lat},{alt},,\n" for name, (lat, lon, alt) in PLACES.items())
    return f"# CoordinateSystem: {WGS84}\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_(m),Error_(m)\n{rows}"


def metashape_xml() -> str:
    names = list(PLACES)
    markers = "".join(
        f'<marker id="{at}" label="{name}"><reference x="{lon}" y="{lat}" z="{alt}" enabled="true"/></marker>'
        for at, (name, (lat, lon, alt)) in enumerate(PLACES.items())
    )
    projections = "".join(
        f'<marker marker_id="{names.index(name)}">'
        + "".join(f'<location camera_id="{image[4:8]}" pinned="true" x="{x}" y="{y}"/>' for image, x, y in marks)
        + "</marker>"
        for name, marks in MARKS.items()
    )
    cameras = "".join(f'<camera id="000{at}" label="IMG_000{at}"/>' for at in range(3))
    return (
        f"<document><chunk><cameras>{cameras}</cameras><markers>{markers}</markers><frames><frame><markers>{projections}"
        f"</markers></frame></frames><reference>{WGS84.replace(chr(34), '&quot;')}</reference></chunk></document>"
    )


def survey_of(folder: Path, **options: object) -> Survey:
    survey, _ = survey_and_track(IngestOptions(images=folder, vertical="ellipsoidal", **options), None)  # type: ignore[arg-type]
    return survey


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A folder of six photographs above the points."""
    write_flight(tmp_path / "images", 6)
    return tmp_path / "images"


KINDS = {
    "gcp_list.txt": (odm(), False, None),
    "markers.xml": (metashape_xml(), False, None),
    "reference.txt": (metashape_reference(), True, None),
    "latitude first by the register": (pix4d(), True, "EPSG:4326"),
    "header, longitude first": (pix4d(header="Label,Longitude,Latitude,Z\n", order=(1, 0, 2)), True, None),
    "northing first by the register": (pix4d(crs=NORTH_FIRST), True, NORTH_FIRST),
    "easting first by the register": (pix4d(crs=EAST_FIRST, order=(1, 0, 2)), True, EAST_FIRST),
    "header, x is the easting": (pix4d(header="id,y,x,z\n", crs=NORTH_FIRST), True, NORTH_FIRST),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_file_of_points_gives_the_same_survey(kind: str, flight: Path, tmp_path: Path) -> None:
    """Nine decimals of a degree are a tenth of a millimetre, and a table rounds its grid coordinates by less."""
    text, has_marks_apart, crs = KINDS[kind]
    (tmp_path / "points.dat").write_text(text)
    (tmp_path / "marks.csv").write_text(MARK_TABLE)
    options: dict[str, object] = {"gcp": tmp_path / "points.dat", "gcp_crs": crs}
    if has_marks_apart:
        options["marks"] = tmp_path / "marks.csv"
    survey = survey_of(flight, **options)
    (control,), (unmarked,) = survey.control_points, survey.unmarked_points
    for point in (control, unmarked):
        expected = enu_from_ecef(ecef_from_lla(PLACES[point.name]), survey.origin)
        np.testing.assert_allclose(point.position_in_geo, expected, rtol=0, atol=2e-4)
        marks = [(mark.image, mark.x_px, mark.y_px) for mark in point.marks]
        assert marks == MARKS[point.name]
    assert (control.name, unmarked.name, unmarked.use) == ("G1", "G2", "control")
    assert "G2 (control)" in said(survey.warnings, "point-unmarked")
    assert ("file-kind" in codes(survey.assumptions)) == (kind != "gcp_list.txt")


@pytest.mark.parametrize(
    ("text", "options", "code", "says"),
    [
        (
            pix4d(),
            {"gcp_crs": "EPSG:4326"},
            "axis-order",
            "the latitude stands before the longitude, as in the definition of EPSG:4326",
        ),
        (
            pix4d(crs=EAST_FIRST, order=(1, 0, 2)),
            {"gcp_crs": EAST_FIRST},
            "axis-order",
            f"the easting stands before the northing, as in the definition of {EAST_FIRST}",
        ),
        (
            pix4d(header="id,y,x,z\n", crs=NORTH_FIRST),
            {"gcp_crs": NORTH_FIRST},
            "axis-order",
            f"x in points.csv is the easting, although {NORTH_FIRST}",
        ),
        (metashape_reference(), {"gcp_crs": "EPSG:32632"}, "gcp-crs-unused", "points.csv"),
    ],
)
def test_order_of_axes_is_told(
    text: str, options: dict[str, object], code: str, says: str, flight: Path, tmp_path: Path
) -> None:
    (tmp_path / "points.csv").write_text(text)
    survey = survey_of(flight, gcp=tmp_path / "points.csv", **options)
    assert says in said(survey.assumptions, code)
    assert survey.control_points == () and [point.name for point in survey.unmarked_points] == ["G1", "G2"]


@pytest.mark.parametrize(
    ("text", "options", "code", "says"),
    [
        (pix4d(), {}, "crs-missing", r"\[--gcp-crs\]: points\.csv"),
        (pix4d(order=(1, 0, 2)), {"gcp_crs": "EPSG:4326"}, "point-far-away", r"points\.csv:1: G1 is \d+ km"),
        (
            pix4d(header="Label,Longitude,Latitude,Z\n", order=(1, 0, 2)),
            {"gcp_crs": "EPSG:32632"},
            "crs-not-geographic",
            r"\[--gcp-crs\]: points\.csv .*EPSG:32632",
        ),
        (
            metashape_reference().replace(WGS84, 'LOCAL_CS["Local (m)"]'),
            {},
            "crs-not-of-points",
            r"points\.csv:1: ",
        ),
    ],
)
def test_points_that_are_refused(
    text: str, options: dict[str, object], code: str, says: str, flight: Path, tmp_path: Path
) -> None:
    (tmp_path / "points.csv").write_text(text)
    with refused(code, InputError) as error:
        survey_of(flight, gcp=tmp_path / "points.csv", **options)
    assert re.search(says, str(error.value))


def test_sigma_and_check_points_of_the_file_count(flight: Path, tmp_path: Path) -> None:
    """A marker that is not enabled is a check point, and a σ of the file gives way to an option only."""
    text = metashape_xml().replace(
        'z="101.0" enabled="true"', 'z="101.0" sx="0.1" sy="0.1" sz="0.2" enabled="false"'
    )
    (tmp_path / "markers.xml").write_text(text)
    survey = survey_of(flight, gcp=tmp_path / "markers.xml")
    (unmarked,) = survey.unmarked_points
    assert (unmarked.name, unmarked.use) == ("G2", "check")
    np.testing.assert_allclose(np.sqrt(np.diag(unmarked.cov_in_geo)), [0.1, 0.1, 0.2], rtol=0, atol=1e-4)
    stated = survey_of(flight, gcp=tmp_path / "markers.xml", sigma_gcp_h=0.5).unmarked_points[0]
    np.testing.assert_allclose(np.sqrt(np.diag(stated.cov_in_geo)), [0.5, 0.5, 0.2], rtol=0, atol=1e-4)


def test_marks_that_name_no_point_are_counted(flight: Path, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(pix4d())
    (tmp_path / "marks.csv").write_text(MARK_TABLE + "IMG_0002.JPG,G9,1,2\nIMG_0009.JPG,G1,1,2\n")
    survey = survey_of(flight, gcp=tmp_path / "points.csv", gcp_crs="EPSG:4326", marks=tmp_path / "marks.csv")
    assert "(1): marks.csv:4 (G9)." in said(survey.warnings, "mark-of-unknown-point")
    assert "(1): marks.csv:5 (IMG_0009.JPG)." in said(survey.warnings, "mark-in-unknown-image")
    (tmp_path / "marks.csv").write_text(MARK_TABLE + MARK_TABLE)
    with refused("mark-twice", InputError) as error:
        survey_of(flight, gcp=tmp_path / "points.csv", gcp_crs="EPSG:4326", marks=tmp_path / "marks.csv")
    assert re.search(r"marks\.csv:4 \[image\]: G1 .* IMG_0000\.JPG", str(error.value))


COUNT = 6
OFFSET_MM = (-66, 10, 194)  # of the camera from the antenna: north, east, down


def truth(seconds: float) -> tuple[float, float, float]:
    """Latitude, longitude and height of the antenna, eastward at a steady speed."""
    return 46.02, 7.75 + 1e-4 * seconds, 1700.0 + 0.5 * seconds


def exposure_s(index: int) -> float:
    return 0.37 + 1.9 * index


@pytest.fixture
def dji(tmp_path: Path) -> Path:
    """A DJI flight: photographs with whole seconds of local time, and the events and the solution beside them."""
    folder = tmp_path / "DJI_202405011400_001"
    folder.mkdir()
    mrk = ""
    for index in range(COUNT):
        lat, lon, alt = truth(exposure_s(index))
        second = int(exposure_s(index))
        exif = Exif(photo=[(0x9003, 2, f"2024:05:01 14:00:{second:02d}")], gps=gps_entries(lat, lon, alt))
        xmp = dji_xmp(RtkFlag="50", RtkStdLon="0.01", RtkStdLat="0.01", RtkStdHgt="0.02")
        (folder / f"DJI_20240501140000_{index + 1:04d}_V.JPG").write_bytes(jpeg(index, exif=exif, xmp=xmp))
        north, east, down = OFFSET_MM
        mrk += (
            f"{index + 1}\t{SECOND + exposure_s(index):.6f}\t[{WEEK}]\t{north:6d},N\t{east:6d},E\t{down:6d},V\t"
            f"{lat:.8f},Lat\t{lon:.8f},Lon\t{alt:.3f},Ellh\t0.011000, 0.012000, 0.025000\t50,Q\n"
        )
    (folder / "flight_Timestamp.MRK").write_text(mrk)
    rows = ""
    for tick in range(70):
        lat, lon, alt = truth(tick / 5)
        clock = 18 + tick / 5  # GPS time
        rows += f"2024/05/01 12:00:{clock:06.3f}   {lat:.9f}    {lon:.9f}  {alt:.4f}{TAIL}"
    (folder / "flight.pos").write_text(DEGREES.format(clock="GPST") + rows)
    return folder


class TestDji:
    def test_events_are_matched_by_number(self, dji: Path) -> None:
        """Positions of a .MRK are those of the camera; eight decimals of a degree are a millimetre."""
        survey = survey_of(dji, trajectory=dji / "flight_Timestamp.MRK")
        for index, image in enumerate(survey.images):
            assert image.fix is not None and image.fix.source == "mrk" and image.fix.sigma_source == "file"
            expected = enu_from_ecef(ecef_from_lla(truth(exposure_s(index))), survey.origin)
            np.testing.assert_allclose(image.fix.position_in_geo, expected, rtol=0, atol=2e-3)
            np.testing.assert_allclose(np.sqrt(np.diag(image.fix.cov_in_geo)), [0.012, 0.011, 0.025], atol=1e-6)
            assert image.timestamp_s == pytest.approx(FLIGHT_START_S + exposure_s(index), abs=1e-5)
        assert survey.vertical.stated and survey.vertical.name == "ellipsoidal"
        assert "flight_Timestamp.MRK" in said(survey.assumptions, "file-kind")

    def test_solution_at_the_events_is_moved_to_the_camera(self, dji: Path) -> None:
        """The antenna's path at the times of the events, and their offsets; EXIF's clock is hours off."""
        survey = survey_of(dji, trajectory=dji / "flight.pos", events=dji / "flight_Timestamp.MRK")
        north, east, down = (value / 1000 for value in OFFSET_MM)
        for index, image in enumerate(survey.images):
            assert image.fix is not None and image.fix.source == "pos"
            antenna = enu_from_ecef(ecef_from_lla(truth(exposure_s(index))), survey.origin)
            expected = antenna + np.array([east, north, -down])
            np.testing.assert_allclose(image.fix.position_in_geo, expected, rtol=0, atol=1e-3)

    def test_quality_of_a_solution_tells_the_kind_of_receiver(self, dji: Path) -> None:
        """A float solution may claim centimetres. The fourth photograph lies between a fixed and a float row."""
        mrk, pos = dji / "flight_Timestamp.MRK", dji / "flight.pos"
        lines = mrk.read_text().splitlines(keepends=True)
        single = lines[5].replace("0.011000, 0.012000, 0.025000\t50,Q", "1.1, 1.2, 2.5\t16,Q")
        mrk.write_text("".join([*lines[:4], lines[4].replace("50,Q", "34,Q"), single]))
        survey = survey_of(dji, trajectory=mrk)
        assert [session.receiver for session in survey.sessions] == ["RTK fixed", "RTK float", "single-frequency"]
        assert [image.fix and image.fix.session for image in survey.images] == [0, 0, 0, 0, 1, 2]
        rows = pos.read_text().splitlines(keepends=True)
        first = next(row for row, text in enumerate(rows) if "12:00:24.2" in text)
        floating = [text.replace("   1  ", "   2  ", 1) for text in rows[first:]]
        assert floating[0] != rows[first]
        pos.write_text("".join(rows[:first] + floating))
        survey = survey_of(dji, trajectory=pos, events=mrk)
        assert [session.receiver for session in survey.sessions] == ["RTK fixed", "RTK float"]
        assert [image.fix and image.fix.session for image in survey.images] == [0, 0, 0, 1, 1, 1]

    def test_solution_without_events_is_told_to_miss(self, dji: Path) -> None:
        with refused("times-apart", InputError) as error:
            survey_of(dji, trajectory=dji / "flight.pos")
        assert (error.value.path, error.value.field) == (dji / "flight.pos", "timestamp")

    def test_what_does_not_fit_is_counted(self, dji: Path) -> None:
        (dji / "DJI_20240501140000_0003_V.JPG").rename(dji / "DJI_20240501140000_0103_V.JPG")
        survey = survey_of(dji, trajectory=dji / "flight_Timestamp.MRK")
        lonely = said(survey.warnings, "image-without-event")
        assert "flight_Timestamp.MRK (1): DJI_20240501140000_0103_V.JPG." in lonely
        assert "(1): flight_Timestamp.MRK:3." in said(survey.warnings, "event-without-image")

    def test_file_of_another_flight_is_refused(self, dji: Path) -> None:
        """Counted backwards, the two events in the middle are less than three seconds off."""
        path = dji / "flight_Timestamp.MRK"
        path.write_text(
            "".join(f"{COUNT + 1 - int(line[0])}{line[1:]}\n" for line in path.read_text().splitlines())
        )
        with refused("event-times", InconsistencyError) as error:
            survey_of(dji, trajectory=path)
        assert "4 of 6 photographs" in str(error.value)

    def test_numbers_of_two_flights_are_refused(self, dji: Path) -> None:
        (dji / "second").mkdir()
        (dji / "second/DJI_0001.JPG").write_bytes(jpeg(99))
        with refused("event-folders", InputError) as error:
            survey_of(dji, trajectory=dji / "flight_Timestamp.MRK")
        assert "(., second)" in error.value.message

    @pytest.mark.parametrize(
        ("options", "code", "field"),
        [
            ({"events": "flight_Timestamp.MRK"}, "events-need-antenna-track", "--events"),
            (
                {"events": "flight_Timestamp.MRK", "trajectory": "flight_Timestamp.MRK"},
                "events-without-times",
                "--events",
            ),
            ({"marks": "flight.pos"}, "needs-ground-points", "--marks"),
        ],
    )
    def test_options_that_cannot_be(self, dji: Path, options: dict[str, str], code: str, field: str) -> None:
        with refused(code, InputError) as error:
            survey_of(dji, **{name: dji / file for name, file in options.items()})
        assert error.value.field == field


def test_heights_above_an_unnamed_geoid_are_refused(dji: Path) -> None:
    path = dji / "flight.pos"
    path.write_text(path.read_text().replace("WGS84/ellipsoidal", "WGS84/geodetic"))
    options = IngestOptions(images=dji, trajectory=path, events=dji / "flight_Timestamp.MRK")
    with refused("geoid-not-named", InputError) as error:
        survey_and_track(options, None)
    assert (error.value.path, error.value.field) == (path, "--vertical")


def test_metashape_cameras_are_matched_by_label(flight: Path, tmp_path: Path) -> None:
    """Labels may lack the suffix; pitch 0 looks straight down, and yaw turns from north to east."""
    rows = "".join(f"IMG_000{at},{7.75 + 1e-4 * at:.10f},46.02,120,90,0,0\n" for at in range(6))
    text = f"# CoordinateSystem: {WGS84}\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\n{rows}"
    (tmp_path / "cameras.txt").write_text(text)
    survey = survey_of(flight, trajectory=tmp_path / "cameras.txt")
    for at, image in enumerate(survey.images):
        assert image.fix is not None and image.attitude is not None and image.fix.source == "metashape"
        in_ecef = ecef_from_enu(image.fix.position_in_geo, survey.origin)
        np.testing.assert_allclose(in_ecef, ecef_from_lla([46.02, 7.75 + 1e-4 * at, 120.0]), rtol=0, atol=1e-4)
        x, y, z, w = image.attitude.quat_xyzw
        forward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        np.testing.assert_allclose(forward, [0, 0, -1], rtol=0, atol=1e-4)
