"""Tables of Metashape, PIX4D, RTKLIB and DJI in the layout of their files, with figures of our own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.gnss_logs import read_mrk, read_pos
from pipelines.formats.gps_time import unix_from_gps, unix_from_week
from pipelines.formats.ground_points import read_marks, read_point_table
from pipelines.formats.metashape import read_cameras, read_markers, read_markers_xml
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla
from pipelines.geometry.rotations import geo_from_cam, matrix_from_quat_xyzw
from tests.photos import FLIGHT_START_S
from tests.refusals import refused

# 2024-05-01 12:00:00 UTC: Wednesday of GPS week 2312, and GPS is 18 s ahead.
WEEK, SECOND = 2312, 3 * 86400 + 12 * 3600 + 18.0


def write(tmp_path: Path, text: str, name: str) -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def check_refusal(
    read: Callable[[Path], object], path: Path, code: str, line: int | None, field: str | None, *words: str
) -> None:
    """Require an error of a file with its place, whose message has words or numbers."""
    with refused(code, InputError) as error:
        read(path)
    assert (error.value.path, error.value.line, error.value.field) == (path, line, field)
    assert all(word in error.value.message for word in words), error.value.message


class TestGpsTime:
    def test_weeks_count_from_1980(self) -> None:
        assert unix_from_week([0.0], [0.0]) == [315964800.0]
        assert unix_from_week([float(WEEK)], [SECOND]) == [FLIGHT_START_S]

    def test_leap_second_of_2016_enters_when_it_ends(self) -> None:
        """GPS time was 17 s ahead until the end of 2016-12-31T23:59:60, and is 18 s ahead since."""
        new_year_2017_s = 1483228800.0
        np.testing.assert_array_equal(
            unix_from_gps(new_year_2017_s + np.array([0.0, 16.5, 18.0, 19.0])) - new_year_2017_s, [-17, -0.5, 0, 1]
        )


MRK = (
    "1\t302418.500000\t[2312]\t   -66,N\t    10,E\t   194,V\t46.02000000,Lat\t7.75000000,Lon\t1620.250,Ellh\t"
    "0.011000, 0.012000, 0.025000\t50,Q\n"
    "2\t302420.250000\t[2312]\t   -60,N\t    12,E\t   190,V\t0.00000000,Lat\t0.00000000,Lon\t0.000,Ellh\t"
    "0.000000, 0.000000, 0.000000\t0,Q\r\n"
)


class TestMrk:
    def test_layout(self, tmp_path: Path) -> None:
        events = read_mrk(write(tmp_path, MRK, "flight_Timestamp.MRK"))
        assert events.number.tolist() == [1, 2] and events.lines.tolist() == [1, 2]
        np.testing.assert_array_equal(
            events.time_s - FLIGHT_START_S, [0.5 - SECOND + 302418, 2.25 - SECOND + 302418]
        )
        np.testing.assert_array_equal(events.lon_lat_alt[0], [7.75, 46.02, 1620.25])
        np.testing.assert_array_equal(events.sigma_enu_m[0], [0.012, 0.011, 0.025])
        np.testing.assert_allclose(events.camera_from_antenna_enu_m[0], [0.010, -0.066, -0.194])
        assert np.isnan(events.lon_lat_alt[1]).all() and np.isnan(events.sigma_enu_m[1]).all()

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            (MRK + "3\t1\n", ("line-layout", 3, None, "number, second")),
            (MRK + MRK.split("\n", maxsplit=1)[0], ("event-twice", 3, None, "Event 1", "line 1")),
            (MRK.replace("46.02000000", "146.0200000"), ("value-out-of-range", 1, "Lat", "146.02", "-90 … 90")),
            (MRK.replace("302418.5", "702418.5"), ("value-out-of-range", 1, "second of week")),
        ],
    )
    def test_refusals(self, tmp_path: Path, text: str, told: tuple[str, int | None, str | None]) -> None:
        check_refusal(read_mrk, write(tmp_path, text, "a.MRK"), *told)


POS_HEAD = (
    "% program   : RTKPOST ver.2.4.3\n% inp file  : rover.obs\n% obs start : 2024/05/01 11:59:00.0 GPST\n"
    "% ref pos   : 46.010000000   7.740000000  1600.0000\n%\n"
)
ELLIPSOIDAL = (
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
)
SIGMAS = "  Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio\n"
DEGREES = POS_HEAD + ELLIPSOIDAL + "%  {clock}                  latitude(deg) longitude(deg)  height(m) " + SIGMAS
TAIL = "   1   9   0.0080   0.0070   0.0150   0.0012  -0.0011   0.0009   0.00   12.3\n"


class TestPos:
    @pytest.mark.parametrize(
        ("clock", "time"),
        [
            ("GPST", "2024/05/01 12:00:18.000"),
            ("GPST", "2024/05/01 11:59:78.000"),  # seconds are rounded up to 60 only
            ("UTC", "2024/05/01 12:00:00.000"),
            ("JST", "2024/05/01 21:00:00.000"),
            ("GPST", f"{WEEK} {SECOND:.3f}"),
        ],
    )
    def test_clocks(self, tmp_path: Path, clock: str, time: str) -> None:
        path = write(
            tmp_path,
            DEGREES.format(clock=clock) + f"{time}   46.020000000    7.750000000  1620.2500{TAIL}",
            "a.pos",
        )
        if ":78" in time:
            check_refusal(read_pos, path, "time-invalid", 8, "time", "2024/05/01 11:59:78.000")
            return
        table = read_pos(path)
        assert table.time_s is not None and table.sigma_enu_m is not None
        np.testing.assert_allclose(table.time_s - FLIGHT_START_S, 0.0, atol=1e-6)
        np.testing.assert_array_equal(table.xyz, [[7.75, 46.02, 1620.25]])
        np.testing.assert_array_equal(table.sigma_enu_m, [[0.007, 0.008, 0.015]])
        assert (table.geographic, table.assumed_crs, table.heights_above_geoid) == (True, "EPSG:4979", False)

    def test_sexagesimal_and_heights_above_a_geoid(self, tmp_path: Path) -> None:
        head = POS_HEAD + ELLIPSOIDAL.replace("ellipsoidal", "geodetic")
        head += "%  GPST                latitude(d'm\") longitude(d'm\")  height(m)" + SIGMAS
        table = read_pos(
            write(
                tmp_path, head + f"2024/05/01 12:00:18.000  -46 01 12.00000   -0 45 00.00000  1566.1{TAIL}", "a.pos"
            )
        )
        np.testing.assert_allclose(table.xyz, [[-0.75, -46.02, 1566.1]], rtol=0, atol=1e-12)
        assert table.heights_above_geoid and table.assumed_crs == "EPSG:4326"

    def test_earth_centred_with_turned_covariance(self, tmp_path: Path) -> None:
        """σ of 1, 2 and 5 cm east, north and up, written in Earth-centred axes, come back: RTKLIB keeps 0.1 mm."""
        lla, sigma = np.array([46.02, 7.75, 1620.25]), np.array([0.01, 0.02, 0.05])
        turn = ecef_from_enu_rotation(lla)
        cov = turn @ np.diag(sigma**2) @ turn.T
        roots = [
            np.sign(cov[a, b]) * np.sqrt(abs(cov[a, b]))
            for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))
        ]
        head = POS_HEAD + "% (x/y/z-ecef=WGS84,Q=1:fix,2:float)\n"
        head += "%  GPST                      x-ecef(m)      y-ecef(m)      z-ecef(m)   Q  ns   sdx(m)\n"
        xyz = ecef_from_lla(lla)
        row = "2024/05/01 12:00:18.000 " + " ".join(f"{value:.4f}" for value in xyz) + "   1   9 "
        table = read_pos(
            write(tmp_path, head + row + " ".join(f"{root:.4f}" for root in roots) + " 0.0 3.0\n", "a.pos")
        )
        assert table.sigma_enu_m is not None and table.assumed_crs == "EPSG:4978"
        np.testing.assert_allclose(table.xyz[0], xyz, rtol=0, atol=5e-5)
        np.testing.assert_allclose(table.sigma_enu_m[0], sigma, rtol=0, atol=4e-4)

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("2024/05/01 12:00:18 46.02 7.75 1620 1 9\n", ("header-missing", None, None)),
            ("%  GPST  e-baseline(m)  n-baseline(m)  u-baseline(m)\n1 2 3 4 5\n", ("baselines", 1, None)),
            (DEGREES.format(clock="GPST"), ("no-rows", None, None)),
            (DEGREES.format(clock="GPST") + "2024/05/01 12:00:18 46.02\n", ("wrong-columns", 8, None, "3 cells")),
            (
                DEGREES.format(clock="GPST") + "2024/05/01 12:00:18 96.02 7.7 1\n",
                ("position-off-earth", 8, "position"),
            ),
            (DEGREES.format(clock="GPST") + f"{WEEK} 700000 46.02 7.7 1\n", ("time-invalid", 8, "time")),
        ],
    )
    def test_refusals(self, tmp_path: Path, text: str, told: tuple[str, int | None, str | None]) -> None:
        check_refusal(read_pos, write(tmp_path, text, "a.pos"), *told)


WGS84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG",'
    '"7030"]],TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4326"]]'
)
REFERENCE = (
    f"# CoordinateSystem: {WGS84}\n"
    "#Label,Enable,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m),Error_(m),X_error,Y_error,"
    "Z_error,X_est,Y_est,Z_est,Remark\n"
    "G1,1,7.7500000000,46.0200000000,1620.250000,0.010000,0.020000,0.03,0.01,0.02,0.02,7.75,46.02,1620.27,pillar\n"
    "G2,0,7.7600000000,46.0300000000,1621.250000,,,,,,,,,,\n"
    "point 3,1,,,,,,,,,,7.75,46.02,1620.2,\n"
    "# Total error,0.031,0.010000,0.020000,0.020000\n"
)


class TestMetashapeReference:
    def test_markers(self, tmp_path: Path) -> None:
        listed = read_markers(write(tmp_path, REFERENCE, "markers.txt"))
        first, second = listed.points
        assert (first.name, first.line, first.xyz) == ("G1", 3, (7.75, 46.02, 1620.25))
        assert (first.sigma_h_m, first.sigma_v_m, first.is_check) == (0.01, 0.02, False)
        assert (second.name, second.sigma_h_m, second.sigma_v_m, second.is_check) == ("G2", None, None, True)
        assert (listed.crs_text, listed.crs_line, listed.geographic) == (WGS84, 1, True)
        assert listed.unknown_columns == ("Remark",) and listed.marks == ()

    def test_cameras_look_down_at_pitch_zero(self, tmp_path: Path) -> None:
        text = (
            "# Cameras (2)\n#Label\tX/Easting\tY/Northing\tZ/Altitude\tYaw\tPitch\tRoll\tError_(m)\tYaw_est\n"
            "DJI_0001\t400000.5\t5097000.25\t120\t90\t0\t0\t0.1\t91\nDJI_0002\t400010.5\t5097000.25\t121\t\t\t\t\t\n"
        )
        table = read_cameras(write(tmp_path, text, "cameras.txt"))
        assert table.names == ("DJI_0001", "DJI_0002") and table.lines.tolist() == [3, 4]
        np.testing.assert_array_equal(table.xyz, [[400000.5, 5097000.25, 120], [400010.5, 5097000.25, 121]])
        assert table.quat_xyzw is not None and np.isnan(table.quat_xyzw[1]).all()
        turned = matrix_from_quat_xyzw(table.quat_xyzw[0])
        np.testing.assert_allclose(turned, geo_from_cam([90.0, -90.0, 0.0]), rtol=0, atol=1e-12)
        np.testing.assert_allclose(turned[:, 2], [0, 0, -1], rtol=0, atol=1e-12)
        assert (table.geographic, table.crs_text, table.unknown_columns) == (None, None, ())

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("#Label,X/Easting,Z/Altitude\nG1,1,2\n", ("column-missing", 1, None, "column y")),
            ("#Label,X/Easting,Y/Northing,Z/Altitude\n", ("no-rows", None, None)),
            ("#Label,X/Easting,Y/Northing,Z/Altitude\nG1,1,b,2\n", ("not-a-number", 2, "y", "'b'")),
            (
                "#Label,X/Easting,Y/Northing,Z/Altitude\nG1,1,2,2\nG1,1,3,2\n",
                ("point-twice", 3, "x y z", "G1", "line 2"),
            ),
            ("#Label,X,Y,Z,Easting\nG1,1,2,2,3\n", ("column-twice", 1, None, "X, Easting")),
            ("#Label,X,Y,Z\n,1,2,2\n", ("name-missing", 2, "label")),
        ],
    )
    def test_refusals(self, tmp_path: Path, text: str, told: tuple[str, int | None, str | None]) -> None:
        check_refusal(read_markers, write(tmp_path, text, "a.txt"), *told)


XML = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0">
  <chunk>
    <cameras next_id="3" next_group_id="1">
      <group id="0" label="flight"><camera id="0" label="DJI_0001.JPG"/><camera id="1" label="DJI_0002"/></group>
    </cameras>
    <markers next_id="4" next_group_id="0">
      <marker id="0" label="G1"><reference x="7.75" y="46.02" z="1620.25" sxyz="0.005" enabled="true"/></marker>
      <marker id="1" label="G2"><reference x="7.76" y="46.03" z="1" sx=".1" sy=".2" sz=".3" enabled="0"/></marker>
      <marker id="2" label="point 3"/>
    </markers>
    <frames next_id="1">
      <frame id="0">
        <markers>
          <marker marker_id="0">
            <location camera_id="0" pinned="true" x="10.5" y="20.25"/>
            <location camera_id="1" pinned="1" x="11.5" y="21.25"/>
          </marker>
          <marker marker_id="1">
            <location camera_id="0" pinned="false" x="1.5" y="2.25"/>
            <location camera_id="1" pinned="0" valid="0"/>
          </marker>
          <marker marker_id="2"><location camera_id="0" pinned="true" x="5" y="6"/></marker>
        </markers>
      </frame>
    </frames>
    <reference>{WGS84.replace('"', "&quot;")}</reference>
    <settings><property name="accuracy_markers" value="0.005"/></settings>
  </chunk>
</document>
"""


