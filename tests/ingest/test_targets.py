"""Coded targets: tags of a simulated flight against their true places, and whose marks they become."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Pinhole
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.ingest.targets import LISTING, SHEET
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import RecordedFlight, fly_survey, simulate
from pipelines.simulate.truth import TrueTarget
from pipelines.survey.survey import Survey
from tests.refusals import codes, refused

TAGS = "DICT_APRILTAG_36h11"
FLIGHT = SimulateOptions(
    images=12,
    size="640x480",
    target_kind="apriltag",
    targets=60,
    target_size=4.5,
    sigma_survey=0.01,
    sigma_mark=0.2,
    seed=3,
)
BOARD = 1.2  # of a tag with most of its white margin, by the tag


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[RecordedFlight, Path]:
    """A flight over tags, with the points of its lists apart from their marks."""
    folder = tmp_path_factory.mktemp("tags") / "survey"
    simulate(FLIGHT, folder)
    points = {}
    for name in ("gcp_list.txt", "checkpoints.txt"):
        for line in (folder / name).read_text("utf-8").splitlines()[1:]:
            x, y, z, *_, point = line.split()
            points[point] = f"{point},{x},{y},{z}\n"
    (folder / "points.csv").write_text("label,longitude,latitude,z\n" + "".join(points.values()), "utf-8")
    return fly_survey(FLIGHT), folder


def surveyed(folder: Path, listing: Path | None = None, **options: Any) -> Survey:
    asked = {
        "images": folder / "images",
        "trajectory": folder / "trajectory.csv",
        "vertical": "ellipsoidal",
        "gcp": folder / "points.csv",
        "gcp_crs": "EPSG:4979",
        "targets": TAGS,
        "test_every": 0,
    }
    return survey_and_track(IngestOptions.model_validate({**asked, **options}), None, listing=listing)[0]


def seen_whole(flight: RecordedFlight, target: TrueTarget, image: int) -> bool:
    """Return whether a photograph shows all of a board, at 20 px a tag or more."""
    truth = flight.recording.truth
    center, rotation = np.array(truth.centers[image]), np.array(truth.cam_from_enu[image])
    corners = np.array(target.corners_in_geo)
    middle = corners.mean(axis=0)
    pinhole = Pinhole(truth.lens.width, truth.lens.height, *truth.lens.params[:4])
    shown = pinhole.project((corners - center) @ rotation.T)
    if np.linalg.norm(shown - np.roll(shown, 1, axis=0), axis=1).min() < 20:
        return False
    across = np.linspace(-1, 1, 9)
    half = BOARD / 2 * np.stack([corners[1] - corners[0], corners[3] - corners[0]])
    places = middle + np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2) @ half
    at = pinhole.project((places - center) @ rotation.T)
    rays = places - center
    hits = flight.renderer.raycaster.first_hits(center, rays)
    free = np.abs(hits.distance - 1) * np.linalg.norm(rays, axis=1) < 0.05
    inside = (at > 4) & (at < [truth.lens.width - 4, truth.lens.height - 4])
    others = [np.mean(other.corners_in_geo, axis=0) for other in truth.targets if other is not target]
    apart = np.linalg.norm(np.array(others) - middle, axis=1).min() > 1.5 * BOARD * truth_width(target)
    return bool(free.all() and inside.all() and apart)


def truth_width(target: TrueTarget) -> float:
    corners = np.array(target.corners_in_geo)
    return float(np.linalg.norm(corners[1] - corners[0]))


def test_tags_of_a_flight_mark_their_points(flown: tuple[RecordedFlight, Path], tmp_path: Path) -> None:
    flight, folder = flown
    survey = surveyed(folder, tmp_path)
    marks = {(point.name, mark.image): mark for point in survey.control_points for mark in point.marks}
    names = sorted(path.name for path in (folder / "images").iterdir())
    true = {
        (target.name, mark.image): np.array([mark.x_px, mark.y_px])
        for target in flight.recording.truth.targets
        for mark in target.marks
    }
    of_name = {target.name: target for target in flight.recording.truth.targets}
    whole = [key for key in true if seen_whole(flight, of_name[key[0]], names.index(key[1]))]
    listed = list(csv.DictReader((tmp_path / LISTING).open(encoding="utf-8")))
    found = {(row["point"], row["image"]) for row in listed if row["outcome"] == "used"}
    assert len(whole) > 30 and np.mean([key in found for key in whole]) >= 0.95
    assert marks.keys() <= found <= true.keys()  # none wrong; a point with a single mark is none of the survey's
    error = np.array([[mark.x_px, mark.y_px] - true[key] for key, mark in marks.items()])
    sigma = np.array([mark.sigma_px for mark in marks.values()])
    assert np.sqrt(np.mean(error**2)) <= 0.15
    # Of what scatters about its side as the model of σ has it; a shadow's edge across a tag is beyond it.
    assert 0.5 < np.median(np.abs(error)) / np.median(sigma) / 0.6745 < 1.6
    sheet = cv2.imread(str(tmp_path / SHEET))
    assert sheet is not None and sheet.shape[0] >= len(listed) // 12 * 100


def test_marks_by_hand_stay(flown: tuple[RecordedFlight, Path], tmp_path: Path) -> None:
    _, folder = flown
    found = surveyed(folder)
    point = max(found.control_points, key=lambda each: len(each.marks))
    first, second = point.marks[:2]
    by_hand = tmp_path / "marks.csv"
    by_hand.write_text(
        f"image,label,x,y\n{first.image},{point.name},{first.x_px + 5},{first.y_px}\n"
        f"{second.image},{point.name},{second.x_px + 0.2},{second.y_px}\n",
        "utf-8",
    )
    survey = surveyed(folder, marks=by_hand, sigma_mark=0.3)
    (again,) = [each for each in survey.control_points if each.name == point.name]
    kept = {mark.image: mark for mark in again.marks}
    assert len(kept) == len(point.marks)
    assert kept[first.image].x_px == pytest.approx(first.x_px + 5, abs=1e-3)
    assert kept[second.image].sigma_px == 0.3
    (warning,) = [each.sentence for each in survey.warnings if each.code == "target-off-mark"]
    assert f"{point.name} in {first.image} (5.0 px)" in warning and second.image not in warning


def test_numbers_that_fit_nobody_or_two(flown: tuple[RecordedFlight, Path], tmp_path: Path) -> None:
    _, folder = flown
    head, *rows = (folder / "points.csv").read_text("utf-8").splitlines()
    points = tmp_path / "points.csv"
    number = rows[0].partition(",")[0][1:]
    twin = f"T-{int(number)}," + rows[1].partition(",")[2]
    unnumbered = [f"{name},{row.partition(',')[2]}" for name, row in zip("ab", rows, strict=False)]
    for listed, code in (([*rows, twin], "target-number-twice"), (unnumbered, "no-numbered-point")):
        points.write_text("\n".join([head, *listed]) + "\n", "utf-8")
        with refused(code, InputError):
            surveyed(folder, gcp=points)
    with refused("unknown-dictionary", InputError):
        surveyed(folder, targets="DICT_OF_MINE")
    points.write_text("\n".join([head, *rows[:4]]) + "\n", "utf-8")
    few = surveyed(folder, gcp=points)
    assert "target-of-no-point" in codes(few.warnings)
