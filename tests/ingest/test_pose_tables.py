"""Rows of a table of poses that do not count: left out, and said so with file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.ground_points import read_geo
from pipelines.formats.trajectory_csv import PoseTable, read_trajectory
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.table_poses import usable_rows
from tests.refusals import codes, refused, said


def _read(tmp_path: Path, name: str, text: str) -> PoseTable:
    (tmp_path / name).write_text(text)
    return (read_geo if name == "geo.txt" else read_trajectory)(tmp_path / name)


def test_unknown_columns_are_counted(tmp_path: Path) -> None:
    remarks = Remarks()
    usable_rows(_read(tmp_path, "t.csv", "\nimage,x,y,z,battery,\na,1,2,3,77,\n"), remarks)
    assert "(2): t.csv:2 (battery), t.csv:2 (unnamed)." in said(remarks.warnings, "unknown-column")


def test_times_without_zone_are_called_utc(tmp_path: Path) -> None:
    remarks = Remarks()
    usable_rows(_read(tmp_path, "t.csv", "time,x,y,z\n2023-11-14 22:13:20,1,2,3\n"), remarks)
    assert codes(remarks.assumptions) == ["time-zone"] and "t.csv" in remarks.assumptions[0].sentence


def test_rows_without_position_are_counted(tmp_path: Path) -> None:
    remarks = Remarks()
    table = usable_rows(_read(tmp_path, "t.csv", "image,x,y,z\na,1,2,3\nb,nan,2,3\nc,,,\nd,inf,1,2\n"), remarks)
    assert table.names == ("a",)
    assert "(3): t.csv:3, t.csv:4, t.csv:5." in said(remarks.warnings, "row-without-position")


def test_a_row_of_geo_txt_may_lack_its_height(tmp_path: Path) -> None:
    remarks = Remarks()
    rows = "EPSG:4326\na.jpg 7.75 46.02\nb.jpg nan 46.02 1620.5\nc.jpg 7.75 46.02 1620.5\n"
    table = usable_rows(_read(tmp_path, "geo.txt", rows), remarks)
    assert table.names == ("a.jpg", "c.jpg")
    assert table.lines.tolist() == [2, 4]
    assert np.isnan(table.xyz[0, 2])
    assert "(1): geo.txt:3." in said(remarks.warnings, "row-without-position")


def test_repeated_times_are_counted(tmp_path: Path) -> None:
    remarks = Remarks()
    table = usable_rows(_read(tmp_path, "t.csv", "time,x,y,z\n5,1,2,3\n4,1,2,3\n5,9,9,9\n"), remarks)
    assert table.xyz.tolist() == [[1, 2, 3], [1, 2, 3]]
    assert "(1): t.csv:4." in said(remarks.warnings, "row-repeats-time")


@pytest.mark.parametrize(
    ("name", "text"),
    [("t.csv", "image,x,y,z\na,nan,nan,nan\n"), ("geo.txt", "EPSG:4326\na.jpg nan nan 3\n")],
)
def test_a_table_without_any_position_is_refused(tmp_path: Path, name: str, text: str) -> None:
    with refused("file-without-positions", InputError) as error:
        usable_rows(_read(tmp_path, name, text), Remarks())
    assert error.value.path == tmp_path / name