class TestMetashapeMarkers:
    def test_layout(self, tmp_path: Path) -> None:
        listed = read_markers_xml(write(tmp_path, XML, "markers.xml"))
        first, second = listed.points
        assert (first.name, first.line, first.xyz) == ("G1", 8, (7.75, 46.02, 1620.25))
        assert (first.sigma_h_m, first.sigma_v_m, first.is_check) == (0.005, 0.005, False)
        assert (second.name, second.sigma_h_m, second.sigma_v_m, second.is_check) == ("G2", 0.2, 0.3, True)
        marks = [(mark.line, mark.name, mark.image, mark.x_px, mark.y_px) for mark in listed.marks]
        assert marks == [(16, "G1", "DJI_0001.JPG", 10.5, 20.25), (17, "G1", "DJI_0002", 11.5, 21.25)]
        assert listed.left_out == ("markers.xml:20",)
        assert (listed.crs_text, listed.crs_line) == (WGS84, 27)

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("<document><chunk></document>", ("xml-invalid", None, None)),
            ("<document/>", ("no-markers", None, None)),
            (XML.replace("</document>", "<chunk/></document>"), ("several-chunks", 30, None)),
            (XML.replace('x="10.5"', 'x="ten"'), ("not-a-number", 16, "x", "'ten'")),
            (XML.replace('label="G2"', 'label="G1"'), ("marker-twice", 9, None, "G1")),
            ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', ("xml-invalid", None, None, "DTD")),
            ("<a>" * 200, ("xml-too-deep", 1, None)),
        ],
    )
    def test_refusals(self, tmp_path: Path, text: str, told: tuple[str, int | None, str | None]) -> None:
        check_refusal(read_markers_xml, write(tmp_path, text, "a.xml"), *told)


