"""OpenDroneMap's two text files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.ground_points import read_geo, read_ground_points
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from tests.refusals import refused


def _write(tmp_path: Path, text: str, name: str = "geo.txt") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("crs", ["EPSG:4326", "+proj=utm +zone=16 +datum=WGS84 +units=m +no_defs", "WGS84 UTM 16N"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_geo_of_every_width(tmp_path: Path, crs: str, end: str) -> None:
    lines = [
        "\ufeff" + crs,
        "a.jpg 7.75 46.02",
        "# comment",
        "b.jpg\t7.75\t46.02\t1620.5",
        "c.jpg 7.75 46.02 1620.5 90 0 0",
        "d.jpg 7.75 46.02 1620.5 90 0 0 0.02 0.05",
        "e.jpg 7.75 46.02 1620.5 90 0 0 0.02 0.05 and more words",
        "f.jpg nan 46.02 1620.5",
    ]
    table = read_geo(_write(tmp_path, end.join(lines)))
    assert table.crs_text == crs
    assert table.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg", "f.jpg")
    assert table.lines.tolist() == [2, 4, 5, 6, 7, 8]
    assert np.isnan(table.xyz[0, 2]) and table.xyz[1].tolist() == [7.75, 46.02, 1620.5]
    assert table.sigma_enu_m is not None and table.sigma_enu_m[3].tolist() == [0.02, 0.02, 0.05]
    assert np.isnan(table.xyz[5, 0]) and table.xyz[5, 1:].tolist() == [46.02, 1620.5]


def test_pitch_zero_of_geo_txt_looks_straight_down(tmp_path: Path) -> None:
    table = read_geo(_write(tmp_path, "EPSG:4326\na.jpg 7 46 100 90 0 0\n"))
    assert table.quat_xyzw is not None
    rotation = matrix_from_quat_xyzw(table.quat_xyzw[0])
    np.testing.assert_allclose(rotation @ [0, 0, 1], [0, 0, -1], atol=1e-15)
    # Yaw 90: the top of the image (−y of the camera) points east.
    np.testing.assert_allclose(rotation @ [0, -1, 0], [1, 0, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "code", "line", "field", "words"),
    [
        ("", "file-empty", None, None, ""),
        ("EPSG:4326\n", "no-rows", None, None, ""),
        ("a.jpg 7.75 46.02 1620\nb.jpg 7.75 46.02 1620\n", "crs-missing", 1, None, ""),
        ("EPSG:4326\na.jpg 7.75\n", "wrong-columns", 2, None, "2 columns, expected 3, 4, 7 or 9"),
        (
            "EPSG:4326\na.jpg 7.75 46.02 1620 0.02 0.03\n",
            "wrong-columns",
            2,
            None,
            "6 columns, expected 3, 4, 7 or",
        ),
        ("EPSG:4326\na.jpg,7.75,46.02\n", "wrong-columns", 2, None, "separate columns by spaces"),
        ("EPSG:4326\na.jpg 7,75 46,02 3\n", "not-a-number", 2, "x", "write decimals with a point"),
        ("EPSG:4326\na.jpg 7 46 3 0 0 0 0 0.1\n", "sigma-not-positive", 2, "h_acc, v_acc", "0 and 0.1 m"),
    ],
)
def test_geo_refusals(
    tmp_path: Path, text: str, code: str, line: int | None, field: str | None, words: str
) -> None:
    path = _write(tmp_path, text)
    with refused(code, InputError) as error:
        read_geo(path)
    assert (error.value.path, error.value.line, error.value.field) == (path, line, field)
    assert words in error.value.message


def test_ground_points_with_and_without_names(tmp_path: Path) -> None:
    text = (
        "\ufeffWGS84 UTM 16N\r\n"
        "500000 4000000 10 100.5 200.25 a.jpg G1 extra words\r\n"
        "500000 4000000 10 110.5 210.25 b.jpg G1\r\n"
        "500010.5\t4000000\t10\t1\t2\ta.jpg\r\n"
        "500010.5 4000000 10 3 4 b.jpg\r\n"
        "500020 4000000 10 5 6 b.jpg\r\n"
    )
    found = read_ground_points(_write(tmp_path, text, "gcp_list.txt"))
    assert found.crs_text == "WGS84 UTM 16N"
    assert [mark.name for mark in found.marks] == ["G1", "G1", "point-1", "point-1", "point-2"]
    assert [point.name for point in found.points] == ["G1", "point-1", "point-2"]
    assert found.points[1].xyz == (500010.5, 4000000.0, 10.0)
    assert (found.marks[0].x_px, found.marks[0].y_px, found.marks[0].image) == (100.5, 200.25, "a.jpg")
    assert [mark.line for mark in found.marks] == [2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("text", "code", "line", "field", "words"),
    [
        ("7.75 46.02 1620 100 200 a.jpg G1\n", "crs-missing", 1, None, ""),
        ("EPSG:4326\n7.75 46.02 1620 100 200\n", "wrong-columns", 2, None, "5 columns, expected at least 6"),
        ("EPSG:4326\n7.75,46.02,1620,100,200,a.jpg\n", "wrong-columns", 2, None, "separate columns by spaces"),
        ("EPSG:4326\n7.75 46.02 nan 100 200 a.jpg G1\n", "number-missing", 2, "z", ""),
        ("EPSG:4326\n7,75 46,02 1620 100 200 a.jpg G1\n", "not-a-number", 2, "x", "'7,75'"),
        ("EPSG:4326\n", "no-rows", None, None, ""),
    ],
)
def test_ground_point_refusals(
    tmp_path: Path, text: str, code: str, line: int | None, field: str | None, words: str
) -> None:
    path = _write(tmp_path, text, "gcp_list.txt")
    with refused(code, InputError) as error:
        read_ground_points(path)
    assert (error.value.path, error.value.line, error.value.field) == (path, line, field)
    assert words in error.value.message
