"""The similarity: recovery, calibration, outliers, conflicts and degenerate layouts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.adjust.alignment import Alignment, Correspondences, align, covariance_of, mean_rotation
from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import moved_pivot
from tests.refusals import numbers, refused
from tests.scenes import GEO_FROM_LOCAL, Layout, make_scene


def correspondences(
    layout: Layout = "orbit",
    *,
    images: int = 24,
    gcps: int = 0,
    sigma: tuple[float, float, float] = (0.02, 0.02, 0.03),
    sfm_m: float = 0.0,
    seed: int = 0,
) -> Correspondences:
    """Noisy fixes of true centres, and control points known to 2 cm; SfM's own error is `sfm_m`."""
    rng = np.random.default_rng(seed)
    scene = make_scene(layout, images=images, gcps=max(gcps, 1), points=1)
    truth = np.concatenate([scene.center_in_geo, scene.gcp_in_geo[:gcps]])
    control = np.arange(len(truth)) >= images
    sigmas = np.where(control[:, None], 0.02, sigma)
    local_from_geo = GEO_FROM_LOCAL.inverse()
    return Correspondences(
        name=tuple(f"p{index}" for index in range(len(truth))),
        control=control,
        in_local=local_from_geo.apply(truth + rng.normal(0, sfm_m, truth.shape)),
        cov_in_local=np.zeros((len(truth), 3, 3)),
        in_geo=truth + rng.normal(size=truth.shape) * sigmas,
        cov_in_geo=np.einsum("ni,ij->nij", sigmas**2, np.eye(3)),
    )


def moved_fixes(data: Correspondences, chosen: np.ndarray, offset: np.ndarray) -> Correspondences:
    in_geo = data.in_geo.copy()
    in_geo[chosen] += offset
    return replace(data, in_geo=in_geo)


def error_of(found: Alignment) -> np.ndarray:
    """Error (7,) in the coordinates of the covariance: the truth as a perturbation of the estimate."""
    away = GEO_FROM_LOCAL @ found.geo_from_local.inverse()
    pivot = found.solution.pivot
    return np.array([np.log(away.scale), *log_so3(away.rotation), *(away.apply(pivot) - pivot)])


def squared_error(found: Alignment) -> float:
    error = error_of(found)
    return float(error @ np.linalg.solve(found.solution.covariance, error))


@pytest.mark.parametrize("layout", ["orbit", "grid"])
def test_rtk_recovers_scale_to_a_permille_and_position_within_three_sigma(layout: Layout) -> None:
    found = align(correspondences(layout), np.random.default_rng(0))
    assert found.geo_from_local.scale == pytest.approx(GEO_FROM_LOCAL.scale, rel=1e-3)
    sigma = np.sqrt(np.diag(found.solution.covariance))
    assert (np.abs(error_of(found)) < 3.5 * sigma).all()
    assert sigma[4:].max() < 0.01  # 2–3 cm over √24
    assert found.layout == ("plane" if layout == "grid" else "volume")


@pytest.mark.parametrize(
    ("sigma", "gcps", "sfm_m"),
    [((0.02, 0.02, 0.03), 0, 0.0), ((1.5, 1.5, 3.0), 6, 0.0), ((0.02, 0.02, 0.03), 0, 0.05)],
    ids=["rtk", "consumer and control", "sfm noisier than rtk"],
)
def test_covariance_is_calibrated(sigma: tuple[float, float, float], gcps: int, sfm_m: float) -> None:
    squared = []
    for seed in range(60):
        data = correspondences(sigma=sigma, gcps=gcps, sfm_m=sfm_m, seed=seed)
        squared.append(squared_error(align(data, np.random.default_rng(seed))))
    # The mean of 60 χ²₇ has σ 0.48, 7 % of 7.
    assert np.mean(squared) == pytest.approx(7.0, rel=0.25)


def test_pivot_can_be_moved_without_changing_the_normalised_error() -> None:
    found = align(correspondences(), np.random.default_rng(0))
    origin = np.zeros(3)
    away = GEO_FROM_LOCAL @ found.geo_from_local.inverse()
    error = np.array([np.log(away.scale), *log_so3(away.rotation), *away.apply(origin)])
    cov = moved_pivot(found.solution.covariance, found.solution.pivot, origin)
    # The two agree to first order; the error is small.
    assert float(error @ np.linalg.solve(cov, error)) == pytest.approx(squared_error(found), rel=0.02)


