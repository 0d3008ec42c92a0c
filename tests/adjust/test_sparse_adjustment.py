"""Sparse adjustment of cameras and similarity, against the dense one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from pipelines.adjust.camera_covariance import camera_covariances
from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.intersection_jacobian import intersection_jacobian
from pipelines.adjust.posterior import FreeLens, minimise, posterior
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.sparse_adjustment import minimise_sparse
from pipelines.adjust.sparse_posterior import SparsePosterior
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import ControlTerm, FixTerm
from pipelines.geometry.bundle import Network
from pipelines.geometry.bundle_information import BundleInformation, bundle_information
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.correction_basis import CorrectionBasis, correction_basis
from pipelines.geometry.lens import Lenses, bearings
from pipelines.geometry.similarity import Similarity
from tests.bundle_scenes import LENS, exact_network, noisy, pixels, size
from tests.georef_scenes import terms

pytestmark = pytest.mark.usefixtures("one_thread")
IMAGES, MARK_PX = 8, 0.3
EXACT = exact_network(images=IMAGES)
START = np.diag([0.01, 0.02, 0.02, 0.02, 2.0, 2.0, 2.0]) ** 2
PLACES = np.random.default_rng(5).uniform([-8, -8, -4], [8, 8, 6], (6, 3))


def marked(points: np.ndarray, network: Network) -> Network:
    """Points that all cameras see, at their exact pixels."""
    seen = replace(
        network,
        point_in_world=points,
        obs_point=np.repeat(np.arange(len(points)), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), len(points)),
        obs_xy_px=np.zeros((len(points) * IMAGES, 2)),
    )
    return replace(seen, obs_xy_px=pixels(seen, np.zeros(size(seen))))


@dataclass(frozen=True)
class Survey:
    """A bundle with fixes and control points, as the dense and the sparse solver take it."""

    network: Network
    fixes: FixTerm
    control: ControlTerm | None
    errors: int = 0
    hold_prior: bool = False

    def problem(self, basis: CorrectionBasis | None, *, follows: bool) -> GeoProblem:
        center = self.network.cam_center_in_world
        matrix = np.zeros((len(center), 6, 0)) if basis is None else basis.matrix
        poses = CameraPoses(self.network.cam_from_world, center)
        lens = basis.lens_matrix if basis is not None and follows else None
        return GeoProblem(
            LearnableSimilarity(Similarity(), START, center.mean(axis=0)),
            CameraCorrections(poses, matrix, lens),
            terms(self.fixes, self.control),
            hold_prior=self.hold_prior,
            errors=SystematicErrors(self.errors),
        )


def make_survey(seed: int, sigma_m: float, *, control: bool = True, errors: int = 0, hold: bool = False) -> Survey:
    rng = np.random.default_rng(seed)
    network = noisy(EXACT, rng)
    center = EXACT.cam_center_in_world
    position = center + 0.3 * bool(errors) + rng.normal(0, sigma_m, center.shape)
    position[3] += 20 * sigma_m  # an outlier, so that the weights count
    fixes = FixTerm(
        torch.arange(IMAGES),
        torch.from_numpy(position),
        torch.from_numpy(np.tile(np.eye(3) / sigma_m, (IMAGES, 1, 1))),
    )
    seen = marked(PLACES, network)
    xy_px = seen.obs_xy_px + rng.normal(0, MARK_PX, seen.obs_xy_px.shape)
    cov = intersection_jacobian(seen, np.full(len(xy_px), MARK_PX)).cov_of_marks + 0.02**2 * np.eye(3)
    marks = ControlTerm(
        torch.from_numpy(seen.obs_point),
        torch.from_numpy(seen.obs_image),
        torch.from_numpy(bearings(LENS, xy_px)),
        torch.full((len(xy_px),), MARK_PX / LENS.params[0], dtype=torch.float64),
        torch.from_numpy(PLACES + rng.normal(0, 0.02, PLACES.shape)),
        torch.from_numpy(np.linalg.inv(np.linalg.cholesky(cov))),
        bearing_by_lens=torch.from_numpy(
            Lenses(seen.cameras, seen.camera_id).bearing_jacobian(seen.obs_image, xy_px)
        ),
    )
    return Survey(network, fixes, marks if control else None, errors, hold)


CASES = {
    "fixes": (make_survey(0, 0.03, control=False), True),
    "fixes and control points": (make_survey(1, 0.03), True),
    "biased fixes": (make_survey(3, 0.03, errors=1), True),
    "held similarity": (make_survey(4, 1.5, control=False, hold=True), True),
    "held lens": (make_survey(5, 0.03), False),
}


def solved(survey: Survey, follows: bool) -> tuple[GeoProblem, CorrectionBasis, BundleInformation, float]:
    basis = correction_basis(survey.network, lens_follows=follows)
    problem = survey.problem(basis, follows=follows)
    cost = minimise(problem)
    return problem, basis, bundle_information(survey.network, lens_follows=follows), cost


@pytest.mark.parametrize("case", CASES)
def test_sparse_minimum_and_covariances_are_those_of_the_dense_solver(case: str) -> None:
    survey, follows = CASES[case]
    dense, basis, bundle, cost = solved(survey, follows)
    problem = survey.problem(None, follows=follows)
    minimum = minimise_sparse(problem, bundle, lens_follows=follows)
    state = minimum.state
    assert minimum.cost == pytest.approx(cost, abs=1e-4)
    with torch.no_grad():
        corrections, lens = dense.cameras.corrections().numpy(), dense.cameras.lens().numpy()
    sigma = np.sqrt(np.diag(posterior(dense).covariance)[:7])
    y = problem.similarity.root.numpy() @ (state.similarity - dense.similarity.y.detach().numpy())
    # The dense solver ends at a step of 1e-4 σ.
    assert np.abs(y / sigma).max() < 1e-3
    of_pose = np.linalg.norm(basis.matrix, axis=2)
    assert np.abs((state.correction - corrections) / of_pose).max() < 1e-3
    if follows:
        assert np.abs((state.lens - lens) / np.linalg.norm(basis.lens_matrix, axis=1)).max() < 1e-3
    np.testing.assert_allclose(state.errors, dense.errors.vector().detach().numpy(), atol=1e-4)

    by_lens = None
    if survey.control is not None:
        marks = marked(PLACES, survey.network)
        by_lens = intersection_jacobian(marks, np.full(len(marks.obs_point), MARK_PX)).by_lens
    free = FreeLens(bundle.lens_cov, np.zeros((0, 3, len(bundle.lens))) if by_lens is None else by_lens)
    expected, found = posterior(dense, free), SparsePosterior(problem, bundle, state, by_lens)
    check = marked(PLACES + np.array([0.5, 1.0, 0.5]), survey.network)
    moved = intersection_jacobian(check, np.full(len(check.obs_point), MARK_PX))
    by_cameras = moved.by_corrections(basis.matrix)
    if follows:
        by_cameras = by_cameras + moved.by_lens @ basis.lens_matrix
        # The two weight the observations at states that differ by 1e-4 σ.
        close(found.of_similarity(), expected.covariance[:7, :7])
        close(
            found.at(check.point_in_world, moved.by_poses, moved.by_lens),
            expected.at(check.point_in_world, by_cameras, moved.by_lens),
        )
    geo_from_model, center = Similarity(1.02), survey.network.cam_center_in_world
    close(
        found.of_cameras(center, geo_from_model),
        camera_covariances(expected, center, geo_from_model, basis.matrix),
    )


def close(found: np.ndarray, expected: np.ndarray) -> None:
    """Compare covariances relative to their σ."""
    sigma = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    relative = (found - expected) / sigma[..., :, None] / sigma[..., None, :]
    assert np.abs(relative).max() < 1e-3
