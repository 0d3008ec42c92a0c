"""Tags in photographs as marks: against the truth of a simulated survey, and beside marks made by hand."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.formats.fiducials import tag_modules
from pipelines.ingest.options import IngestOptions, check_options
from pipelines.ingest.stage import survey_and_track
from pipelines.ingest.targets import numbers_of_points
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import fly_survey, simulate
from pipelines.simulate.truth import Truth
from pipelines.survey.survey import Survey
from tests.refusals import codes, refused, said

APRIL = "DICT_APRILTAG_36h11"
_ACROSS = np.stack(np.meshgrid(*[np.linspace(-1.2, 1.2, 25)] * 2), axis=-1).reshape(-1, 2)  # of a board


@dataclass(frozen=True)
class TrueTag:
    """A tag that a photograph shows: its point, exact centre (2,), shortest side and whether all of it is seen."""

    point: str
    image: str
    center_px: np.ndarray
    side_px: float
    whole: bool


def true_tags(options: SimulateOptions, truth: Truth) -> list[TrueTag]:
    """Return the tags in the photographs of a simulated survey; visible is what no ray of a grid misses."""
    flight = fly_survey(options)
    lens, raycaster = flight.world.lens, flight.renderer.raycaster
    tags = []
    for target in truth.targets:
        corners, middle = np.array(target.corners_in_geo), np.array(target.position_in_geo)
        right, up = (corners[1] - corners[0]) / 2, (corners[0] - corners[3]) / 2
        board = middle + _ACROSS @ np.stack([right, up])
        for name, pose in zip(truth.images, flight.world.poses, strict=True):
            seen = np.vstack([corners, middle[None], board])
            towards = seen - pose.center
            if (towards @ pose.geo_from_cam)[:, 2].min() < 1 or np.dot(np.cross(right, up), towards[4]) > 0:
                continue
            pixels = lens.project(towards @ pose.geo_from_cam)
            distance = np.linalg.norm(towards, axis=1)
            hits = raycaster.first_hits(pose.center, towards / distance[:, None])
            is_seen = np.abs(hits.distance - distance) < 0.02
            if not is_seen[4] or not np.isfinite(pixels).all():
                continue
            inside = ((pixels > 1) & (pixels < [lens.width - 1, lens.height - 1])).all(axis=1)
            side = float(np.linalg.norm(pixels[:4] - np.roll(pixels[:4], -1, axis=0), axis=1).min())
            tags.append(TrueTag(target.name, name, pixels[4], side, bool((is_seen & inside).all())))
    return tags


def _as_list(path: Path) -> Path:
    """Write the points of a `gcp_list.txt` without their marks, as a list, beside it."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = {cells[6]: f"{cells[6]} {' '.join(cells[:3])}" for cells in map(str.split, lines[1:])}
    listed = path.with_name(f"bare_{path.name}")
    listed.write_text("\n".join([lines[0], *rows.values()]) + "\n", encoding="utf-8")
    return listed


def _compared(folder: Path, **options: Any) -> tuple[float, int, float, float]:
    """Return the share of whole tags of 20 px that are found, their number, and RMS in pixels and in σ of all."""
    simulated = SimulateOptions(target_kind="apriltag", **options)
    simulate(simulated, folder / "survey")
    truth = load_json(Truth, folder / "survey/truth.json")
    tags = true_tags(simulated, truth)
    ingested = IngestOptions(
        images=folder / "survey/images", trajectory=folder / "survey/trajectory.csv", vertical="ellipsoidal",
        gcp=_as_list(folder / "survey/gcp_list.txt"), checkpoints=_as_list(folder / "survey/checkpoints.txt"),
        targets=APRIL,
    )  # fmt: skip
    survey, _ = survey_and_track(ingested, None, listing=folder)
    marks = {
        (point.name, mark.image): mark
        for point in (*survey.control_points, *survey.check_points, *survey.unmarked_points)
        for mark in point.marks
    }
    with (folder / "targets.csv").open(encoding="utf-8", newline="") as handle:
        assert sum(row["used"] == "yes" for row in csv.DictReader(handle)) == len(marks)
    assert (folder / "targets.html").stat().st_size > 1000 * len(marks) ** 0.5
    true = {(tag.point, tag.image): tag for tag in tags}
    assert marks.keys() <= true.keys()
    error = {key: np.array([mark.x_px, mark.y_px]) - true[key].center_px for key, mark in marks.items()}
    assert max(np.abs(value).max() for value in error.values()) < 1
    wanted = [key for key, tag in true.items() if tag.whole and tag.side_px >= 20]
    found = [key for key in wanted if key in marks]
    rms = np.sqrt(np.mean([error[key] ** 2 for key in marks]))
    ratio = np.sqrt(np.mean([(error[key] / marks[key].sigma_px) ** 2 for key in marks]))
    print(
        f"{len(found)} of {len(wanted)} whole tags of 20 px found, {len(marks)} of all {len(tags)}; "
        f"RMS {rms:.3f} px, {ratio:.2f} σ, worst {max(np.abs(value).max() for value in error.values()):.2f} px"
    )
    return len(found) / len(wanted), len(wanted), float(rms), float(ratio)


