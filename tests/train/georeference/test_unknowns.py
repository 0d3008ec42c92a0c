"""Unknowns as tensors: they start at the solution, and their squares are the χ² of the adjustment."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from scipy.sparse import bsr_matrix

from pipelines.adjust.measurements import problem_of
from pipelines.adjust.root import InformationRoot, information_root
from pipelines.adjust.state import State
from pipelines.adjust.system import NormalMatrix, Problem, linearised, minimise, posterior_weights
from pipelines.adjust.terms import Planes
from pipelines.geometry.bundle import similarity_modes
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3, log_so3, skew
from pipelines.geometry.similarity import Similarity
from pipelines.survey.scene import SparseScene, initial_scene
from pipelines.survey.survey import KnownDistance
from pipelines.train.georeference.unknowns import SolutionUnknowns, exp_so3_tensor
from tests.scenes import initial, material, session_of

Every = tuple[SparseScene, Problem, State, NormalMatrix]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_exponential_and_its_derivative(size: float) -> None:
    vector = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * size
    np.testing.assert_allclose(exp_so3_tensor(vector), exp_so3(vector.numpy()), atol=1e-14)
    assert torch.autograd.gradcheck(exp_so3_tensor, (vector.requires_grad_(),))


def solved(*, lidar: bool) -> tuple[SparseScene, Problem, State, NormalMatrix]:
    """Measurements of all kinds, of two sessions, with all systematic errors, at their minimum."""
    _, sparse, survey = material(images=8, points=80)
    images = tuple(
        image.model_copy(update={"fix": image.fix.model_copy(update={"session": index % 2})})
        for index, image in enumerate(survey.images)
        if image.fix is not None
    )
    bar = KnownDistance(ends=survey.control_points[:2], distance_m=20.0, sigma_m=0.5)
    sessions = (session_of(0.02), session_of(2.0))
    survey = survey.model_copy(update={"images": images, "sessions": sessions, "distances": (bar,)})
    scene, rng = initial_scene(sparse, survey, initial()), np.random.default_rng(1)
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = rng.uniform(-30, 30, (20, 3))
    on_plane = scene.geo_from_model.apply(point) + 0.02 * rng.normal(size=(20, 3))
    planes = Planes(point, on_plane, normal, np.full((20, 1, 1), 0.02**2)) if lidar else None
    problem = problem_of(scene, survey, estimate=("lever-arm", "boresight"), planes=planes)
    count = len(scene.sparse.image_name)
    start = State(
        scene.geo_from_model,
        np.zeros((count, 6)),
        np.zeros(len(problem.bundle.sums.lens)),
        np.zeros(len(problem.errors)),
    )
    state = minimise(problem, start).state
    near = linearised(problem, state)
    return scene, problem, state, near.normal(posterior_weights(near.residuals))


@pytest.fixture(scope="module", params=[False, True], ids=["no lidar", "lidar"])
def every(request: pytest.FixtureRequest) -> tuple[SparseScene, Problem, State, NormalMatrix]:
    return solved(lidar=request.param)


def unknowns_of(problem: Problem, state: State, normal: NormalMatrix) -> tuple[SolutionUnknowns, InformationRoot]:
    root = information_root(normal, problem.bundle.followed, problem.lens, len(problem.errors))
    return SolutionUnknowns(problem.base, state, root, problem.lens), root


def at(unknowns: SolutionUnknowns, w: np.ndarray) -> State:
    with torch.no_grad():
        unknowns.w.copy_(torch.from_numpy(w))
    return unknowns.state()


def chi2(problem: Problem, state: State, weights: dict[str, np.ndarray]) -> float:
    """Cost of all observations with weights that stay, the plain way."""
    x, lens, sums = state.correction.ravel(), state.lens, problem.bundle.sums
    of_bundle = x @ (problem.poses @ x) + 2 * x @ (sums.cross @ lens) + lens @ sums.lens @ lens
    residuals = problem.residuals(state)
    return float(of_bundle) + sum(
        float((weights[kind][:, None] * rows**2).sum()) for kind, rows in residuals.items()
    )


def dense(problem: Problem, normal: NormalMatrix) -> np.ndarray:
    """Information on corrections, lens and errors, with the mean of the points written out: dense and slow."""
    n, lenses, count = normal.poses.shape[0], len(problem.lens), len(problem.lens) + len(problem.errors)
    matrix = np.block(
        [[normal.poses.toarray(), normal.border[:count].T], [normal.border[:count], normal.corner[:count, :count]]]
    )
    if len(normal.corner) > count:
        mean = np.zeros((7, n + count))
        mean[:, :n], mean[:, n : n + lenses] = (
            problem.bundle.followed[:, :n],
            problem.bundle.followed[:, n + problem.lens],
        )
        own, across = normal.corner[count : count + 7, count : count + 7], normal.corner[count : count + 7, :count]
        matrix += mean.T @ own @ mean
        matrix[n:] += across.T @ mean
        matrix[:, n:] += mean.T @ across
    return matrix


def test_they_start_at_the_solution(every: Every) -> None:
    _, problem, state, normal = every
    unknowns, _ = unknowns_of(problem, state, normal)
    found = unknowns.state()
    for name in ("correction", "lens", "errors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(state, name))
    np.testing.assert_allclose(found.geo_from_model.matrix(), state.geo_from_model.matrix(), atol=1e-12)
    assert float(unknowns.chi2().detach()) == 0.0


def test_squares_are_the_form_of_the_dense_normal_matrix(every: Every) -> None:
    _, problem, state, normal = every
    unknowns, root = unknowns_of(problem, state, normal)
    matrix, rng = dense(problem, normal), np.random.default_rng(0)
    for _ in range(4):
        w = rng.normal(size=root.size)
        moved = at(unknowns, w)
        common = unknowns.common_motion().detach().numpy()
        x = (moved.correction - state.correction).ravel() + problem.bundle.similarity_modes @ common
        step = np.concatenate([x, (moved.lens - state.lens)[problem.lens], moved.errors - state.errors])
        # The mean similarity of the points follows cameras and lens; what the cameras keep has none.
        lens = moved.lens - state.lens
        np.testing.assert_allclose(
            problem.bundle.followed @ np.concatenate([x, lens]), common, rtol=1e-6, atol=1e-9
        )
        assert step @ matrix @ step == pytest.approx(w @ w, rel=1e-6)


@pytest.mark.parametrize("size", [0.02, 0.2])
def test_value_and_gradient_are_those_of_the_adjustment(every: Every, size: float) -> None:
    """The mean of χ² on both sides of the solution has no first order: what rises is the form."""
    _, problem, state, normal = every
    unknowns, root = unknowns_of(problem, state, normal)
    weights, rng = posterior_weights(problem.residuals(state)), np.random.default_rng(1)
    least = chi2(problem, state, weights)

    def rise(w: np.ndarray) -> float:
        sides = [chi2(problem, at(unknowns, sign * w), weights) for sign in (1, -1)]
        return sum(sides) / 2 - least

    for _ in range(3):
        w, direction = size * rng.normal(size=(2, root.size))
        at(unknowns, w)
        unknowns.zero_grad()
        unknowns.chi2().backward()
        assert unknowns.w.grad is not None
        # Curvature of the measurements at residuals of one σ, and rounding of χ² in the ten thousands.
        assert rise(w) == pytest.approx(w @ w, rel=0.01)
        slope = (rise(w + 0.1 * direction) - rise(w - 0.1 * direction)) / 0.2
        expected = float(unknowns.w.grad.numpy() @ direction)
        assert slope == pytest.approx(expected, abs=0.01 * np.linalg.norm(w) * np.linalg.norm(direction))


def test_one_pose_is_that_among_all_and_is_differentiable(
    every: Every,
) -> None:
    _, problem, state, normal = every
    unknowns, root = unknowns_of(problem, state, normal)
    moved = at(unknowns, np.random.default_rng(2).normal(size=root.size))
    wanted = moved.poses(problem.base)
    for index in (0, 5):
        rotation, center = (each.detach().numpy() for each in unknowns.pose(index))
        np.testing.assert_allclose(rotation, wanted.cam_from_model[index], atol=1e-12)
        np.testing.assert_allclose(center, wanted.cam_center_in_model[index], atol=1e-10)
        pose = unknowns.cam_from_model(index).detach().double().numpy()
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], center, atol=2e-5)  # float32 at 50 m: 4e-6 m

    def values(w: torch.Tensor) -> torch.Tensor:
        unknowns.__dict__["_parameters"]["w"] = w
        similarity = unknowns.similarity()
        one, all_of_them = unknowns.pose(3), unknowns.corrections()
        parts = (*one, all_of_them[1], unknowns.lens(), unknowns.errors(), similarity.scale, similarity.translation)
        return torch.cat([part.reshape(-1) for part in parts])

    w = unknowns.w.detach().clone()
    jacobian = torch.autograd.functional.jacobian(values, w)
    direction = torch.from_numpy(np.random.default_rng(3).normal(size=root.size))
    step = 1e-4
    numeric = (values(w + step * direction) - values(w - step * direction)) / (2 * step)
    np.testing.assert_allclose(jacobian @ direction, numeric, rtol=1e-5, atol=1e-8)


def test_what_moves_the_whole_moves_the_similarity(every: Every) -> None:
    _, problem, state, normal = every
    unknowns, root = unknowns_of(problem, state, normal)
    moved = at(unknowns, np.random.default_rng(4).normal(size=root.size))
    similarity = unknowns.similarity()
    shift = similarity.apply(torch.from_numpy(problem.base.cam_center_in_model)).detach().numpy()
    np.testing.assert_allclose(shift, moved.geo_from_model.apply(problem.base.cam_center_in_model), atol=1e-10)
    away = moved.geo_from_model @ state.geo_from_model.inverse()
    assert 1e-6 < abs(away.scale - 1.0) < 0.1 and np.linalg.norm(log_so3(away.rotation)) < 0.1


def test_frozen_unknowns_stay(every: Every) -> None:
    _, problem, state, _ = every
    frozen = SolutionUnknowns.frozen(problem.base, state)
    assert len(frozen.w) == 0
    np.testing.assert_array_equal(frozen.corrections(), state.correction)
    found = frozen.state()
    np.testing.assert_allclose(found.geo_from_model.matrix(), state.geo_from_model.matrix(), atol=1e-15)


def network(columns: int, rows: int) -> tuple[NormalMatrix, np.ndarray]:
    """Normal matrix of cameras on a grid: a camera sees the same ground as 26 others, and each has a fix."""
    rng, count = np.random.default_rng(0), columns * rows
    row, column = np.divmod(np.arange(count), columns)
    center = 20.0 * np.column_stack([column, row, 0.01 * rng.normal(size=count)])
    steps = [(down, right) for down in range(3) for right in range(-3, 4) if down or right > 0]
    first, second = [], []
    for down, right in steps:
        if 2 * down + abs(right) <= 5:
            there = (row + down < rows) & (column + right >= 0) & (column + right < columns)
            first.append(np.flatnonzero(there))
            second.append(np.flatnonzero(there) + down * columns + right)
    i, j = np.concatenate(first), np.concatenate(second)
    # Each pair measures the pose of one against the other, whatever motion both share.
    seen = rng.normal(size=(len(i), 6, 6)) * [300.0, 300.0, 300.0, 3.0, 3.0, 3.0]
    carried = np.tile(np.eye(6), (len(i), 1, 1))
    carried[:, 3:, :3] = -skew(center[j] - center[i])
    pairs = np.concatenate([seen @ carried, -seen], axis=2)
    blocks = (pairs.swapaxes(1, 2) @ pairs).reshape(-1, 2, 6, 2, 6).swapaxes(2, 3).reshape(-1, 6, 6)
    ends = np.stack([i, j], axis=1)
    own = np.tile(np.diag([1e-6] * 3 + [2500.0] * 3), (count, 1, 1))
    blocks = np.concatenate([blocks, own])
    at_row = np.concatenate([np.repeat(ends, 2, axis=1).ravel(), np.arange(count)])
    at_column = np.concatenate([np.tile(ends, (1, 2)).ravel(), np.arange(count)])
    order = np.lexsort([at_column, at_row])
    starts = np.searchsorted(at_row[order], np.arange(count + 1))
    matrix = bsr_matrix((blocks[order], at_column[order], starts), shape=(6 * count, 6 * count))
    matrix.sum_duplicates()
    followed = np.linalg.pinv(similarity_modes(center).reshape(-1, 7))
    return NormalMatrix(matrix, np.zeros((0, 6 * count)), np.zeros((0, 0)), center), followed


def test_three_thousand_cameras_take_little_memory_and_a_few_milliseconds() -> None:
    (normal, followed), nothing = network(60, 50), np.zeros(0, dtype=np.int64)
    count = len(normal.position)
    root = information_root(normal, followed, nothing, 0)
    assert count == 3000
    assert root.nbytes < 500e6
    poses = CameraPoses(np.tile(np.eye(3), (count, 1, 1)), normal.position)
    state = State(Similarity(), np.zeros((count, 6)), np.zeros(0))
    unknowns, taken = SolutionUnknowns(poses, state, root, nothing), []
    for index in np.random.default_rng(1).integers(0, count, 9).tolist():
        began = time.process_time()
        (unknowns.chi2() + unknowns.cam_from_model(index).sum()).backward()
        taken.append(time.process_time() - began)
    # 5 ms of one processor of 2024, forward and backward; a dense basis of so many would take 2.6 GB and 0.2 s.
    assert np.median(taken) < 0.05
    moved = at(unknowns, np.random.default_rng(2).normal(size=root.size))
    whole = root.modes.reshape(-1, 7) @ unknowns.common_motion().detach().numpy()
    x = moved.correction.ravel() + whole
    assert x @ (normal.poses @ x) == pytest.approx(float(unknowns.chi2().detach()), rel=1e-8)
