"""Covariances of the cameras on Earth: against plain differences, and against the errors that they predict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.camera_covariance import camera_covariances
from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.posterior import FreeLens, minimise, posterior
from pipelines.adjust.problem import GeoProblem
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import perturbation
from tests.georef_scenes import draw_truth, fixes_of, make_block, marks_of, problem_of

pytestmark = pytest.mark.usefixtures("one_thread")
CAMERAS = 6
BLOCK = make_block(CAMERAS)
CONTROL = np.array([[-15.0, -15, 0], [15, -12, 1], [12, 15, 2], [-14, 13, 0.5], [0, 0, 3]])


def covariances(problem: GeoProblem, lens: FreeLens | None = None) -> np.ndarray:
    similarity, cameras = problem.similarity.current(), problem.cameras
    center = similarity.apply(cameras.current().cam_center_in_model)
    return camera_covariances(posterior(problem, lens), center, similarity, cameras.basis.numpy())


def on_earth(problem: GeoProblem, delta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres in geo with all unknowns changed: (δ ln s, δω, δt) about the pivot, then z."""
    cameras = problem.cameras
    moved = CameraCorrections(
        type(BLOCK.poses)(cameras.rotation.numpy(), cameras.center.numpy()), cameras.basis.numpy()
    )
    with torch.no_grad():
        moved.z.copy_(cameras.z + torch.from_numpy(delta[7:]))
    similarity = perturbation(delta[:7], problem.similarity.pivot_in_geo) @ problem.similarity.current()
    poses = moved.current()
    return similarity.rotation @ np.swapaxes(poses.cam_from_model, 1, 2), similarity.apply(
        poses.cam_center_in_model
    )


@pytest.mark.parametrize("held", [False, True], ids=["corrected", "held"])
def test_covariance_is_that_of_differences_by_every_unknown(held: bool) -> None:
    rng = np.random.default_rng(0)
    truth = draw_truth(BLOCK, rng)
    block = replace(BLOCK, basis=BLOCK.basis[:, :, :0]) if held else BLOCK
    problem = problem_of(
        block, fixes_of(truth, np.array([0.02, 0.02, 0.03]), rng), marks_of(truth, CONTROL, 0.02, rng)
    )
    minimise(problem)
    joint = posterior(problem)
    jacobian = np.empty((CAMERAS, 6, len(joint.covariance)))
    for column, step in enumerate(np.eye(len(joint.covariance)) * 1e-5):
        (ahead, center_ahead), (behind, center_behind) = on_earth(problem, step), on_earth(problem, -step)
        jacobian[:, :3, column] = log_so3(ahead @ np.swapaxes(behind, 1, 2)) / 2e-5
        jacobian[:, 3:, column] = (center_ahead - center_behind) / 2e-5
    expected = jacobian @ joint.covariance @ np.swapaxes(jacobian, 1, 2)
    scale = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    units = scale[:, :, None] * scale[:, None]
    # Corrections already made turn the axes of further ones: by 1e-3 rad at most, in a product of two.
    np.testing.assert_allclose(covariances(problem) / units, expected / units, atol=2e-3)


def test_rest_of_the_lens_moves_no_camera_but_shares_the_control_points() -> None:
    rng = np.random.default_rng(1)
    truth = draw_truth(BLOCK, rng)
    problem = problem_of(
        BLOCK, fixes_of(truth, np.array([0.5, 0.5, 1.0]), rng), marks_of(truth, CONTROL, 0.02, rng)
    )
    minimise(problem)
    lens = FreeLens(np.eye(2) * 1e-4, rng.normal(size=(len(CONTROL), 3, 2)))
    without, shared = covariances(problem), covariances(problem, lens)
    assert shared.shape == (CAMERAS, 6, 6)
    # Control points that an unknown lens shifts leave the cameras less certain.
    assert (np.diagonal(shared - without, axis1=1, axis2=2) > 0).all()


def test_errors_of_drawn_surveys_are_as_large_as_predicted() -> None:
    squared = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        truth = draw_truth(BLOCK, rng)
        problem = problem_of(BLOCK, fixes_of(truth, np.array([0.1, 0.1, 0.2]), rng))
        minimise(problem)
        rotation, center = on_earth(problem, np.zeros(7 + len(problem.cameras.z)))
        true_rotation = truth.geo_from_model.rotation @ np.swapaxes(truth.poses.cam_from_model, 1, 2)
        error = np.concatenate(
            [
                log_so3(rotation @ np.swapaxes(true_rotation, 1, 2)),
                center - truth.geo_from_model.apply(truth.poses.cam_center_in_model),
            ],
            axis=1,
        )
        squared.append((error**2 / np.diagonal(covariances(problem), axis1=1, axis2=2)).mean(axis=0))
    # 16 runs, whose six cameras share a similarity: at least 32 independent values an axis, σ of the mean 0.25.
    np.testing.assert_allclose(np.mean(squared, axis=0), 1.0, atol=0.75)
    assert np.mean(squared) == pytest.approx(1.0, abs=0.3)
