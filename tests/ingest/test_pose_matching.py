"""Rows of a table that name images, in every way to name them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.table_poses import match_by_name
from tests.refusals import codes, refused


def _named(names: tuple[str, ...]) -> PoseTable:
    lines = np.arange(2, 2 + len(names))
    return PoseTable(Path("t.csv"), "csv", lines, names, None, np.zeros((len(names), 3)), False)


def test_match_by_name_tells_what_did_not_fit() -> None:
    remarks = Remarks()
    rows = match_by_name(_named(("b.jpg", "A.JPG", "zzz.jpg", "c")), ["a.jpg", "b.jpg", "c.jpg"], remarks)
    assert rows.names == ("b.jpg", "a.jpg", "c.jpg")
    assert rows.lines.tolist() == [2, 3, 5]
    assert codes(remarks.warnings) == ["row-of-unknown-image", "image-name-differs"]
    assert "(1): t.csv:4 (zzz.jpg)" in remarks.warnings[0].sentence
    assert "(2): t.csv:3 (A.JPG for a.jpg), t.csv:5 (c for c.jpg)" in remarks.warnings[1].sentence


@pytest.mark.parametrize(
    ("names", "code", "says"),
    [
        (("a.jpg", "b.jpg", "a.jpg"), "image-twice", r"t\.csv:4 \[image\]: a\.jpg .*line 2"),
        (("x.jpg", "y.jpg"), "no-image-matched", r"'x\.jpg' ….* 'a\.jpg' …"),
        (("../a.jpg",), "image-outside-folder", r"t\.csv:2 \[image\]: "),
    ],
)
def test_match_by_name_refuses(names: tuple[str, ...], code: str, says: str) -> None:
    with refused(code, InputError) as error:
        match_by_name(_named(names), ["a.jpg", "b.jpg"], Remarks())
    assert re.search(says, str(error.value))
