"""Errors of the reference system: of a transformation, of an assumed datum, of a doubtful zero of heights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.adjust.alignment import Correspondences, align
from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.headline import predicted
from pipelines.survey.marks import mark_rays
from pipelines.survey.survey import FixSession, Survey
from tests.refusals import numbers, refused
from tests.scenes import GEO_FROM_LOCAL, Measured, Noise, make_scene, sparse_model, survey_of

TRANSFORMATION_M = 2.0
AXIS_M = TRANSFORMATION_M / 2**0.5


def drawn(measured: Measured) -> tuple[Survey, SparseModel]:
    scene, rng = make_scene("orbit", points=120), np.random.default_rng(3)
    return survey_of(scene, Noise(), measured, rng), sparse_model(scene, Noise(), rng)


def solved(survey: Survey, model: SparseModel) -> Posterior:
    points = geolocate(survey, model, GeolocateOptions()).points
    posterior, _ = estimate_similarity(survey, model, points, InitSim3Options())
    return posterior


def session(datum: tuple[float, float, float]) -> FixSession:
    common = np.hypot((0.03, 0.03, 0.05), datum)
    return FixSession(
        receiver="RTK fixed", sigma_common_m=tuple(common.tolist()), sigma_source="default", sigma_datum_m=datum
    )


@pytest.mark.parametrize("fixes", [True, False])
def test_the_accuracy_of_the_transformation_of_control_points_is_in_every_absolute_sigma(fixes: bool) -> None:
    survey, model = drawn(Measured(gcps=True, fixes=fixes))
    plain = solved(survey, model)
    datum = (AXIS_M, AXIS_M, 0.0)
    sessions = (session(datum),) if fixes else ()
    coarse = solved(survey.model_copy(update={"sigma_datum_m": datum, "sessions": sessions}), model)
    for posterior, least in ((plain, 0.0), (coarse, TRANSFORMATION_M)):
        accuracy = posterior.solution.accuracy
        assert accuracy is not None and accuracy.rms_sigma_h_m is not None
        # RTK and control of centimetres: what is beyond is that of the transformation alone.
        assert least <= accuracy.rms_sigma_h_m < least + 0.1
        of_similarity = np.array(posterior.solution.geo_from_model.covariance)[4:, 4:]
        assert least <= np.sqrt(np.trace(of_similarity[:2, :2])) < least + 0.1
        cameras = np.sqrt(posterior.camera_cov[:, 3, 3] + posterior.camera_cov[:, 4, 4])
        assert ((least <= cameras) & (cameras < least + 0.2)).all()
    # The heights have no part in it, and neither have differences: control points keep their place.
    assert coarse.solution.accuracy.rms_sigma_v_m < 0.1
    moved = Similarity.from_record(coarse.solution.similarity_from_local()) @ GEO_FROM_LOCAL.inverse()
    assert np.linalg.norm(moved.apply(np.zeros((1, 3)))) < 0.1


def test_heights_of_an_assumed_datum_have_its_sigma() -> None:
    survey, model = drawn(Measured())
    assumed = solved(survey.model_copy(update={"sessions": (session((0.0, 0.0, 50.0)),)}), model)
    stated = solved(survey.model_copy(update={"sessions": (session((0.0, 0.0, 0.0)),)}), model)
    for one, least in ((assumed, 50.0), (stated, 0.0)):
        accuracy = one.solution.accuracy
        assert accuracy is not None and accuracy.rms_sigma_v_m is not None and accuracy.rms_sigma_h_m is not None
        assert 0.99 * least <= accuracy.rms_sigma_v_m < least + 0.2 and accuracy.rms_sigma_h_m < 0.2
    # Control points with heights decide: nothing of it is left.
    survey, model = drawn(Measured(gcps=True))
    decided = solved(survey.model_copy(update={"sessions": (session((0.0, 0.0, 50.0)),)}), model)
    assert decided.solution.accuracy.rms_sigma_v_m < 0.1


def with_zero(survey: Survey, shift_m: float, sigma_m: float) -> Survey:
    """Return the survey with heights that count from another zero, whose σ is known to be large."""
    images = []
    for image in survey.images:
        assert image.fix is not None
        east, north, up = image.fix.position_in_geo
        cov = np.array(image.fix.cov_in_geo) + np.diag([0.0, 0.0, sigma_m**2])
        update = {"position_in_geo": (east, north, up + shift_m), "sigma_zero_m": sigma_m}
        fix = image.fix.model_copy(update={**update, "cov_in_geo": tuple(map(tuple, cov.tolist()))})
        images.append(image.model_copy(update={"fix": fix}))
    return survey.model_copy(update={"images": tuple(images), "sessions": (session((0.0, 0.0, sigma_m)),)})


def test_heights_from_an_unknown_zero_level_the_survey_and_state_no_height() -> None:
    survey, model = drawn(Measured())
    posterior = solved(with_zero(survey, -1620.0, 1000.0), model)
    accuracy = posterior.solution.accuracy
    assert accuracy is not None
    headline = predicted(accuracy, ())
    assert headline.rmse_v_m is None and headline.rmse_h_m is not None and headline.rmse_h_m < 0.2
    assert "V unknown" in headline.text
    # Fixes of centimetres against each other level an orbit of tens of metres to a tenth of a degree.
    sigma = np.sqrt(np.diag(np.array(posterior.solution.geo_from_model.covariance)))
    assert np.degrees(sigma[1:3]).max() < 0.1


def test_control_points_decide_heights_from_an_unknown_zero() -> None:
    survey, model = drawn(Measured(gcps=True))
    solution = solved(with_zero(survey, -2470.0, 2470.0), model).solution
    away = Similarity.from_record(solution.similarity_from_local()) @ GEO_FROM_LOCAL.inverse()
    assert np.linalg.norm(away.apply(np.zeros((1, 3)))) < 0.15
    assert solution.gnss_outliers == () and solution.control_outliers == ()


def grid(across: float) -> Correspondences:
    """Return nine positions on a grid, with the σ of a consumer's receiver."""
    place = np.array([[13.0 * x, across * y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    sigma = np.array([2.5, 2.5, 5.0])
    noise = np.random.default_rng(0).normal(size=place.shape) * sigma
    return Correspondences(
        name=tuple(map(str, range(9))),
        control=np.zeros(9, dtype=bool),
        in_local=place / 3.0,
        cov_in_local=np.zeros((9, 3, 3)),
        in_geo=place + noise,
        cov_in_geo=np.tile(np.diag(sigma**2), (9, 1, 1)),
    )


def test_a_small_block_is_no_line() -> None:
    with refused("block-too-small", DegenerateGeometryError) as error:
        align(grid(12.0), np.random.default_rng(0))
    assert numbers(str(error.value))[0] == 9 and {2.5, 5.0} <= set(numbers(str(error.value)))
    assert "--sigma-h" in str(error.value) and "--sigma-gcp-h" not in str(error.value)
    with refused("block-too-small", DegenerateGeometryError) as error:
        align(replace(grid(12.0), control=np.ones(9, dtype=bool)), np.random.default_rng(0))
    assert "--sigma-gcp-h" in str(error.value) and "--sigma-h" not in str(error.value)
    with refused("positions-on-a-line", DegenerateGeometryError):
        align(grid(0.5), np.random.default_rng(0))


def test_check_points_show_an_assumed_datum_and_not_the_transformation_that_they_share() -> None:
    survey, model = drawn(Measured(gcps=True))
    check = survey.control_points[:3]
    rays = mark_rays(check, model)
    place = np.array([point.position_in_geo for point in check])
    by_control = {"control_points": survey.control_points[3:], "sigma_datum_m": (AXIS_M, AXIS_M, 0.0)}
    shared = solved(survey.model_copy(update=by_control), model)
    assert np.sqrt(shared.of_marked_points(place, rays)[:, 0, 0]).max() < 0.1
    by_fixes = {"control_points": (), "sessions": (session((0.0, 0.0, 50.0)),)}
    shown = solved(survey.model_copy(update=by_fixes), model)
    assert np.sqrt(shown.of_marked_points(place, rays)[:, 2, 2]) == pytest.approx(50.0, abs=0.1)
    joint = shown.jointly_of_marked_points(place, rays)
    # All points share it: their differences are as good as before.
    assert joint[2, 2] + joint[5, 5] - 2 * joint[2, 5] < 0.1**2
