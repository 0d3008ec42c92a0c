"""CSV as people, loggers and spreadsheets write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.trajectory_csv import PoseTable, read_trajectory
from pipelines.geometry.rotations import geo_from_cam, matrix_from_quat_xyzw
from tests.refusals import refused


def _read(tmp_path: Path, text: str | bytes) -> PoseTable:
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_trajectory(path)


PLAIN = "image,latitude,longitude,altitude\na.jpg,46.02,7.75,1620.5\nb.jpg,46.03,7.76,1621.5\n"
EXPECTED = [[7.75, 46.02, 1620.5], [7.76, 46.03, 1621.5]]


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        "\ufeff" + PLAIN,
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace("\n", "\r"),
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", "\t"),
        PLAIN.replace(",", ";").replace(".5", ",5").replace("6.0", "6,0").replace("7.7", "7,7"),
        "# " + PLAIN + "# a comment\n\n",
        PLAIN.replace("image,latitude,longitude,altitude", 'Filename, LAT ,"lon",Height'),
    ],
    ids=["plain", "BOM", "CRLF", "CR", "semicolon", "tab", "decimal comma", "comments", "aliases"],
)
def test_ways_to_write_the_same(tmp_path: Path, text: str) -> None:
    table = _read(tmp_path, text)
    assert table.names == ("a.jpg", "b.jpg")
    assert table.lines.tolist() == [2, 3]
    assert table.geographic
    np.testing.assert_array_equal(table.xyz, EXPECTED)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_unicode_text_of_a_spreadsheet(tmp_path: Path, encoding: str) -> None:
    """With a byte order mark the encoding is known; without one the file is refused (see below)."""
    mark = "" if encoding == "utf-16" else "\ufeff"
    table = _read(tmp_path, (mark + PLAIN.replace(",", "\t")).encode(encoding))
    np.testing.assert_array_equal(table.xyz, EXPECTED)


NOON_S = 1714564800.0  # 2024-05-01 12:00:00 UTC


@pytest.mark.parametrize(
    ("header", "cells", "seconds", "zoneless"),
    [
        ("time", "2024-05-01T12:00:00.25Z", 0.25, False),
        ("time", "2024/05/01 12:00:00.25", 0.25, True),
        ("datetime", "2024:05:01 12:00:00", 0.0, True),  # as EXIF writes it
        ("date,time", "2024-05-01,12:00:00.25", 0.25, True),
        ("Date,UTC Time", "2024/05/01,12:00:00.25Z", 0.25, False),
        ("date,time", "31.05.2024,9:00:01", 30 * 86400.0 - 3 * 3600.0 + 1.0, True),
        ("date,time", "05/31/2024,12:00:00", 30 * 86400.0, True),
        ("date,time", "20240501,14:00:00+02:00", 0.0, False),
        ("gps_week,tow", "2312,302418.5", 0.5, False),  # GPS time is 18 s ahead
        ("GPS Week,Time of Week [s]", "2312,302418.5", 0.5, False),
        ("week,time", "2312,302418.5", 0.5, False),
    ],
)
def test_ways_to_write_a_time(tmp_path: Path, header: str, cells: str, seconds: float, zoneless: bool) -> None:
    table = _read(tmp_path, f"{header},latitude,longitude,altitude\n{cells},46.02,7.75,620\n")
    assert table.time_s is not None
    assert table.time_s[0] == pytest.approx(NOON_S + seconds, abs=1e-6)
    assert table.zoneless_times == zoneless


@pytest.mark.parametrize(
    ("header", "cells", "code", "field"),
    [
        ("time", "12:00:00", "time-without-date", "timestamp"),
        ("date,time", "05/06/2024,12:00:00", "date-ambiguous", "date"),
        ("date,time", "31/31/2024,12:00:00", "date-invalid", "date"),
        ("date,time", "2024-13-01,12:00:00", "date-invalid", "date"),
        ("date,time", "1 May,12:00:00", "date-invalid", "date"),
        ("week,tow", "264,302418.5", "value-out-of-range", "week"),  # counted from 2019 on, or from 1999?
        ("week,tow", "2312,302418500", "value-out-of-range", "tow"),  # milliseconds
        ("time", "1714564800000", "time-unit", "timestamp"),
    ],
)
def test_times_that_are_not_known(tmp_path: Path, header: str, cells: str, code: str, field: str) -> None:
    with refused(code) as error:
        _read(tmp_path, f"{header},latitude,longitude,altitude\n{cells},46.02,7.75,620\n")
    assert (error.value.line, error.value.field) == (2, field)


def test_one_date_tells_the_order_of_all(tmp_path: Path) -> None:
    rows = "05/06/2024,12:00:00,46.02,7.75,620\n14/06/2024,12:00:00,46.02,7.75,620\n"
    table = _read(tmp_path, "date,time,latitude,longitude,altitude\n" + rows)
    assert table.time_s is not None
    assert table.time_s[1] - table.time_s[0] == 9 * 86400.0


def test_all_columns(tmp_path: Path) -> None:
    table = _read(
        tmp_path,
        "timestamp,x,y,z,yaw,pitch,roll,sigma_e,sigma_n,sigma_u,battery\n"
        "1700000000.5,500000,5100000,1600,10,-90,0,0.02,0.03,0.04,77\n"
        "2023-11-14T22:13:21.5Z,500001,5100000,1600,,,,,,,76\n",
    )
    assert table.names is None and not table.geographic
    assert table.time_s is not None and table.quat_xyzw is not None and table.sigma_enu_m is not None
    np.testing.assert_allclose(table.time_s, [1700000000.5, 1700000001.5], rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        matrix_from_quat_xyzw(table.quat_xyzw[0]), geo_from_cam([10.0, -90.0, 0.0]), rtol=0, atol=1e-14
    )
    assert table.sigma_enu_m[0].tolist() == [0.02, 0.03, 0.04]
    assert np.isnan(table.quat_xyzw[1]).all() and np.isnan(table.sigma_enu_m[1]).all()
    assert (table.unknown_columns, table.header_line) == (("battery",), 1)
    assert not table.zoneless_times


def test_quaternion_turns_the_camera_into_east_north_up(tmp_path: Path) -> None:
    # Half a turn about x: the camera's z axis looks down, its y axis south.
    table = _read(tmp_path, "image,x,y,z,qx,qy,qz,qw\na.jpg,0,0,0,1,0,0,0\n")
    assert table.quat_xyzw is not None
    np.testing.assert_allclose(matrix_from_quat_xyzw(table.quat_xyzw[0]) @ [0, 0, 1], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(matrix_from_quat_xyzw(table.quat_xyzw[0]) @ [0, 1, 0], [0, -1, 0], atol=1e-15)


def test_a_time_without_zone_is_read_as_utc_and_marked(tmp_path: Path) -> None:
    table = _read(tmp_path, "time,x,y,z\n2023-11-14 22:13:20,1,2,3\n")
    assert table.time_s is not None and table.time_s[0] == 1700000000.0
    assert table.zoneless_times


def test_rows_without_position_and_repeated_times_stay(tmp_path: Path) -> None:
    table = _read(tmp_path, "image,x,y,z\na,1,2,3\nb,nan,2,3\nc,,,\nd,inf,1,2\n")
    assert table.names == ("a", "b", "c", "d")
    assert np.isfinite(table.xyz).all(axis=1).tolist() == [True, False, False, False]
    table = _read(tmp_path, "time,x,y,z\n5,1,2,3\n4,1,2,3\n5,9,9,9\n")
    assert table.time_s is not None and table.time_s.tolist() == [5, 4, 5]


@pytest.mark.parametrize(
    ("text", "code", "line", "field", "words"),
    [
        ("", "file-empty", None, None, ""),
        ("image,x,y,z\n", "no-rows", None, None, ""),
        ("a.jpg,46.0,7.0,1620\n", "header-missing", 1, None, ""),
        ("image\na.jpg\n", "one-column", 1, None, ""),
        ("image,speed\na,1\n", "column-missing", 1, None, "latitude,longitude,altitude or x,y,z"),
        ("x,y,z\n1,2,3\n", "column-missing", 1, None, "timestamp"),
        ("image,x,y\na,1,2\n", "column-missing", 1, None, "column z"),
        ("image,x,y,z,lat,lon,alt\na,1,2,3,4,5,6\n", "columns-ambiguous", 1, None, "altitude and x,y,z"),
        ("image,x,y,z,X\na,1,2,3,4\n", "column-twice", 1, None, "x: x, X"),
        ("image,x,y,z,yaw\na,1,2,3,4\n", "column-missing", 1, None, "column pitch, roll"),
        (
            "image,x,y,z,yaw,pitch,roll,qx,qy,qz,qw\na,1,2,3,1,1,1,0,0,0,1\n",
            *("columns-ambiguous", 1, None, "yaw,pitch,roll and qx"),
        ),
        ("image,x,y,z\na,1,two,3\n", "not-a-number", 2, "y", "'two'"),
        ("image,x,y,z\na,1,1_000,3\n", "not-a-number", 2, "y", "'1_000'"),
        ("image,lat,lon,alt\na,46,02,7,75,1620\n", "wrong-columns", 2, None, "6 cells, the header has 4; decimal"),
        ("image,lat,lon,alt\na,46.0,7.0,1\nb,96.0,7.0,1\n", "value-out-of-range", 3, "latitude", "-90 … 90"),
        ("image,lat,lon,alt\na,46.0,700.0,1\n", "value-out-of-range", 2, "longitude", "700"),
        (
            "image,x,y,z,sigma_e,sigma_n,sigma_u\na,1,2,3,0.1,0,0.1\n",
            *("value-out-of-range", 2, "sigma_n", "0 "),
        ),
        ("image,x,y,z,yaw,pitch,roll\na,1,2,3,0,-270,0\n", "value-out-of-range", 2, "pitch", "-270"),
        ("image,x,y,z,qx,qy,qz,qw\na,1,2,3,1,1,0,0\n", "quaternion-length", 2, "qx,qy,qz,qw", "1.41"),
        ("time,x,y,z\n1700000000000,1,2,3\n", "time-unit", 2, "timestamp", "1700000000000"),
        ("time,x,y,z\n2023-13-45T00:00:00,1,2,3\n", "time-invalid", 2, "timestamp", "2023-13-45"),
        (b"image,x,y,z\na\xff,1,2,3\n", "not-utf8", 2, None, ""),
        ("image,x,y,z\na,1,2,3\n".encode("utf-16-le"), "not-text", None, None, ""),
    ],
)
def test_refusals_name_file_line_and_column(
    tmp_path: Path, text: str | bytes, code: str, line: int | None, field: str | None, words: str
) -> None:
    with refused(code, InputError) as error:
        _read(tmp_path, text)
    assert (error.value.path, error.value.line, error.value.field) == (tmp_path / "t.csv", line, field)
    assert words in error.value.message


def test_absent_file(tmp_path: Path) -> None:
    with refused("file-unreadable", InputError) as error:
        read_trajectory(tmp_path / "absent.csv")
    assert error.value.path == tmp_path / "absent.csv" and "No such file" in error.value.message
