"""What a survey measured of a scene: flights, distances and what they are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.measurements import distance_term, fix_term, flights, root_information
from pipelines.adjust.options import GeolocateOptions
from pipelines.adjust.terms import DistanceTerm
from pipelines.core.errors import InputError
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.scene import Scene as InModel
from pipelines.scene.scene import initial_scene
from pipelines.scene.survey import Survey
from pipelines.train.options import TrainOptions
from tests.scenes import Measured, Noise, TrueScene, initial, material

pytestmark = pytest.mark.usefixtures("one_thread")

pytestmark = pytest.mark.usefixtures("one_thread")


def located(noise: Noise) -> tuple[TrueScene, InModel, Survey, GeolocatedPoints]:
    truth, sparse, survey = material(noise, Measured(), images=12, points=200)
    points = geolocate(survey, sparse, GeolocateOptions()).points
    return truth, initial_scene(sparse, survey, initial()), survey, points


def test_flights_are_told_apart_by_their_gaps() -> None:
    assert flights([0.0, 2.0, 599.0, 1300.0, 1301.0, 1910.0]).tolist() == [0, 0, 0, 1, 1, 2]
    assert flights([5000.0, 0.0, 5001.0, 1.0]).tolist() == [1, 0, 1, 0]
    assert flights([0.0, None, 9000.0]).tolist() == [0, 0, 0]


def test_times_of_the_images_make_the_flights() -> None:
    _, scene, survey, _ = located(Noise())
    images = tuple(
        image.model_copy(update={"timestamp_s": 1e9 + 3.0 * index + 1200.0 * (index >= 7)})
        for index, image in enumerate(survey.images)
    )
    fixes = fix_term(scene, survey.model_copy(update={"images": images}))
    assert fixes is not None
    assert fixes.flight is not None
    assert fixes.flight.tolist() == [0] * 7 + [1] * 5


def test_distances_agree_with_the_truth_within_their_sigma() -> None:
    _, scene, survey, points = located(Noise())
    fixes = fix_term(scene, survey)
    assert fixes is not None
    pairs = distance_term(scene, fixes, points, 0)
    assert pairs is not None
    assert len(pairs.distance_in_geo) == 300
    assert pairs.camera is None
    assert pairs.distance_in_model is not None
    # The scene is in true metres: what remains is the error of geolocation. What both points of a pair share of it
    # cancels, which their two covariances do not know.
    white = (pairs.distance_in_model - pairs.distance_in_geo) * pairs.root_information[:, 0, 0]
    assert 0.1 < float(white.square().mean()) < 1.5
    # Across the scene: the longest third of random pairs in 100 m.
    assert float(pairs.distance_in_geo.min()) > 50.0


def test_distances_say_of_the_scale_a_tenth_of_what_the_fixes_say() -> None:
    for noise in (Noise(), Noise(fix_m=(1.5, 1.5, 3.0), attitude_deg=0.01)):
        _, scene, survey, points = located(noise)
        fixes = fix_term(scene, survey)
        assert fixes is not None
        pairs = distance_term(scene, fixes, points, 0)
        assert pairs is not None
        of_pairs = pairs.share * float((pairs.distance_in_geo * pairs.root_information[:, 0, 0]).square().sum())
        arm = fixes.position_in_geo - fixes.position_in_geo.mean(dim=0)
        of_fixes = float((fixes.root_information @ arm[..., None]).square().sum())
        assert 0 < of_pairs <= 0.1 * of_fixes * (1 + 1e-3)


def test_without_located_points_the_cameras_serve() -> None:
    _, scene, survey, points = located(Noise())
    fixes = fix_term(scene, survey)
    assert fixes is not None
    lost = replace(points, inlier=np.zeros_like(points.inlier))
    for given in (None, lost):
        pairs = distance_term(scene, fixes, given, 0)
        assert pairs is not None
        assert pairs.distance_in_model is None
        assert pairs.camera is not None
        assert (pairs.camera[:, 0] != pairs.camera[:, 1]).all()
    problem = geo_problem(scene, survey, initial(), TrainOptions())
    pairs = problem.term(DistanceTerm)
    assert pairs is not None
    missed = pairs.residuals(problem.estimate()).detach()
    # Fixes of 2 to 3 cm at either end.
    assert 0.01 < float(missed.square().mean().sqrt()) < 0.06


def test_points_of_another_model_are_refused() -> None:
    _, scene, survey, points = located(Noise())
    fixes = fix_term(scene, survey)
    assert fixes is not None
    with pytest.raises(InputError, match="another model"):
        distance_term(scene, fixes, replace(points, point_id=points.point_id + 1), 0)


def test_distances_do_not_overrule_the_fixes() -> None:
    """A geolocation that is a per cent too large, of many precise points, moves the scale by a tenth of that."""
    truth, scene, survey, points = located(Noise(attitude_deg=0.01))
    middle = truth.point_in_geo.mean(axis=0)
    blown = replace(points, position_in_geo=middle + 1.01 * (points.position_in_geo - middle))
    problem = geo_problem(scene, survey, initial(), TrainOptions(optimize_cameras=False), points=blown)
    adam = torch.optim.Adam([problem.similarity.y], lr=0.02)
    for _ in range(300):
        adam.zero_grad()
        problem.loss().backward()
        adam.step()
    assert problem.similarity.current().scale == pytest.approx(1.0, abs=1.2e-3)


def test_root_information() -> None:
    half = np.random.default_rng(0).normal(size=(4, 3, 3))
    covariance = half @ np.swapaxes(half, 1, 2)
    root = root_information(covariance)
    np.testing.assert_allclose(np.swapaxes(root, 1, 2) @ root, np.linalg.inv(covariance), rtol=1e-8)
