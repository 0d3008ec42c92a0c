"""Rows of a table that name images, in every way to name them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.table_poses import match_by_name


def _named(names: tuple[str, ...]) -> PoseTable:
    lines = np.arange(2, 2 + len(names))
    return PoseTable(Path("t.csv"), "csv", lines, names, None, np.zeros((len(names), 3)), False)


def test_match_by_name_tells_what_did_not_fit() -> None:
    remarks = Remarks()
    rows = match_by_name(_named(("b.jpg", "A.JPG", "zzz.jpg", "c")), ["a.jpg", "b.jpg", "c.jpg"], remarks)
    assert rows.names == ("b.jpg", "a.jpg", "c.jpg")
    assert rows.lines.tolist() == [2, 3, 5]
    assert remarks.warnings == [
        "1 row names no image here: t.csv:4 (zzz.jpg)",
        "2 rows name their images with another case or without suffix: "
        "t.csv:3 (A.JPG for a.jpg), t.csv:5 (c for c.jpg)",
    ]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a.jpg", "b.jpg", "a.jpg"), r"t\.csv:4 \[image\]: a\.jpg has a row already, in line 2"),
        (("x.jpg", "y.jpg"), r"names none of the images: it has 'x\.jpg' …, the folder 'a\.jpg' …"),
        (("../a.jpg",), r"t\.csv:2 \[image\]: .*leaves the image folder"),
    ],
)
def test_match_by_name_refuses(names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        match_by_name(_named(names), ["a.jpg", "b.jpg"], Remarks())
