"""Surveys without any position: known distances set the scale of a local frame, with the σ that is predicted."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.local_frame import Up, local_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Remark
from pipelines.geometry.similarity import Similarity
from pipelines.survey.marks import mark_rays, triangulated_points
from pipelines.survey.survey import KnownDistance, PointMarks, Survey, SurveyedPoint
from tests.drawn_surveys import Receiver, drawn, flight, marked, surveyed
from tests.refusals import codes, refused
from tests.scenes import Noise, TrueScene, looking_at, sparse_model

pytestmark = pytest.mark.usefixtures("one_thread")
FLIGHT = flight(30, 300, check=12)
SIGMA_M, BARS = 0.005, 3
STILL = Noise(pixel_px=0.2)


def known(ends: tuple[SurveyedPoint, ...], length_m: float, use: str = "control") -> KnownDistance:
    of_ends = tuple(PointMarks(name=end.name, marks=end.marks) for end in ends)
    return KnownDistance.model_validate({"ends": of_ends, "distance_m": length_m, "sigma_m": SIGMA_M, "use": use})


def local_survey(rng: np.random.Generator, *, blunder_m: float = 0.0) -> tuple[Survey, tuple[SurveyedPoint, ...]]:
    """Return a survey without positions and with three distances, and the points that are left to measure."""
    truth = drawn(FLIGHT, rng)
    survey = surveyed(FLIGHT, truth, Receiver((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), None, rng)
    points = survey.check_points
    distances = []
    for index in range(BARS):
        ends = points[2 * index : 2 * index + 2]
        true_m = float(np.linalg.norm(np.subtract(*(end.position_in_geo for end in ends))))
        distances.append(known(ends, true_m + rng.normal(0, SIGMA_M) + (blunder_m if index == 1 else 0.0)))
    local = survey.model_copy(
        update={
            "origin": None,
            "images": tuple(image.model_copy(update={"fix": None}) for image in survey.images),
            "sessions": (),
            "check_points": (),
            "distances": tuple(distances),
        }
    )
    return local, points[2 * BARS :]


def seen_from(scene: TrueScene, survey: Survey) -> Survey:
    """Return the survey with one distance whose ends are marked in the photographs of a scene."""
    ends = marked(scene, FLIGHT.check[:2], None, "end", np.random.default_rng(0))
    return survey.model_copy(update={"distances": (known(ends, 10.0),)})


def solved(survey: Survey) -> tuple[Posterior, tuple[Remark, ...]]:
    points = geolocate(survey, FLIGHT.model, GeolocateOptions())
    assert not points.warnings
    return estimate_similarity(survey, FLIGHT.model, points.points, InitSim3Options())


def lengths(posterior: Posterior, survey: Survey, held: tuple[SurveyedPoint, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of all distances between points that are left, and their predicted σ."""
    pairs = list(combinations(held, 2))
    ends = [end for pair in pairs for end in pair]
    rays = mark_rays(ends, posterior.sparse)
    found = triangulated_points(posterior.solution, rays)
    true = np.array([end.position_in_geo for end in ends])
    error = np.subtract(*(np.linalg.norm(place[::2] - place[1::2], axis=1) for place in (found, true)))
    return error, np.sqrt(posterior.of_distances(found, rays))


def test_three_distances_set_the_scale_with_the_sigma_that_is_predicted() -> None:
    normalised, of_scale = [], []
    for seed in range(6):
        survey, held = local_survey(np.random.default_rng(seed))
        posterior, _ = solved(survey)
        error, sigma = lengths(posterior, survey, held)
        normalised.append((error / sigma) ** 2)
        assert np.abs(error / sigma).max() < 4
        # The true scale is that of `local`: its metre is known from the scene.
        ratio = posterior.solution.similarity_from_local().scale / FLIGHT.scene.geo_from_local.scale
        of_scale.append(np.log(ratio) / posterior.of_similarity[0, 0] ** 0.5)
        covariance = posterior.of_similarity
        assert np.sqrt(covariance[0, 0]) < 1e-3
        # What nothing measures is fixed: rotation and shift of the mean have no σ of their own.
        assert np.sqrt(np.diag(covariance)[1:4]).max() < 1e-5
        assert "local-frame-level" in codes(posterior.solution.cautions)
    assert np.abs(of_scale).max() < 3
    # Six draws of pairs that share their points.
    assert 0.4 < np.mean(normalised) < 1.9


def test_the_frame_is_level_and_lies_about_the_cameras() -> None:
    survey, _ = local_survey(np.random.default_rng(0))
    posterior, _ = solved(survey)
    similarity = Similarity.from_record(posterior.solution.similarity_from_local())
    centers = similarity.apply(FLIGHT.model.cam_center_in_local)
    assert np.abs(centers.mean(axis=0)).max() < 0.01
    up_in_local = FLIGHT.scene.geo_from_local.rotation[2]
    assert np.degrees(np.arccos(min(similarity.rotation[2] @ up_in_local, 1.0))) < 8


@pytest.mark.parametrize("up", ["plane", "photographs"])
def test_the_vertical_of_an_orbit(up: Up) -> None:
    survey, _ = local_survey(np.random.default_rng(0))
    angle = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    middle = FLIGHT.scene.center_in_geo.mean(axis=0) * [1, 1, 0]
    center = middle + np.column_stack([60 * np.cos(angle), 60 * np.sin(angle), 30 + 5 * np.sin(3 * angle)])
    turned = looking_at(center, np.broadcast_to(middle, center.shape))
    scene = replace(FLIGHT.scene, center_in_geo=center, geo_from_cam=turned)
    model = sparse_model(scene, STILL, np.random.default_rng(0))
    initial, remark = local_similarity(seen_from(scene, survey), model, up)
    rotation = Similarity.from_record(initial.geo_from_local).rotation
    assert np.degrees(np.arccos(min(rotation[2] @ scene.geo_from_local.rotation[2], 1.0))) < 1
    assert "assumed" in remark.sentence


def test_a_wrong_distance_of_several_is_named() -> None:
    survey, _ = local_survey(np.random.default_rng(1), blunder_m=0.5)
    posterior, warnings = solved(survey)
    assert codes(warnings) == ["distances-disagree"] or posterior.solution.distance_outliers


def test_without_a_distance_that_can_be_measured_there_is_no_scale() -> None:
    survey, _ = local_survey(np.random.default_rng(0))
    ends = tuple(end.model_copy(update={"marks": end.marks[:1]}) for end in survey.distances[0].ends)
    lost = survey.distances[0].model_copy(update={"ends": ends})
    with refused("no-scale", DegenerateGeometryError):
        solved(survey.model_copy(update={"distances": (lost,)}))
