"""Photographs whose features are unique only where positions and attitudes predict them, against the truth.

One photograph of a flight is blurred, or was taken in other light: of all features the best is hardly better than
the second, and the ratio test refuses nearly all matches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.progress import SILENT
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera, project
from pipelines.geometry.rotations import exp_so3, quat_xyzw_from_matrix
from pipelines.geometry.similarity import umeyama
from pipelines.sfm import rounds
from pipelines.sfm.colmap_database import write_frame
from pipelines.sfm.features import SfmJob, candidate_pairs, match_features
from pipelines.sfm.joining import join_by_matches
from pipelines.sfm.mapping import map_database
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.predicted_matches import add_predicted
from pipelines.survey.survey import Attitude, Fix, Survey
from tests.refusals import logged_codes
from tests.sfm_truth import Views, survey_of_views

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")

HEIGHT_M = 60.0
LENS = Camera("SIMPLE_RADIAL", 1024, 768, np.array([900.0, 512.0, 384.0, -0.03]))
# Noise of descriptors over their values: of sharp photographs, and of the one that waits
SHARP, DIM = 0.1, 1.9
NOISE_PX = 0.3
DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Waiting:
    """The dim photograph: its height and heading, and the errors of all fixes and attitudes."""

    height_m: float = HEIGHT_M
    heading_deg: float = 0.0
    sigma_m: float = 0.5
    sigma_deg: float = 0.5
    boresight_deg: float = 0.0


def flight(folder: Path, waiting: Waiting) -> tuple[SfmJob, FloatArray]:
    """A job of two lines of four photographs and a last one among them, and the true centres."""
    rng = np.random.default_rng(11)
    center = np.array(
        [(14.0 * k, 16.0 * line, HEIGHT_M) for line in range(2) for k in range(4)] + [(21.0, 8.0, waiting.height_m)]
    )
    center += rng.normal(0, 0.5, center.shape)
    turns = [exp_so3(rng.normal(0, 0.02, 3)) @ DOWN for _ in center]
    heading = exp_so3(np.array([0.0, 0.0, np.radians(waiting.heading_deg)]))
    turns[-1] = turns[-1] @ heading
    views = Views([f"{k:02d}.jpg" for k in range(len(center))], [1] * len(center), np.array(turns), center)
    around, middle = np.array([56.0, 38.0, 2.0]), np.array([21.0, 8.0, 0.0])
    ground = [middle + rng.uniform(-part * around, part * around, (400, 3)) for part in (1.0, 0.4)]
    point = np.concatenate(ground)  # denser below the photograph that waits
    survey = _measured(survey_of_views(views, {1: LENS}), views, waiting, rng)
    return _matched(folder, survey, views, point, rng), center


def _measured(survey: Survey, views: Views, waiting: Waiting, rng: np.random.Generator) -> Survey:
    rows = []
    boresight = exp_so3(np.radians([waiting.boresight_deg, 0.0, 0.0]))
    for image, center, turn in zip(survey.images, views.center, views.rotation, strict=True):
        x, y, z = (center + rng.normal(0, waiting.sigma_m, 3)).tolist()
        variance = waiting.sigma_m**2
        covariance = ((variance, 0.0, 0.0), (0.0, variance, 0.0), (0.0, 0.0, variance))
        fix = Fix(position_in_geo=(x, y, z), cov_in_geo=covariance, source="csv", sigma_source="file")
        turned = turn.T @ boresight @ exp_so3(np.radians(rng.normal(0, waiting.sigma_deg, 3)))
        quat = tuple(quat_xyzw_from_matrix(turned).tolist())
        attitude = Attitude(quat_xyzw=quat, sigma_deg=waiting.sigma_deg, source="csv")
        rows.append(image.model_copy(update={"fix": fix, "attitude": attitude}))
    return survey.model_copy(update={"images": tuple(rows)})


def _matched(folder: Path, survey: Survey, views: Views, point: FloatArray, rng: np.random.Generator) -> SfmJob:
    """A database of features with size, direction and descriptor, matched as those of SIFT are."""
    job = SfmJob(survey, folder, folder / "database.db", SfmOptions(features="sift", threads=1))
    with pycolmap.Database.open(job.database):
        pass
    write_frame(pycolmap, job.database, survey, range(len(views.names)), job.options)
    looks = rng.gamma(0.6, 1.0, (len(point), 128))
    azimuth = rng.uniform(-np.pi, np.pi, len(point))
    tip = point + 0.25 * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(point))], axis=1)
    for index in range(len(views.names)):
        xy, end = (project(LENS, (each - views.center[index]) @ views.rotation[index].T) for each in (point, tip))
        seen = ((xy > 0) & (xy < (LENS.width, LENS.height))).all(axis=1)
        noise = DIM if index == len(views.names) - 1 else SHARP
        rows = np.flatnonzero(seen)
        a, b = (end - xy)[rows].T
        keypoint = np.column_stack([xy[rows] + rng.normal(0, NOISE_PX, (len(rows), 2)), a, -b, b, a])
        vector = np.maximum(looks[rows] + rng.normal(0, noise, (len(rows), 128)), 0)
        vector *= 512 / np.linalg.norm(vector, axis=1, keepdims=True)
        sift = pycolmap.FeatureExtractorType.SIFT
        with pycolmap.Database.open(job.database) as database:
            database.write_keypoints(index + 1, keypoint.astype(np.float32))
            described = pycolmap.FeatureDescriptors(sift, vector.clip(0, 255).astype(np.uint8))
            database.write_descriptors(index + 1, described)
    match_features(pycolmap, job, candidate_pairs(survey, job.options), SILENT)
    return job


@pytest.mark.parametrize(
    "waiting",
    [
        Waiting(height_m=30.0, heading_deg=170.0),  # features are twice as large, and turned
        Waiting(sigma_m=0.02, sigma_deg=1.0, boresight_deg=4.0),  # RTK, and a gimbal that is turned
    ],
)
def test_a_dim_photograph_is_registered_where_it_is_predicted(tmp_path: Path, waiting: Waiting) -> None:
    job, center = flight(tmp_path, waiting)
    (model, *_), _ = map_database(pycolmap, job, SILENT, lens_held=True)
    assert join_by_matches(pycolmap, job, model, SILENT)[0].num_reg_images() == len(center) - 1
    images = tuple(image.model_copy(update={"fix": None}) for image in job.survey.images)
    unknown = replace(job, survey=job.survey.model_copy(update={"images": images}))
    assert add_predicted(pycolmap, unknown, model, SILENT) == 0
    assert add_predicted(pycolmap, job, model, SILENT) >= 4
    whole, (join,) = join_by_matches(pycolmap, job, model, SILENT)
    assert whole.num_reg_images() == len(center)
    solved = np.array([whole.images[key + 1].projection_center() for key in range(len(center))])
    place = umeyama(solved[:-1], center[:-1])
    error_m = float(np.linalg.norm(place.apply(solved[-1:])[0] - center[-1]))
    assert error_m < 4 * join.tie.sigma * HEIGHT_M
    assert join.tie.sigma * HEIGHT_M < 0.3


@pytest.mark.slow
def test_rounds_seek_what_positions_predict(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    job, center = flight(tmp_path, Waiting())
    assert rounds.map_in_rounds(pycolmap, job, SILENT).registered == len(center)
    assert logged_codes(caplog) == ["joined-by-matches"]
