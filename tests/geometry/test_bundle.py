"""Whitened camera corrections of a bundle, against the full normal matrix and against real readjustments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.bundle import bundle_information, similarity_modes
from pipelines.geometry.network import Network
from pipelines.geometry.rotations import exp_so3
from tests.bundle_scenes import SIGMA_PX, adjuster, exact_network, jacobian, noisy, pixels, readjusted, size, units
from tests.dense_bundle import DenseBasis, correction_basis
from tests.refusals import numbers, refused


def basis_of(network: Network, *, lens_follows: bool = True) -> DenseBasis:
    return correction_basis(bundle_information(network), lens_follows=lens_follows)


def free_covariance(network: Network) -> np.ndarray:
    """Return the covariance (6 n, 6 n) of the poses for unit pixel noise, with the points fixed on the average.

    Meissl's constraints on the cameras border the full normal matrix. Then the gauge moves to the points.
    """
    n, unknowns = len(network.camera_id), size(network)
    design = jacobian(network)
    scale = 1.0 / np.linalg.norm(design, axis=0)
    scaled = design * scale
    constraint = np.zeros((unknowns, 7))
    modes = similarity_modes(network.cam_center_in_world).reshape(-1, 7)
    constraint[: 6 * n] = modes / units(network)[:, None] ** 2
    constraint = constraint * scale[:, None]
    constraint /= np.linalg.norm(constraint, axis=0)
    bordered = np.block([[scaled.T @ scaled, constraint], [constraint.T, np.zeros((7, 7))]])
    inverse = np.linalg.inv(bordered)[:unknowns, :unknowns] * scale[:, None] * scale
    hold = np.eye(6 * n) - modes @ points_follow(network, np.eye(6 * n))
    return hold @ inverse[: 6 * n, : 6 * n] @ hold.T


def points_follow(network: Network, corrections: np.ndarray, *, lens_follows: bool = True) -> np.ndarray:
    """Return the mean similarity (7, c) of points that follow corrections (6 n, c), with or without the lens."""
    n, points = len(network.camera_id), len(network.point_in_world)
    design, modes = jacobian(network), point_modes(network)
    following = design[:, 6 * n :] if lens_follows else design[:, 6 * n : 6 * n + 3 * points]
    follow = np.linalg.lstsq(following, -design[:, : 6 * n] @ corrections, rcond=None)[0][: 3 * points]
    own = [design[:, 6 * n + 3 * j : 6 * n + 3 * j + 3] for j in range(points)]
    gradient = sum(
        m.T @ d.T @ d @ follow[3 * j : 3 * j + 3] for j, (m, d) in enumerate(zip(modes, own, strict=True))
    )
    return np.linalg.solve(sum(m.T @ d.T @ d @ m for m, d in zip(modes, own, strict=True)), gradient)


def point_modes(network: Network) -> np.ndarray:
    """Return ∂(point)/∂(ln s, rotation, translation) of a similarity about the mean camera centre: (N, 3, 7)."""
    arm = network.point_in_world - network.cam_center_in_world.mean(axis=0)
    turns = [np.cross(axis, arm) for axis in np.eye(3)]
    shifts = [np.tile(axis, (len(arm), 1)) for axis in np.eye(3)]
    return np.stack([arm, *turns, *shifts], axis=2)


def test_basis_is_the_root_of_the_full_bundles_covariance() -> None:
    network = exact_network(images=5, points=40)
    # Equal residuals everywhere: the robust weights are all the same, and the two agree but for the hold.
    shifted = replace(network, obs_xy_px=network.obs_xy_px + SIGMA_PX)
    basis = basis_of(shifted)
    whitened = basis.matrix.reshape(30, -1) / units(network)[:, None]
    expected = free_covariance(network) / units(network)[:, None] / units(network)
    shape = whitened @ whitened.T
    shape *= np.trace(expected) / np.trace(shape)
    # The hold of 0.1 distances takes (σ / hold)² from what is worst known: at 1 px (0.4 m / 3.8 m)² = 1 %.
    np.testing.assert_allclose(shape, expected, atol=0.01 * np.abs(expected).max())


@pytest.mark.parametrize("lens_follows", [True, False])
def test_no_correction_moves_the_points_by_a_similarity(lens_follows: bool) -> None:
    network = exact_network()
    # Equal residuals everywhere: the robust weights are all the same, as they are in the design below.
    equal = replace(network, obs_xy_px=network.obs_xy_px + SIGMA_PX)
    basis = basis_of(equal, lens_follows=lens_follows).matrix
    assert basis.shape == (6, 6, 6 * 6 - 7)
    assert np.linalg.matrix_rank(basis.reshape(36, -1) / units(network)[:, None]) == 29
    flat = basis.reshape(36, -1)
    # Both derivatives are numerical, with steps of 1e-6.
    mean = points_follow(network, flat, lens_follows=lens_follows)
    assert np.abs(mean[4:]).max() < 1e-3 * np.abs(flat.reshape(6, 6, -1)[:, 3:]).max()
    assert np.abs(mean[:4]).max() < 1e-3 * np.abs(flat.reshape(6, 6, -1)[:, :3]).max()


def test_lens_follows_as_a_readjustment_with_frozen_cameras_would_have_it() -> None:
    network = exact_network()
    basis = basis_of(replace(network, obs_xy_px=network.obs_xy_px + SIGMA_PX))
    design, flat = jacobian(network), basis.matrix.reshape(36, -1)
    unit = np.linalg.norm(design[:, 36:], axis=0)
    wanted = np.linalg.lstsq(design[:, 36:] / unit, -design[:, :36] @ flat, rcond=None)[0] / unit[:, None]
    # Both derivatives are numerical, with steps of 1e-6.
    np.testing.assert_allclose(basis.lens_matrix, wanted[-4:], atol=1e-4 * np.abs(wanted[-4:]).max(axis=1).min())


def test_a_wrong_focal_length_moves_the_cameras_and_not_the_points() -> None:
    network = exact_network()
    basis = basis_of(replace(network, obs_xy_px=network.obs_xy_px + SIGMA_PX))
    # The correction that is expected of a focal length one σ off.
    focal = basis.lens_matrix[0] / np.linalg.norm(basis.lens_matrix[0])
    moved = (basis.matrix @ focal)[:, 3:]
    along = network.cam_center_in_world - network.point_in_world.mean(axis=0)
    farther = (moved * along).sum(axis=1) / np.linalg.norm(along, axis=1)
    relative = np.linalg.norm(basis.lens_matrix[0]) / network.cameras[1].params[0]
    # A longer lens sees the same from farther away, in proportion; less what the perspective of the scene forbids.
    assert (farther > 0).all()
    assert farther.mean() == pytest.approx(relative * np.linalg.norm(along, axis=1).mean(), rel=0.5)


def test_modes_are_what_a_similarity_does_to_the_pixels() -> None:
    # Moving cameras and points by one similarity leaves all pixels: this fixes signs and axes of the modes.
    network = exact_network()
    pivot = network.cam_center_in_world.mean(axis=0)
    modes = similarity_modes(network.cam_center_in_world)
    for column in range(7):
        step = np.zeros(7)
        step[column] = 1e-4
        arm = network.point_in_world - pivot
        moved = np.exp(step[0]) * arm @ exp_so3(step[1:4]).T + step[4:] - arm
        change = np.concatenate([(modes @ step).ravel(), moved.ravel(), np.zeros(4)])
        # Second order: 1e-8 of 40 m at 500 px over 40 m.
        np.testing.assert_allclose(pixels(network, change), network.obs_xy_px, atol=1e-4)


def test_readjusted_cameras_differ_by_unit_variance() -> None:
    exact = exact_network()
    solve = adjuster(exact)
    squared, sigmas = [], []
    for seed in range(30):
        network = noisy(exact, np.random.default_rng(seed))
        change = solve @ (network.obs_xy_px - exact.obs_xy_px).ravel()
        bundle = bundle_information(readjusted(network, change))
        white = np.linalg.lstsq(
            complete(correction_basis(bundle).matrix, exact), change[:36] / units(exact), rcond=None
        )[0][:29]
        squared.append(white @ white)
        sigmas.append(bundle.sigma_px)
    # 720 coordinates and 220 unknowns: σ̂ is good to 3 % a run, the mean of 30 χ²₂₉ / 29 to 5 %.
    assert np.mean(sigmas) == pytest.approx(SIGMA_PX, rel=0.03)
    assert np.mean(squared) / 29 == pytest.approx(1.0, rel=0.12)


def complete(matrix: np.ndarray, network: Network) -> np.ndarray:
    """Return basis and gauge together (6 n, 6 n), in metres: they span all changes of the cameras."""
    unit = units(network)[:, None]
    modes = similarity_modes(network.cam_center_in_world).reshape(-1, 7)
    return np.hstack([matrix.reshape(len(modes), -1) / unit, modes / unit])


def test_outlying_observations_cost_little() -> None:
    rng = np.random.default_rng(3)
    network = noisy(exact_network(), rng)
    wrong = rng.choice(len(network.obs_xy_px), len(network.obs_xy_px) // 20, replace=False)
    spoilt = network.obs_xy_px.copy()
    spoilt[wrong] += rng.normal(0, 30.0, (len(wrong), 2))
    clean, hit = bundle_information(network), bundle_information(replace(network, obs_xy_px=spoilt))
    # 5 % of the observations at 60 σ: least squares would find 13 times the σ.
    assert hit.sigma_px < 1.4 * clean.sigma_px
    assert np.linalg.norm(correction_basis(hit).matrix) < 1.5 * np.linalg.norm(correction_basis(clean).matrix)


def test_too_few_observations_are_refused() -> None:
    network = exact_network(images=3, points=5)
    with refused("network-undetermined", DegenerateGeometryError) as error:
        basis_of(network)
    assert numbers(str(error.value)) == [15, 3, 5]


def test_points_behind_a_camera_are_left_out() -> None:
    network = noisy(exact_network(), np.random.default_rng(4))
    behind = 2 * network.cam_center_in_world[0] - network.point_in_world.mean(axis=0)
    spoilt = replace(
        network,
        point_in_world=np.vstack([network.point_in_world, behind]),
        obs_point=np.append(network.obs_point, 60),
        obs_image=np.append(network.obs_image, 0),
        obs_xy_px=np.vstack([network.obs_xy_px, [[300.0, 225.0]]]),
    )
    # The lone point has no observation left: it adds three unknowns to the count, and nothing else.
    np.testing.assert_allclose(basis_of(spoilt).matrix, basis_of(network).matrix, rtol=0.02, atol=1e-4)
