"""Intersection of rays against a plain reference, its calibration, and its robustness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.intersection import (
    CommonRotation,
    NearestPoints,
    Rays,
    UncertainCameras,
    intersect_rays,
    nearest_points,
)
from pipelines.geometry.rotations import exp_so3
from tests.oracles import intersect_one
from tests.scenes import make_scene


def true_cameras(
    sigma_m: float, attitude_deg: float, ray: float, images: int = 24
) -> tuple[UncertainCameras, Rays, np.ndarray]:
    """Return error-free cameras, rays and points of an orbit, with the σ that noise will be drawn from."""
    scene = make_scene(images=images, points=150)
    owner, image, _ = scene.pixels(scene.point_in_geo)
    in_cam = np.einsum(
        "mji,mj->mi", scene.geo_from_cam[image], scene.point_in_geo[owner] - scene.center_in_geo[image]
    )
    count = len(scene.center_in_geo)
    cov = np.diag([sigma_m, sigma_m, 2 * sigma_m]) ** 2
    cov[0, 1] = cov[1, 0] = 0.4 * sigma_m**2
    cameras = UncertainCameras(
        center_in_geo=scene.center_in_geo,
        rotation_geo_from_cam=scene.geo_from_cam,
        cov_center_in_geo=np.tile(cov, (count, 1, 1)),
        sigma_attitude_rad=np.full(count, np.radians(attitude_deg)),
        sigma_ray=np.full(count, ray),
    )
    return cameras, Rays(owner, image, in_cam[:, :2] / in_cam[:, 2:]), scene.point_in_geo


def noisy(cameras: UncertainCameras, rays: Rays, rng: np.random.Generator) -> tuple[UncertainCameras, Rays]:
    root = np.linalg.cholesky(cameras.cov_center_in_geo[0])
    count = len(cameras.center_in_geo)
    shaken = replace(
        cameras,
        center_in_geo=cameras.center_in_geo + rng.normal(size=(count, 3)) @ root.T,
        rotation_geo_from_cam=exp_so3(rng.normal(size=(count, 3)) * cameras.sigma_attitude_rad[:, None])
        @ cameras.rotation_geo_from_cam,
    )
    return shaken, replace(rays, xy=rays.xy + rng.normal(0, cameras.sigma_ray[0], rays.xy.shape))


def few_rays(rays: Rays, most: int, rng: np.random.Generator) -> Rays:
    """Return at most `most` rays of each point, chosen at random."""
    order = rng.permutation(len(rays.point))
    order = order[np.argsort(rays.point[order], kind="stable")]
    rank = np.arange(len(order)) - np.searchsorted(rays.point[order], rays.point[order])
    keep = order[rank < most]
    return Rays(rays.point[keep], rays.view[keep], rays.xy[keep])


def squared_errors(position: np.ndarray, cov: np.ndarray, truth: np.ndarray) -> np.ndarray:
    error = position - truth
    return (error * np.linalg.solve(cov, error[..., None])[..., 0]).sum(axis=-1)


def test_exact_rays_meet_in_the_point() -> None:
    cameras, rays, truth = true_cameras(0.02, 0.1, 1e-4)
    intersections = intersect_rays(rays, cameras, len(truth))
    np.testing.assert_allclose(intersections.position_in_geo, truth, atol=1e-8)
    assert intersections.consistent.all()
    assert intersections.used.all()
    np.testing.assert_array_equal(intersections.ray_count, np.bincount(rays.point))


def test_agrees_with_the_plain_reference() -> None:
    rng = np.random.default_rng(1)
    cameras, rays, truth = true_cameras(0.5, 0.3, 1e-3)
    cameras, rays = noisy(cameras, few_rays(rays, 6, rng), rng)
    intersections = intersect_rays(rays, cameras, len(truth))
    compared = 0
    for point in range(0, len(truth), 5):
        mine = rays.point == point
        if not intersections.used[mine].all():
            continue  # the reference knows no outliers
        position, cov = intersect_one(rays.xy[mine], rays.view[mine].tolist(), cameras)
        # The two take the distances, on which the weights depend, from different iterates.
        sigma = np.sqrt(np.diag(cov))
        assert (np.abs(intersections.position_in_geo[point] - position) < 0.05 * sigma).all()
        np.testing.assert_allclose(np.diag(intersections.cov_in_geo[point]), np.diag(cov), rtol=0.05)
        compared += 1
    assert compared > 20


@pytest.mark.parametrize(
    ("sigma_m", "attitude_deg", "ray"),
    [(1.5, 0.001, 1e-5), (0.001, 0.5, 1e-5), (0.001, 0.001, 5e-3), (0.5, 0.3, 1e-3)],
    ids=["position", "attitude", "pixel", "all"],
)
@pytest.mark.parametrize("most", [3, 8])
def test_covariance_is_calibrated(sigma_m: float, attitude_deg: float, ray: float, most: int) -> None:
    rng = np.random.default_rng(7)
    cameras, rays, truth = true_cameras(sigma_m, attitude_deg, ray)
    squared = []
    for _ in range(60):
        measured, seen = noisy(cameras, few_rays(rays, most, rng), rng)
        intersections = intersect_rays(seen, measured, len(truth))
        good = intersections.consistent & (intersections.max_angle_deg > 10)
        squared.append(squared_errors(intersections.position_in_geo, intersections.cov_in_geo, truth)[good])
    # 60 redraws of 150 points; what points share in one redraw leaves about 3 % of scatter in the mean.
    assert np.concatenate(squared).mean() == pytest.approx(3.0, rel=0.1)


def test_shared_rotation_error_is_calibrated() -> None:
    rng = np.random.default_rng(3)
    cameras, rays, truth = true_cameras(0.5, 0.001, 1e-4)
    count = len(cameras.center_in_geo)
    # As an alignment would: the rotation is a linear function of the errors of all centres.
    gain = rng.normal(size=(count, 3, 3)) * 0.004
    cov = np.einsum("nij,njk,nlk->il", gain, cameras.cov_center_in_geo, gain)
    squared = []
    for _ in range(120):
        measured, seen = noisy(cameras, few_rays(rays, 6, rng), rng)
        error = measured.center_in_geo - cameras.center_in_geo
        turn = exp_so3(np.einsum("nij,nj->i", gain, error))
        measured = replace(
            measured,
            rotation_geo_from_cam=turn @ measured.rotation_geo_from_cam,
            common=CommonRotation(cov, gain),
        )
        intersections = intersect_rays(seen, measured, len(truth))
        squared.append(
            squared_errors(intersections.position_in_geo, intersections.cov_in_geo, truth)[intersections.consistent]
        )
    # All points share one rotation in a redraw, so 120 redraws of three numbers scatter by about 7 %.
    assert np.concatenate(squared).mean() == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize("most", [5, 10])
@pytest.mark.parametrize("sigma_m", [0.05, 0.5])
def test_one_bad_fix_does_not_move_points_by_metres(most: int, sigma_m: float) -> None:
    rng = np.random.default_rng(11)
    cameras, rays, truth = true_cameras(sigma_m, 0.1, 3e-4)
    measured, seen = noisy(cameras, few_rays(rays, most, rng), rng)
    clean = intersect_rays(seen, measured, len(truth))
    direction = rng.normal(size=3)
    center = measured.center_in_geo.copy()
    center[5] += 15 * direction / np.linalg.norm(direction)
    intersections = intersect_rays(seen, replace(measured, center_in_geo=center), len(truth))
    touched = np.unique(seen.point[seen.view == 5])
    error = np.linalg.norm(intersections.position_in_geo - truth, axis=1)[touched]
    before = np.linalg.norm(clean.position_in_geo - truth, axis=1)[touched]
    trusted = intersections.consistent[touched]
    assert trusted.mean() > 0.9
    # Losing one ray of five costs some accuracy, not metres.
    assert np.median(error[trusted]) < 1.5 * np.median(before)
    assert error[trusted].max() < 3 * before.max() + 0.5
    assert intersections.used[seen.view == 5].mean() < 0.1


def test_one_false_match_among_five_is_left_out() -> None:
    rng = np.random.default_rng(5)
    cameras, rays, truth = true_cameras(0.03, 0.05, 3e-4)
    measured, seen = noisy(cameras, few_rays(rays, 5, rng), rng)
    counts = np.bincount(seen.point, minlength=len(truth))
    last = np.cumsum(counts) - 1
    wrong = last[counts == 5]
    xy = seen.xy.copy()
    xy[wrong] += rng.choice([-0.2, 0.2], (len(wrong), 2))
    intersections = intersect_rays(replace(seen, xy=xy), measured, len(truth))
    hit = counts == 5
    assert intersections.used[wrong].mean() < 0.03
    assert np.linalg.norm(intersections.position_in_geo - truth, axis=1)[hit & intersections.consistent].max() < 1.0
    assert (intersections.consistent[hit]).mean() > 0.95


def test_parallel_single_and_missing_rays_give_no_position() -> None:
    cameras = UncertainCameras(
        center_in_geo=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        rotation_geo_from_cam=np.tile(np.eye(3), (2, 1, 1)),
        cov_center_in_geo=np.tile(np.eye(3) * 1e-4, (2, 1, 1)),
        sigma_attitude_rad=np.full(2, 1e-3),
        sigma_ray=np.full(2, 1e-3),
    )
    rays = Rays(np.array([0, 0, 1, 3, 3]), np.array([0, 1, 0, 0, 1]), np.zeros((5, 2)))
    rays.xy[3], rays.xy[4] = [0.05, 0.0], [-0.05, 0.0]
    intersections = intersect_rays(rays, cameras, 4)
    assert np.isnan(intersections.position_in_geo[:3]).all()
    assert not intersections.consistent[:3].any()
    assert np.isinf(intersections.condition[:3]).all()
    np.testing.assert_allclose(intersections.position_in_geo[3], [0.5, 0.0, 10.0], atol=1e-9)
    assert intersections.max_angle_deg[3] == pytest.approx(np.degrees(2 * np.arctan(0.05)))


def test_point_behind_a_camera_is_not_trusted() -> None:
    cameras, rays, truth = true_cameras(0.02, 0.05, 1e-4)
    cameras = replace(cameras, rotation_geo_from_cam=cameras.rotation_geo_from_cam * [1.0, 1.0, -1.0])
    intersections = intersect_rays(replace(rays, xy=-rays.xy), cameras, len(truth))
    assert not intersections.consistent.any()


def test_unsorted_rays_are_refused() -> None:
    cameras, rays, truth = true_cameras(0.02, 0.05, 1e-4)
    with pytest.raises(ValueError, match="sorted"):
        intersect_rays(Rays(rays.point[::-1], rays.view, rays.xy), cameras, len(truth))


def test_result_does_not_depend_on_where_chunks_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    cameras, rays, truth = true_cameras(0.5, 0.3, 1e-3)
    cameras, rays = noisy(cameras, rays, rng)
    whole = intersect_rays(rays, cameras, len(truth))
    monkeypatch.setattr("pipelines.geometry.intersection._CHUNK_RAYS", 37)
    parts = intersect_rays(rays, cameras, len(truth))
    np.testing.assert_allclose(parts.position_in_geo, whole.position_in_geo, atol=1e-9)
    np.testing.assert_array_equal(parts.used, whole.used)


def exact_rays(sigma_rad: float, seed: int) -> tuple[NearestPoints, np.ndarray]:
    """Return the points nearest to rays of exact cameras, with noise of a σ in their directions, and the truth."""
    cameras, rays, truth = true_cameras(0.1, 0.1, 1e-3)
    center = cameras.center_in_geo[rays.view]
    direction = truth[rays.point] - center
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    noise = np.random.default_rng(seed).normal(0.0, sigma_rad, direction.shape)
    direction = direction + noise - (noise * direction).sum(axis=1, keepdims=True) * direction
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sigma = np.full(len(direction), max(sigma_rad, 1e-6))
    return nearest_points(rays.point, center, direction, sigma, len(truth)), truth


def test_nearest_points_are_exact_and_their_covariance_is_calibrated() -> None:
    exact, truth = exact_rays(0.0, 0)
    np.testing.assert_allclose(exact.position, truth, atol=1e-9)
    noisy_rays, _ = exact_rays(5e-4, 1)
    squared = squared_errors(noisy_rays.position, noisy_rays.cov, truth)
    # 150 points of 3 degrees of freedom: the mean of χ²₃ has a σ of √(6/150) = 0.2.
    assert abs(squared.mean() - 3.0) < 4 * 0.2


def test_derivatives_of_nearest_points_are_those_of_differences() -> None:
    """The weights are those of the distances, which a small step does not change to first order across the rays."""
    met, _ = exact_rays(5e-4, 2)
    by_center, by_direction = met.derivatives()
    ray, step = 7, 1e-6
    point = met.point[ray]
    for axis in np.eye(3):
        center, direction = met.center.copy(), met.direction.copy()
        center[ray] += step * axis
        moved = nearest_points(met.point, center, met.direction, met.sigma_rad, len(met.position)).position
        np.testing.assert_allclose((moved - met.position)[point] / step, by_center[ray] @ axis, atol=5e-3)
        turned = direction[ray] + step * axis
        direction[ray] = turned / np.linalg.norm(turned)
        tangent = (direction[ray] - met.direction[ray]) / step
        moved = nearest_points(met.point, met.center, direction, met.sigma_rad, len(met.position)).position
        scale = np.linalg.norm(met.position[point] - met.center[ray])
        np.testing.assert_allclose(
            (moved - met.position)[point] / step, by_direction[ray] @ tangent, atol=5e-3 * scale
        )
