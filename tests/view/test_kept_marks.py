"""Marks are kept as they are set, by record: of several viewers, over restarts, and until the survey has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.ground_points import read_ground_points
from pipelines.view.marking import CHECK, CONTROL, MARKS, KeptMarks, MarkedPoint
from tests.refusals import refused

SURVEYED = (
    MarkedPoint("G1", (10.0, 45.0, 100.0), marks={"a.jpg": (1.0, 2.0), "b.jpg": (3.0, 4.0)}),
    MarkedPoint("C1", (10.001, 45.0, 101.0), is_check=True),
)


def swapped(points: np.ndarray) -> np.ndarray:
    """Longitude, latitude, height in this test's CRS, and latitude, longitude, height."""
    return points[:, [1, 0, 2]]


def kept(folder: Path, surveyed: tuple[MarkedPoint, ...] = SURVEYED) -> KeptMarks:
    return KeptMarks(folder, surveyed, swapped, swapped)


def marks(viewer: KeptMarks) -> dict[str, dict[str, tuple[float, float]]]:
    return {point.name: dict(point.marks) for point in viewer.points}


def test_marks_are_there_after_a_restart_before_they_are_written(tmp_path: Path) -> None:
    viewer = kept(tmp_path)
    assert viewer.is_written
    viewer.set_mark("C1", "a.jpg", (5.0, 6.0))
    viewer.set_mark("G1", "b.jpg", None)
    viewer.set_point("new", (10.002, 45.001, 99.5), is_check=False)
    viewer.set_mark("new", "b.jpg", (7.0, 8.0))
    again = kept(tmp_path)
    assert again.points == viewer.points
    assert marks(again) == {"G1": {"a.jpg": (1.0, 2.0)}, "C1": {"a.jpg": (5.0, 6.0)}, "new": {"b.jpg": (7.0, 8.0)}}
    assert not again.is_written
    assert again.write("EPSG:4326") == [tmp_path / CONTROL, tmp_path / CHECK]
    assert again.is_written and kept(tmp_path).is_written
    again.set_point("C1", None, is_check=False)
    assert next(point for point in again.points if point.name == "C1").xyz == SURVEYED[1].xyz


def test_two_viewers_write_the_marks_of_both(tmp_path: Path) -> None:
    one, two = kept(tmp_path), kept(tmp_path)
    one.set_mark("C1", "a.jpg", (5.0, 6.0))
    two.set_mark("G1", "a.jpg", None)
    one.write("EPSG:4326")
    two.set_mark("C1", "b.jpg", (7.0, 8.0))
    two.write("EPSG:4326")
    kept(tmp_path).write("EPSG:4326")  # a third one, started after all that
    control, check = (read_ground_points(tmp_path / name).marks for name in (CONTROL, CHECK))
    assert [(mark.name, mark.image) for mark in control] == [("G1", "b.jpg")]
    assert [(mark.name, mark.image, mark.x_px) for mark in check] == [("C1", "a.jpg", 5.0), ("C1", "b.jpg", 7.0)]


def test_a_viewer_sees_and_keeps_what_another_changes(tmp_path: Path) -> None:
    viewer, other = kept(tmp_path), kept(tmp_path)
    before = marks(viewer)
    viewer.set_point("new", None, is_check=True)
    viewer.set_mark("new", "a.jpg", (1.0, 1.0))
    other.set_mark("C1", "b.jpg", (2.0, 2.0))
    viewer.read()
    assert marks(viewer) == {**before, "C1": {"b.jpg": (2.0, 2.0)}, "new": {"a.jpg": (1.0, 1.0)}}
    viewer.remove_point("new")
    assert marks(kept(tmp_path)) == marks(viewer) == {**before, "C1": {"b.jpg": (2.0, 2.0)}}


def test_what_the_survey_has_taken_over_is_dropped(tmp_path: Path) -> None:
    viewer = kept(tmp_path)
    viewer.set_mark("C1", "a.jpg", (5.0, 6.0))
    viewer.set_mark("G1", "b.jpg", None)
    viewer.set_point("new", (10.002, 45.001, 99.5), is_check=False)
    viewer.set_mark("new", "b.jpg", (7.0, 8.0))
    ingested = tuple(viewer.points)
    assert kept(tmp_path, ingested).points == ingested
    kept(tmp_path, ingested).set_mark("G1", "c.jpg", (0.0, 0.0))
    moved = tuple(point.with_mark("a.jpg", (50.0, 60.0)) for point in ingested)
    later = marks(kept(tmp_path, moved))  # by a survey that was ingested again, with other marks
    assert later["C1"] == {"a.jpg": (50.0, 60.0)}
    assert later["G1"] == {"a.jpg": (50.0, 60.0), "c.jpg": (0.0, 0.0)}


def test_what_cannot_be_kept_is_refused(tmp_path: Path) -> None:
    viewer = kept(tmp_path)
    with refused("name-with-space", InputError):
        viewer.set_point("two words", None, is_check=False)
    with refused("point-of-survey", InputError):
        viewer.remove_point("G1")
    assert viewer.write("EPSG:4326") == [tmp_path / CONTROL]
    (tmp_path / MARKS).write_text('{"format_version": 1, "marks": [{"point": "G1"}]}', "utf-8")
    with pytest.raises(InputError, match=r"marks\.json"):
        viewer.set_mark("G1", "a.jpg", None)
    assert marks(viewer)["G1"] == SURVEYED[0].marks
