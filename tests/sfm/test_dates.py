"""Points in common with an earlier date: from the features of both databases to the tracks that they tie.

The features of a point look the same at both dates, but for noise, unless the ground there has changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.adjust.posterior import save_posterior
from pipelines.core.errors import DegenerateGeometryError, InputError, MissingProductError
from pipelines.core.fingerprints import fingerprints
from pipelines.core.products import load_json, save_json
from pipelines.core.progress import SILENT
from pipelines.core.stages import ADJUSTMENT, BY_NAME, MODEL, SIM3_POSTERIOR
from pipelines.formats.colmap import quiet_colmap, reconstruction_of
from pipelines.geodesy.enu import Origin
from pipelines.sfm.colmap_database import write_frame
from pipelines.sfm.dates import DATABASE, SolvedDate, pairs_across, tie_to_earlier
from pipelines.sfm.features import SfmJob
from pipelines.sfm.learned_features import LearnedFeatures
from pipelines.sfm.options import SfmOptions
from pipelines.survey.common_points import CommonPoints, solution_hash
from pipelines.survey.solution import Solution, TrainedModel
from pipelines.survey.survey import Survey, SurveyImage
from tests.change_pairs import nudge_first_camera
from tests.refusals import refused
from tests.scenes import write_workspace
from tests.trained_workspaces import trained_workspace
from tests.two_dates import ASIDE, HERE, IMAGES, POINTS, Date, draw_date, ground

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = SfmOptions(threads=1)
NOISE = 70  # of descriptors of 0 to 60: the same point is hardly nearer than others
LOOKS = np.random.default_rng(11).integers(0, 60, (POINTS, 128))


@pytest.fixture(autouse=True)
def _coarse_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.adjust.accuracy_grid._CELLS", 6)


def write_features(
    date: Date, path: Path, looks: np.ndarray, seed: int, *, noise: int = 4, of_sift: int = POINTS
) -> None:
    """Write a database with a feature for every observation, in the order of the model's.

    Descriptors are those of `looks` and a `noise`; only the first points, `of_sift`, have any.
    """
    model, rng = date.model, np.random.default_rng(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    with quiet_colmap() as colmap:
        write_frame(colmap, path, date.survey, range(IMAGES), OPTIONS)
        with colmap.Database.open(path) as database:
            for image in range(IMAGES):
                rows = np.flatnonzero(model.obs_image == image)
                shape = np.tile([1.0, 0.0, 0.0, 1.0], (len(rows), 1))
                keypoints = np.column_stack([model.obs_xy_px[rows], shape]).astype(np.float32)
                database.write_keypoints(image + 1, keypoints)
                rows = rows[model.obs_point[rows] < of_sift]
                seen = looks[model.obs_point[rows]] + rng.integers(0, noise, (len(rows), 128))
                data = np.clip(seen, 0, 255).astype(np.uint8)
                kind = colmap.FeatureExtractorType.SIFT
                database.write_descriptors(image + 1, colmap.FeatureDescriptors(kind, data))


def earlier_workspace(root: Path, origin: Origin = HERE, **features: int) -> Date:
    date = draw_date(0, np.random.default_rng(0), origin=origin)
    workspace = write_workspace(root, date.survey, date.model)
    save_json(date.posterior.solution, root / ADJUSTMENT)
    save_posterior(date.posterior, root / SIM3_POSTERIOR)
    write_features(date, workspace.root / DATABASE, LOOKS, 1, **features)
    return date


def tied(root: Path, later: Date, looks: np.ndarray = LOOKS, **features: int) -> CommonPoints:
    """Tie a later date to the workspace `spring`."""
    job = SfmJob(later.survey, root, root / "autumn" / DATABASE, OPTIONS)
    write_features(later, job.database, looks, 2, **features)
    with quiet_colmap() as colmap:
        found = tie_to_earlier(
            colmap, job, reconstruction_of(later.model), SolvedDate.load(root / "spring", later.survey), SILENT
        )
    assert sorted(path.name for path in job.database.parent.iterdir()) == ["database.db"]
    return found


@pytest.mark.parametrize("origin", [HERE, ASIDE])
def test_tracks_that_look_alike_tie_the_dates(tmp_path: Path, origin: Origin) -> None:
    earlier = earlier_workspace(tmp_path / "spring", origin)
    before = {path: path.read_bytes() for path in (tmp_path / "spring").rglob("*") if path.is_file()}
    found = tied(tmp_path, draw_date(1, np.random.default_rng(1)))
    np.testing.assert_array_equal(found.point_id, found.earlier_point_id)  # ids are those of one ground
    assert len(found) > 0.8 * POINTS
    assert float(found.spread) > 0.9
    assert found.name == "spring"
    # The earlier date lies where its receiver has put it, and the points with it: to half a pixel of 7 cm.
    place = earlier.seen(ground()[found.point_id - 1])
    assert np.sqrt(((place - found.position_in_ecef) ** 2).mean()) < 0.03
    sigma = np.sqrt(np.trace(found.cov_in_ecef, axis1=1, axis2=2) / 3)
    assert 0.005 < np.median(sigma) < 0.03
    assert {path: path.read_bytes() for path in before} == before


def test_changed_ground_ties_nothing(tmp_path: Path) -> None:
    earlier_workspace(tmp_path / "spring")
    changed = np.flatnonzero(ground()[:, 0] > 3.0)
    looks = LOOKS.copy()
    looks[changed] = np.random.default_rng(12).integers(0, 60, (len(changed), 128))
    found = tied(tmp_path, draw_date(1, np.random.default_rng(1)), looks)
    assert not np.isin(found.point_id - 1, changed).any()
    assert len(found) > 0.7 * (POINTS - len(changed))
    assert float(found.spread) < 0.85


def test_nothing_in_common_is_refused(tmp_path: Path) -> None:
    earlier_workspace(tmp_path / "spring")
    looks = np.random.default_rng(12).integers(0, 60, LOOKS.shape)
    with pytest.raises(DegenerateGeometryError) as caught:
        tied(tmp_path, draw_date(1, np.random.default_rng(1)), looks)
    assert caught.value.code == "earlier-not-tied"


def test_looser_tests_tie_what_hardly_looks_alike(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of another light: the nearest descriptor is that of the same point, and the next one hardly farther."""
    caplog.set_level("INFO", "pipelines.sfm.dates")
    earlier_workspace(tmp_path / "spring", noise=NOISE)
    found = tied(tmp_path, draw_date(1, np.random.default_rng(1)), noise=NOISE)
    strict, loose = ([*record.args][:2] for record in caplog.records)  # type: ignore[union-attr]
    assert (strict[0], loose[0]) == ("SIFT", "SIFT, loosely")
    assert strict[1] < POINTS / 4  # type: ignore[operator]
    np.testing.assert_array_equal(found.point_id, found.earlier_point_id)
    assert len(found) > 0.8 * POINTS


