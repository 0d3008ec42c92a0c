"""Points that follow cameras which have changed: exact pixels, a plain minimiser, blunders, many chunks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from pipelines.geometry import intersection as module
from pipelines.geometry.cameras import project
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.network import Network
from pipelines.geometry.statistics import cauchy_loss
from tests.bundle_scenes import exact_network, noisy

EXACT = exact_network(images=6)


def displaced(network: Network, metres: float = 0.1) -> Network:
    moved = np.random.default_rng(0).normal(0, metres, network.point_in_world.shape)
    return replace(network, point_in_world=network.point_in_world + moved)


def cost(network: Network, index: int, point: np.ndarray) -> float:
    total = 0.0
    for row in np.flatnonzero(network.obs_point == index):
        image = network.obs_image[row]
        in_cam = network.cam_from_world[image] @ (point - network.cam_center_in_world[image])
        camera = network.cameras[int(network.camera_id[image])]
        squared = ((project(camera, in_cam[None])[0] - network.obs_xy_px[row]) ** 2).sum()
        total += float(cauchy_loss(squared, 2))
    return total


@pytest.mark.parametrize("chunk", [module._CHUNK, 7], ids=["one chunk", "many"])
def test_exact_pixels_bring_every_point_back(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK", chunk)
    found = refined_points(displaced(EXACT))
    np.testing.assert_allclose(found.point_in_world, EXACT.point_in_world, atol=1e-5)
    assert found.error_px.max() < 1e-3


def test_result_is_the_minimum_that_a_plain_search_finds() -> None:
    network = displaced(noisy(EXACT, np.random.default_rng(3)), 0.02)
    found = refined_points(network)
    for index in (0, 11):
        reference = minimize(lambda x, i=index: cost(network, i, x), network.point_in_world[index], tol=1e-12)
        assert cost(network, index, found.point_in_world[index]) <= reference.fun * (1 + 1e-6) + 1e-9
        np.testing.assert_allclose(found.point_in_world[index], reference.x, atol=1e-3)


def test_blunder_pulls_its_point_by_little_and_shows_in_the_error() -> None:
    pixels = EXACT.obs_xy_px.copy()
    pixels[0] += 200.0
    found = refined_points(replace(EXACT, obs_xy_px=pixels))
    struck = EXACT.obs_point[0]
    assert np.linalg.norm(found.point_in_world[struck] - EXACT.point_in_world[struck]) < 0.1
    assert found.error_px[struck] > 20
    assert np.delete(found.error_px, struck).max() < 1e-3


def test_point_behind_its_cameras_stays_and_has_no_error() -> None:
    behind = EXACT.point_in_world.copy()
    behind[0] = EXACT.cam_center_in_world.mean(axis=0) * 50
    turned = replace(EXACT, point_in_world=behind)
    found = refined_points(turned)
    in_cam = np.einsum("nij,nj->ni", EXACT.cam_from_world, behind[0] - EXACT.cam_center_in_world)
    assert (in_cam[:, 2] < 0).all()
    np.testing.assert_array_equal(found.point_in_world[0], behind[0])
    assert np.isnan(found.error_px[0])
    assert np.isfinite(found.error_px[1:]).all()