@pytest.mark.slow
def test_tags_of_a_small_survey_become_marks(tmp_path: Path) -> None:
    share, count, rms_px, ratio = _compared(
        tmp_path, images=4, size="640x480", samples="4", targets=16, target_size=6.0
    )
    assert count >= 12 and share >= 0.8 and rms_px < 0.1 and ratio < 1.4


SIDE = 64.0  # of a drawn tag in pixels


def _draw(folder: Path, tags: dict[int, tuple[float, float]], count: int = 3) -> Path:
    """Write photographs, in each of which tags stand one pixel further right, and return their folder."""
    folder.mkdir()
    for index in range(count):
        picture = np.full((300, 400), 120 + index, dtype=np.uint8)
        for number, (x, y) in tags.items():
            modules = np.pad(tag_modules(APRIL, number), 1, constant_values=1) * np.uint8(200) + np.uint8(20)
            board = cv2.resize(modules, (80, 80), interpolation=cv2.INTER_NEAREST)
            left, top = round(x + index - 40), round(y - 40)
            picture[top : top + 80, left : left + 80] = board
        cv2.imwrite(str(folder / f"{index}.png"), picture)
    return folder


def _ingested(folder: Path, points: str, **options: Any) -> Survey:
    (folder / "points.txt").write_text("EPSG:4979\n" + points, encoding="utf-8")
    chosen = {"images": folder / "photos", "gcp": folder / "points.txt", "targets": APRIL, **options}
    return survey_and_track(IngestOptions(**chosen), None, listing=folder / "out")[0]


LIST = "GCP12 7.75 46.02 16\n7 7.7501 46.02 16\nhouse 7.7502 46.02 16\n"
TAGS = {12: (100.0, 90.0), 7: (250.0, 180.0), 90: (330.0, 60.0)}