@pytest.mark.parametrize("sfm_m", [0.0, 0.05])
def test_outlying_fixes_are_named_and_do_no_harm(sfm_m: float) -> None:
    data = correspondences(images=40, sfm_m=sfm_m)
    rng = np.random.default_rng(5)
    bad = rng.choice(40, 6, replace=False)
    direction = rng.normal(size=(6, 3))
    spoilt = moved_fixes(data, bad, 15 * direction / np.linalg.norm(direction, axis=1, keepdims=True))
    found = align(spoilt, np.random.default_rng(0))
    np.testing.assert_array_equal(np.flatnonzero(~found.solution.state.inlier), np.sort(bad))
    clean = align(data, np.random.default_rng(0))
    difference = found.geo_from_local.apply(data.in_local) - clean.geo_from_local.apply(data.in_local)
    # Six of forty fixes fewer: a change of a small part of σ/√n.
    assert np.abs(difference).max() < 0.5 * np.hypot(0.03, sfm_m)
    assert squared_error(found) < 24.3  # χ²₇ at 0.999


def test_control_points_alone_are_enough() -> None:
    data = correspondences(gcps=6)
    found = align(data.part(data.control), np.random.default_rng(0))
    assert squared_error(found) < 24.3
    assert found.geo_from_local.scale == pytest.approx(GEO_FROM_LOCAL.scale, rel=1e-3)


@pytest.mark.parametrize("gcps", [2, 6])
def test_control_points_decide_when_all_fixes_are_offset(gcps: int) -> None:
    data = correspondences(gcps=gcps)
    offset = np.array([0.5, -0.3, 2.0])
    found = align(moved_fixes(data, ~data.control, offset), np.random.default_rng(0))
    assert found.solution.state.fix_bias_in_geo == pytest.approx(offset, abs=0.1)
    assert found.solution.state.inlier.all()
    assert squared_error(found) < 24.3


def test_fixes_without_offset_get_no_bias() -> None:
    found = align(correspondences(gcps=6), np.random.default_rng(0))
    assert found.solution.state.fix_bias_in_geo is None


@pytest.mark.parametrize("gcps", [1, 4])
def test_blundered_control_point_is_left_out(gcps: int) -> None:
    data = correspondences(gcps=gcps)
    spoilt = moved_fixes(data, np.array([24]), np.array([20.0, 0.0, 5.0]))
    found = align(spoilt, np.random.default_rng(0))
    np.testing.assert_array_equal(np.flatnonzero(~found.solution.state.inlier), [24])
    assert found.solution.state.fix_bias_in_geo is None
    assert squared_error(found) < 24.3


@pytest.mark.parametrize("sigma_m", [0.02, 1.5])
def test_straight_flight_line_is_refused_without_attitude(sigma_m: float) -> None:
    data = correspondences("line", sigma=(sigma_m, sigma_m, sigma_m))
    with refused("positions-on-a-line", DegenerateGeometryError):
        align(data, np.random.default_rng(0))


@pytest.mark.parametrize("sigma_m", [0.02, 1.5])
def test_straight_flight_line_is_resolved_with_attitude(sigma_m: float) -> None:
    data = correspondences("line", sigma=(sigma_m, sigma_m, sigma_m))
    rng = np.random.default_rng(2)
    sigma_rad = np.radians(0.5)
    measured = exp_so3(rng.normal(0, sigma_rad, (24, 3))) @ GEO_FROM_LOCAL.rotation
    prior = mean_rotation(measured, np.full(24, sigma_rad))
    found = align(data, np.random.default_rng(0), attitude=prior)
    assert found.layout == "line"
    assert squared_error(found) < 24.3
    # The σ of the roll is that of one attitude: attitude errors do not average out.
    assert found.solution.rotation_sigma_rad == pytest.approx(sigma_rad, rel=0.3)


def test_straight_flight_line_is_resolved_with_control_points() -> None:
    found = align(correspondences("line", gcps=3), np.random.default_rng(0))
    assert found.layout != "line"
    assert squared_error(found) < 24.3


def test_two_positions_are_refused() -> None:
    with refused("too-few-positions", DegenerateGeometryError) as error:
        align(correspondences(images=2), np.random.default_rng(0))
    assert numbers(str(error.value))[0] == 2


def test_mean_rotation_survives_bad_attitudes() -> None:
    rng = np.random.default_rng(0)
    truth = exp_so3([0.3, 0.2, -0.9])
    measured = exp_so3(rng.normal(0, 0.01, (30, 3))) @ truth
    measured[:8] = exp_so3([0.0, 0.0, 1.0]) @ measured[:8]
    prior = mean_rotation(measured, np.full(30, 0.01))
    assert np.linalg.norm(log_so3(prior.rotation @ truth.T)) < 0.01


def test_covariance_is_that_of_least_squares_whatever_the_units_and_wide_where_nothing_is_known() -> None:
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(90, 5))
    for unit in (np.ones(5), 10.0 ** rng.uniform(-4, 4, 5)):
        covariance = covariance_of(jacobian / unit, unit)
        np.testing.assert_allclose(
            covariance / np.outer(unit, unit), np.linalg.inv(jacobian.T @ jacobian), rtol=1e-9
        )
    jacobian[:, 2] = 0.0
    sigma = np.sqrt(np.diag(covariance_of(jacobian, np.ones(5))))
    assert np.isfinite(sigma).all() and sigma[2] > 1e4 * np.delete(sigma, 2).max()
