"""Interpolation in time against a motion that is known at every moment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.pose_table import PoseTable
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.ingest.notes import Notes
from pipelines.ingest.pose_matching import interpolate, match_by_name

RATE_RAD_S = 0.7
AXIS = np.array([1.0, 2.0, -2.0]) / 3.0


def _attitude(time_s: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(RATE_RAD_S * time_s[:, None] * AXIS).as_quat())


def _table(time_s: FloatArray) -> PoseTable:
    """Constant velocity and a constant rate of turn: linear and slerp interpolation are exact."""
    return PoseTable(
        path=Path("t.csv"),
        source="csv",
        lines=np.arange(2, 2 + len(time_s)),
        names=None,
        time_s=time_s,
        xyz=time_s[:, None] * [1.0, -2.0, 0.5] + 6e6,
        geographic=False,
        quat_xyzw=_attitude(time_s) * np.where(np.arange(len(time_s)) % 2, -1.0, 1.0)[:, None],
        sigma_enu_m=0.1 + 0.01 * np.stack([time_s] * 3, axis=-1),
    )


def test_between_rows_the_motion_is_met_exactly() -> None:
    clock = np.array([0.0, 0.8, 1.1, 2.0, 2.4])
    asked = np.array([0.3, 0.8, 1.0, 2.39, 0.0, 2.4])
    rows, found = interpolate(_table(clock[[3, 0, 4, 1, 2]]), asked, max_gap_s=1.0)
    assert found.all()
    np.testing.assert_allclose(rows.xyz, asked[:, None] * [1.0, -2.0, 0.5] + 6e6, rtol=0, atol=1e-8)
    assert rows.quat_xyzw is not None and rows.sigma_enu_m is not None
    np.testing.assert_allclose(
        matrix_from_quat_xyzw(rows.quat_xyzw), matrix_from_quat_xyzw(_attitude(asked)), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(rows.sigma_enu_m[:, 0], 0.1 + 0.01 * asked, atol=1e-12)


def test_nothing_outside_and_nothing_over_gaps() -> None:
    clock = np.array([0.0, 0.5, 3.0, 3.4])
    asked = np.array([-0.2, 0.25, 1.7, 3.0, 3.0005, 3.9, np.nan])
    rows, found = interpolate(_table(clock), asked, max_gap_s=1.0)
    assert found.tolist() == [False, True, False, True, True, False, False]
    assert len(rows) == 3


def test_rows_without_attitude_give_none() -> None:
    table = _table(np.array([0.0, 0.5, 1.0]))
    assert table.quat_xyzw is not None
    table.quat_xyzw[2] = np.nan
    rows, _ = interpolate(table, np.array([0.25, 0.75]), max_gap_s=1.0)
    assert rows.quat_xyzw is not None
    assert np.isfinite(rows.quat_xyzw).all(axis=1).tolist() == [True, False]


def test_a_single_row_serves_its_own_moment() -> None:
    _, found = interpolate(_table(np.array([5.0])), np.array([5.0004, 5.5]), max_gap_s=10.0)
    assert found.tolist() == [True, False]


def _named(names: tuple[str, ...]) -> PoseTable:
    table = _table(np.arange(float(len(names))))
    return PoseTable(table.path, "csv", table.lines, names, None, table.xyz, False)


def test_match_by_name_tells_what_did_not_fit() -> None:
    notes = Notes()
    rows = match_by_name(_named(("b.jpg", "A.JPG", "zzz.jpg", "c")), ["a.jpg", "b.jpg", "c.jpg"], notes)
    assert rows.names == ("b.jpg", "a.jpg", "c.jpg")
    assert rows.lines.tolist() == [2, 3, 5]
    assert notes.warnings == [
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
        match_by_name(_named(names), ["a.jpg", "b.jpg"], Notes())