class TestPix4d:
    def test_points_without_header_stand_in_the_order_of_the_crs(self, tmp_path: Path) -> None:
        listed = read_point_table(
            write(tmp_path, "GCP0,46.02,7.75,1620.25,0.02,0.03\nGCP1,46.03,7.76,1621\n", "a.csv")
        )
        assert [(point.name, point.xyz) for point in listed.points] == [
            ("GCP0", (46.02, 7.75, 1620.25)),
            ("GCP1", (46.03, 7.76, 1621.0)),
        ]
        assert (listed.points[0].sigma_h_m, listed.points[0].sigma_v_m) == (0.02, 0.03)
        assert listed.in_order_of_crs and listed.geographic is None and listed.crs_text is None

    @pytest.mark.parametrize(
        "header", ["Label,Latitude,Longitude,Altitude [m]", "point name,LAT,Lon (deg),z,Accuracy Horz [meter]"]
    )
    def test_header_names_the_order(self, tmp_path: Path, header: str) -> None:
        listed = read_point_table(write(tmp_path, f"\ufeff# comment\n{header}\nGCP0,46.02,7.75,1620.25\n", "a.csv"))
        assert listed.points[0].xyz == (7.75, 46.02, 1620.25)
        assert not listed.in_order_of_crs and listed.geographic is True

    def test_decimal_commas_between_semicolons(self, tmp_path: Path) -> None:
        listed = read_point_table(write(tmp_path, "Name;Y;X;H\nP1;5097000,25;400000,5;120\n", "a.csv"))
        assert listed.points[0].xyz == (400000.5, 5097000.25, 120.0) and listed.geographic is False

    @pytest.mark.parametrize("header", ["", "imagename,label,x,y,zoom\n"])
    def test_marks(self, tmp_path: Path, header: str) -> None:
        marks = read_marks(write(tmp_path, header + "flight/a.jpg,GCP0,3830.31,123.113,1.22678\n", "marks.csv"))
        (mark,) = marks
        assert (mark.image, mark.name, mark.x_px, mark.y_px) == ("flight/a.jpg", "GCP0", 3830.31, 123.113)

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("GCP0,46.02,7.75\n", ("wrong-columns", 1, None, "3 columns", "two coordinates and z")),
            ("label,x,latitude,z\nP,1,2,3\n", ("column-missing", 1, None, "label, x, latitude, z")),
            ("label,x,y,z\n", ("no-rows", None, None)),
            ("GCP0,46.02,7.75,\n", ("number-missing", 1, "z")),
            ("GCP0,46.02,7.75,1\n,46.02,7.75,1\n", ("name-missing", 2, "label")),
            ("GCP0,46.02,7.75,1,-1\n", ("sigma-not-positive", 1, "sigma_h", "-1")),
            ("# only\n", ("no-rows", None, None)),
        ],
    )
    def test_refusals(self, tmp_path: Path, text: str, told: tuple[str, int | None, str | None]) -> None:
        check_refusal(read_point_table, write(tmp_path, text, "a.csv"), *told)