class SameFeatures:
    """Stand-in for the networks: finds the features of the drawn dates again, and knows their points."""

    def __init__(self, dates: dict[Path, Date]) -> None:
        self.dates = dates

    def features(self, job: SfmJob, image: SurveyImage) -> LearnedFeatures:
        model = self.dates[job.database].model
        rows = np.flatnonzero(model.obs_image == model.image_name.index(image.name))[::-1]
        look = np.repeat(model.obs_point[rows, None], 128, axis=1).astype(np.float32)
        xy_px = (model.obs_xy_px[rows] - 0.5).astype(np.float32)
        return LearnedFeatures(xy_px, look, (100, 100), (100, 100), 0, upright=True)

    def matches(self, first: LearnedFeatures, second: LearnedFeatures) -> np.ndarray:
        both = np.intersect1d(first.descriptor[:, 0], second.descriptor[:, 0], return_indices=True)
        return np.column_stack(both[1:])


def test_learned_features_tie_what_sift_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SIFT has seen one point of eight at either date, learned features have seen the others."""
    later = draw_date(1, np.random.default_rng(1))
    earlier = earlier_workspace(tmp_path / "spring", of_sift=POINTS // 8)
    monkeypatch.setattr("pipelines.sfm.dates.missing_for_learned", lambda: "they are not installed")
    with refused("earlier-not-tied"):
        tied(tmp_path, later, of_sift=POINTS // 8)
    networks = SameFeatures({tmp_path / "spring" / DATABASE: earlier, tmp_path / "autumn" / DATABASE: later})
    monkeypatch.setattr("pipelines.sfm.dates.missing_for_learned", lambda: None)
    monkeypatch.setattr("pipelines.sfm.learned_features.LearnedMatcher", lambda _: networks)
    (tmp_path / "autumn" / DATABASE).unlink()
    found = tied(tmp_path, later, of_sift=POINTS // 8)
    np.testing.assert_array_equal(found.point_id, found.earlier_point_id)
    assert len(found) > 0.8 * POINTS


def test_another_place_is_refused_before_the_work(tmp_path: Path) -> None:
    earlier_workspace(tmp_path / "spring")
    later = draw_date(1, np.random.default_rng(1)).survey
    moved = later.model_copy(update={"origin": Origin(lat_deg=46.03, lon_deg=7.75, alt_m=1600.0)})
    with pytest.raises(InputError) as caught:
        SolvedDate.load(tmp_path / "spring", moved)
    assert caught.value.code == "earlier-apart"
    assert "3" in str(caught.value)  # three kilometres


def test_only_cameras_elsewhere_ask_for_new_ties(tmp_path: Path) -> None:
    """A training that keeps what `init-sim3` has solved leaves `sfm` of the later date current."""
    _, spring = trained_workspace(tmp_path / "spring")
    model = load_json(TrainedModel, spring.path(MODEL))
    save_json(Solution(**{name: getattr(model, name) for name in Solution.model_fields}), spring.root / ADJUSTMENT)

    def known() -> str:
        return fingerprints(spring, BY_NAME["sfm"], SfmOptions(earlier=spring.root), {}).hashes["--earlier"]

    trained, hashed = known(), solution_hash(spring)
    assert trained == hashed
    (spring.root / MODEL).unlink()
    assert known() == trained
    save_json(model.model_copy(update={"iterations": model.iterations + 1}), spring.root / MODEL)
    assert known() == trained
    nudge_first_camera(spring, 1)
    assert known() != trained
    assert solution_hash(spring) == known()


def without_origin(root: Path, survey: Survey) -> Survey:
    return survey.model_copy(update={"origin": None})


def without_database(root: Path, survey: Survey) -> Survey:
    (root / DATABASE).unlink()
    return survey


def without_solution(root: Path, survey: Survey) -> Survey:
    (root / ADJUSTMENT).unlink()
    return survey


@pytest.mark.parametrize(
    ("spoiled", "code"),
    [(without_origin, "not-on-earth"), (without_database, "earlier-without-features"), (without_solution, None)],
)
def test_what_cannot_be_tied_is_refused(
    tmp_path: Path, spoiled: Callable[[Path, Survey], Survey], code: str | None
) -> None:
    survey = spoiled(tmp_path / "spring", earlier_workspace(tmp_path / "spring").survey)
    with pytest.raises(InputError if code else MissingProductError) as caught:
        SolvedDate.load(tmp_path / "spring", survey)
    if code:
        assert caught.value.code == code  # type: ignore[union-attr]


def test_photographs_of_a_large_survey_are_paired_with_those_beside_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.sfm.dates._EXHAUSTIVE_UP_TO", 0)
    earlier_workspace(tmp_path / "spring")
    later = draw_date(1, np.random.default_rng(1))
    date = SolvedDate.load(tmp_path / "spring", later.survey)
    model: Any = reconstruction_of(later.model)
    pairs = pairs_across(later.survey, model, date, 2)
    assert {image_id for image_id, _ in pairs} == set(range(1, IMAGES + 1))
    assert len(pairs) <= 2 * IMAGES
    # Both dates have their cameras on one ring, 30° apart in the mean: the nearest are beside each other.
    center = later.truth.cam_center_in_world
    there = draw_date(0, np.random.default_rng(0)).truth.cam_center_in_world
    away = [np.linalg.norm(center[image_id - 1] - there[other]) for image_id, other in pairs]
    assert np.median(away) < 35.0
    unknown = replace(later, survey=later.survey.model_copy(
        update={"images": tuple(image.model_copy(update={"fix": None}) for image in later.survey.images)}
    ))  # fmt: skip
    assert pairs_across(unknown.survey, model, date, 2) == []