def test_tags_are_marks_of_the_points_with_their_numbers(tmp_path: Path) -> None:
    _draw(tmp_path / "photos", TAGS)
    survey = _ingested(tmp_path, LIST)
    assert [point.name for point in survey.control_points] == ["GCP12", "7"]
    assert [point.name for point in survey.unmarked_points] == ["house"]
    for point, number in zip(survey.control_points, (12, 7), strict=True):
        x, y = TAGS[number]
        place = [(mark.image, mark.x_px, mark.y_px) for mark in point.marks]
        assert place == [(f"{i}.png", pytest.approx(x + i, abs=0.02), pytest.approx(y, abs=0.02)) for i in range(3)]
        assert all(0.005 < mark.sigma_px < 0.1 for mark in point.marks)
    assert "6 marks of 2 points" in said(survey.assumptions, "marks-of-targets")
    assert "90 in 3 photographs" in said(survey.warnings, "target-of-no-point")
    assert "marks" not in survey.default_sigmas
    with (tmp_path / "out/targets.csv").open(encoding="utf-8", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert {(row["point"], row["number"], row["used"]) for row in rows} == {
        ("GCP12", "12", "yes"), ("7", "7", "yes"), ("", "90", "no point")
    }  # fmt: skip
    assert float(rows[0]["side_px"]) == pytest.approx(SIDE, abs=0.1)
    page = (tmp_path / "out/targets.html").read_text(encoding="utf-8")
    assert page.count("<figure") == 6 and "data:image/jpeg" in page


def test_marks_made_by_hand_stand(tmp_path: Path) -> None:
    _draw(tmp_path / "photos", TAGS)
    marks = "7.75 46.02 16 100.5 90.4 0.png GCP12\n7.75 46.02 16 105 90 1.png GCP12\n"
    survey = _ingested(tmp_path, marks + "7.7501 46.02 16 251 180 1.png 7\n")
    by_hand = survey.control_points[0].marks
    assert [(mark.image, mark.x_px, mark.sigma_px > 0.4) for mark in by_hand] == [
        ("0.png", 100.5, True), ("1.png", 105.0, True), ("2.png", pytest.approx(102, abs=0.02), False)
    ]  # fmt: skip
    assert "GCP12 in 1.png (4.0 px)" in said(survey.warnings, "target-not-where-marked")
    assert "(1)" in said(survey.warnings, "target-not-where-marked")
    assert "marks" in survey.default_sigmas


def test_tags_that_tell_no_point_are_not_used(tmp_path: Path) -> None:
    photos = _draw(tmp_path / "photos", {12: (100.0, 90.0)}, count=4)
    twice = cv2.imread(str(photos / "3.png"), cv2.IMREAD_GRAYSCALE)
    assert twice is not None
    twice[200:290, 200:290] = twice[45:135, 58:148]
    cv2.imwrite(str(photos / "3.png"), twice)
    survey = _ingested(tmp_path, LIST)
    assert [mark.image for mark in survey.control_points[0].marks] == ["0.png", "1.png", "2.png"]
    assert "12 in 3.png" in said(survey.warnings, "target-twice")
    survey = _ingested(tmp_path, "GCP12 7.75 46.02 16\n", targets="DICT_4X4_50", trajectory=_flight(tmp_path))
    assert "no-target-found" in codes(survey.warnings)


def _flight(folder: Path) -> Path:
    rows = "".join(f"{i}.png,46.02,7.75{i},120\n" for i in range(4))
    (folder / "flight.csv").write_text("image,latitude,longitude,altitude\n" + rows, encoding="utf-8")
    return folder / "flight.csv"


def test_tags_are_ends_of_scale_bars(tmp_path: Path) -> None:
    _draw(tmp_path / "photos", TAGS)
    (tmp_path / "bars.csv").write_text("from,to,distance\nbar90,GCP12,2.5\n", encoding="utf-8")
    survey = _ingested(tmp_path, LIST, distances=tmp_path / "bars.csv")
    assert [(end.name, len(end.marks)) for end in survey.distances[0].ends] == [("bar90", 3), ("GCP12", 3)]


def test_numbers_of_points_and_refusals(tmp_path: Path) -> None:
    assert numbers_of_points(["GCP12", "7", "house", "P1-003", "P999999"], [APRIL]) == {
        12: "GCP12",
        7: "7",
        3: "P1-003",
    }
    with refused("target-number-ambiguous", InputError) as error:
        numbers_of_points(["GCP7", "CHK07"], [APRIL])
    assert "CHK07 or point GCP7" in error.value.message
    numbers_of_points(["GCP9000", "CHK9000"], [APRIL])  # no tag has this number
    with refused("needs-ground-points", InputError):
        check_options(IngestOptions(images=tmp_path, targets=APRIL), None)
    with pytest.raises(ValueError, match="no dictionary of OpenCV's"):
        IngestOptions(images=tmp_path, targets="DICT_9X9")
    assert IngestOptions(targets="dict_4x4_50, DICT_4X4_50").targets == ("DICT_4X4_50",)


@pytest.mark.slow
def test_tags_of_a_survey_are_found_and_are_where_the_truth_has_them(tmp_path: Path) -> None:
    share, count, rms_px, ratio = _compared(tmp_path, images=14, size="1200x900", samples="4", targets=40)
    assert count >= 80 and share >= 0.95 and rms_px <= 0.15 and 0.7 <= ratio <= 1.4
