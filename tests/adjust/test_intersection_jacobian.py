"""How points follow cameras and lens, against least squares on numerical derivatives of the pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.intersection import intersection_jacobian
from tests.bundle_scenes import exact_network, jacobian


def test_points_follow_as_least_squares_says() -> None:
    network = exact_network(images=5, points=12)
    sigma_px = np.random.default_rng(0).uniform(0.2, 1.0, len(network.obs_point))
    design = jacobian(network) / np.repeat(sigma_px, 2)[:, None]
    poses, points, lens = design[:, :30], design[:, 30:66], design[:, 66:]
    derivatives = intersection_jacobian(network, sigma_px)
    expected = -np.linalg.lstsq(points, poses, rcond=None)[0]
    np.testing.assert_allclose(derivatives.by_poses.toarray(), expected, atol=1e-5 * np.abs(expected).max())
    expected = -np.linalg.lstsq(points, lens, rcond=None)[0].reshape(12, 3, 4)
    np.testing.assert_allclose(derivatives.by_lens, expected, atol=1e-5 * np.abs(expected).max())
    cov = np.linalg.inv(points.T @ points)
    own = np.stack([cov[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] for j in range(12)])
    np.testing.assert_allclose(derivatives.cov_of_marks, own, rtol=1e-5)


def test_parallel_rays_determine_no_point() -> None:
    network = exact_network(images=2, points=1)
    away = network.cam_center_in_world[0] - network.point_in_world[0]
    line = replace(
        network,
        cam_center_in_world=network.point_in_world[0] + np.array([1.0, 1.5])[:, None] * away,
        cam_from_world=network.cam_from_world[[0, 0]],
    )
    assert np.isnan(intersection_jacobian(line, np.ones(2)).cov_of_marks).all()
