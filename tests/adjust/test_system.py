"""The one system: slopes against differences, minima and covariances against a plain dense adjustment."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest

from pipelines.adjust.posterior import camera_covariances
from pipelines.adjust.state import State, SystematicError, SystematicErrors
from pipelines.adjust.system import Minimum, NormalMatrix, Problem, linearised, minimise
from pipelines.adjust.terms import (
    Attitudes,
    CommonErrors,
    ControlPoints,
    Distances,
    Fixes,
    Level,
    MarkedTerm,
    Planes,
    Term,
)
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.geometry.cameras import CameraPoses, Lenses, bearings
from pipelines.geometry.intersection import intersection_jacobian
from pipelines.geometry.network import Network
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, perturbation
from tests.bundle_scenes import (
    LENS,
    SIGMA_PX,
    adjuster,
    exact_network,
    jacobian,
    noisy,
    pixels,
    readjusted,
    size,
    stated_information,
)
from tests.raw_bundle import SurveyedPoints, adjust_bundle
from tests.refusals import numbers, refused

pytestmark = pytest.mark.usefixtures("one_thread")
IMAGES, POINTS, LENSES = 6, 24, 4
EXACT = exact_network(images=IMAGES, points=POINTS)
SOLVE = adjuster(EXACT)
CONTROL = np.array([[-8.0, -7, -4], [8, -6, 3], [7, 8, -2], [-7, 6, 4], [0, 1, 2]])
ERRORS = SystematicErrors(
    (
        SystematicError("bias", (0.05, 0.05, 0.08), 0),
        SystematicError("bias", (0.03, 0.03, 0.05), 1),
        SystematicError("lever-arm", (1.0, 1.0, 1.0)),
        SystematicError("boresight", (0.05, 0.05, 0.05)),
        SystematicError("common", (0.02, 0.02, 0.02)),
        SystematicError("lidar-shift", (1.0, 1.0, 1.0)),
    )
)
GEO_FROM_MODEL = Similarity(1.3, exp_so3([0.3, -0.2, 1.1]), np.array([40.0, -20.0, 300.0]))
SMALL = 1e-3  # of σ: errors so small that their squares do not count, and that no kernel lowers a weight


def measured(
    network: Network, geo_from_model: Similarity, rng: np.random.Generator, part: float
) -> dict[str, Term]:
    """Terms of all kinds about the cameras of a network, with noise of a part of their σ."""
    poses = CameraPoses(network.cam_from_world, network.cam_center_in_world)
    camera, half = np.arange(IMAGES), np.arange(IMAGES) * 2 // IMAGES
    position = geo_from_model.apply(poses.cam_center_in_model)
    names = tuple(map(str, camera))
    cov = np.diag([0.02, 0.02, 0.03]) ** 2 + 1e-5
    fixes = Fixes(
        names,
        camera,
        position + part * rng.normal(size=(IMAGES, 3)) @ np.linalg.cholesky(cov).T,
        np.tile(cov, (IMAGES, 1, 1)),
        half,
    )
    turned = geo_from_model.rotation @ np.swapaxes(poses.cam_from_model, 1, 2)
    recorded = turned @ exp_so3(part * 0.01 * rng.normal(size=(IMAGES, 3)))
    attitudes = Attitudes(names, camera, recorded, np.tile(0.01**2 * np.eye(3), (IMAGES, 1, 1)))
    surface = network.point_in_world[:10]
    normal = rng.normal([0, 0, 2], 1, (10, 3))
    planes = Planes(
        surface,
        geo_from_model.apply(surface) + part * 0.03 * rng.normal(size=(10, 3)),
        normal / np.linalg.norm(normal, axis=1, keepdims=True),
        np.full((10, 1, 1), 0.03**2),
    )
    control = control_points(network, geo_from_model, rng, part)
    pairs = len(CONTROL) // 2
    apart = geo_from_model.apply(CONTROL[: 2 * pairs]).reshape(-1, 2, 3)
    true_m = np.linalg.norm(apart[:, 0] - apart[:, 1], axis=1)
    ends = control.point < 2 * pairs
    distances = Distances(
        tuple(map(str, range(pairs))),
        *(getattr(control, of_mark)[ends] for of_mark in ("point", "camera", "bearing_in_cam", "sigma_rad")),
        control.bearing_by_lens[ends],
        true_m + part * 0.005 * rng.normal(size=pairs),
        np.full((pairs, 1, 1), 0.01**2),
    )
    terms = (fixes, control, distances, attitudes, planes)
    return {term.kind: term for term in terms}


def control_points(
    network: Network, geo_from_model: Similarity, rng: np.random.Generator, part: float
) -> ControlPoints:
    """Control points that all cameras of a network see, marks and survey with noise of a part of their σ."""
    seen = seeing(network, CONTROL)
    xy_px = seen.obs_xy_px + part * rng.normal(0, 0.3, seen.obs_xy_px.shape)
    by_lens = Lenses(seen.cameras, seen.camera_id).bearing_jacobian(seen.obs_image, xy_px)
    return ControlPoints(
        tuple(map(str, range(len(CONTROL)))),
        seen.obs_point,
        seen.obs_image,
        bearings(seen.cameras[1], xy_px),
        np.full(len(xy_px), 0.3 / LENS.params[0]) * rng.uniform(0.5, 1.5, len(xy_px)),
        by_lens,
        geo_from_model.apply(CONTROL) + part * 0.02 * rng.normal(size=CONTROL.shape),
        np.tile(np.diag([0.02, 0.02, 0.04]) ** 2, (len(CONTROL), 1, 1)),
    )


def seeing(network: Network, points: np.ndarray) -> Network:
    """The network of points that all cameras see, at their exact pixels."""
    count = len(points)
    seen = replace(
        network,
        point_in_world=points,
        obs_point=np.repeat(np.arange(count), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), count),
        obs_xy_px=np.zeros((count * IMAGES, 2)),
    )
    return replace(seen, obs_xy_px=pixels(seen, np.zeros(size(seen))))


def poses_of(network: Network) -> CameraPoses:
    return CameraPoses(network.cam_from_world, network.cam_center_in_world)


def problem_of(
    network: Network, terms: tuple[Term, ...], errors: SystematicErrors, *, frozen: bool = False
) -> Problem:
    bundle = stated_information(network, np.full(len(network.obs_point), SIGMA_PX))
    return Problem(poses_of(network), bundle, terms, errors, lens_frozen=frozen)


def start_of(problem: Problem, geo_from_model: Similarity) -> State:
    return State(geo_from_model, np.zeros((IMAGES, 6)), np.zeros(LENSES), np.zeros(len(problem.errors)))


def of_kinds(*names: str) -> SystematicErrors:
    return SystematicErrors(tuple(block for block in ERRORS.blocks if block.name in names))


# Slopes.


def differences(function: Callable[[np.ndarray], np.ndarray], count: int, step: float) -> np.ndarray:
    """Derivatives (..., count) of a function of a vector at zero, by central differences of fourth order."""
    columns = []
    for unit in np.eye(count) * step:
        near, far = ((function(k * unit) - function(-k * unit)) / (2 * k * step) for k in (1, 2))
        columns.append((4 * near - far) / 3)
    return np.stack(columns, axis=-1)


def at_a_random_state(kind: str, seed: int) -> tuple[Problem, State, Term]:
    """A term of a problem, at a state whose corrections, lens and errors are large."""
    rng = np.random.default_rng(seed)
    state = State(
        GEO_FROM_MODEL,
        np.column_stack([rng.uniform(-1e-2, 1e-2, (IMAGES, 3)), rng.normal(0, 0.3, (IMAGES, 3))]),
        rng.normal(0, [5.0, 2.0, 2.0, 0.01]),
        rng.normal(0, 0.3, len(ERRORS)),
    )
    of_kind = measured(EXACT, GEO_FROM_MODEL, rng, 1.0) if kind != CommonErrors.kind else {}
    if kind == Level.kind:  # half a radian off
        up = exp_so3([0.3, -0.4, 0.1]) @ GEO_FROM_MODEL.rotation[2]
        of_kind = {kind: Level(up[None], np.linalg.svd(up[None])[2][None, 1:], 0.05**2 * np.eye(2)[None])}
    problem = problem_of(EXACT, tuple(term for name, term in of_kind.items() if name == kind), ERRORS)
    term = problem.term(kind)
    assert term is not None
    if isinstance(term, MarkedTerm):  # whose rays meet: the weights of the rays are those of the distances there
        poses = state.poses(problem.base)
        ray = CONTROL[term.point] - poses.cam_center_in_model[term.camera]
        bearing = np.einsum("kij,kj->ki", poses.cam_from_model[term.camera], ray)
        bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
        term = replace(term, bearing_in_cam=bearing - term.bearing_by_lens @ state.lens)
    return problem, state, term


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "kind", [t.kind for t in (Fixes, ControlPoints, Distances, Attitudes, Planes, Level, CommonErrors)]
)
def test_slopes_are_the_derivatives_of_the_residuals(kind: str, seed: int) -> None:
    problem, state, term = at_a_random_state(kind, seed)
    slopes = term.slopes(problem.at(state))
    np.testing.assert_array_equal(slopes.residual, term.residuals(problem.at(state)))

    def moved(pose: np.ndarray, lens: np.ndarray, errors: np.ndarray) -> np.ndarray:
        moved_state = replace(
            state,
            correction=state.correction + pose.reshape(-1, 6),
            lens=state.lens + lens,
            errors=state.errors + errors,
        )
        return term.residuals(problem.at(moved_state))

    no_pose, no_lens, no_errors = np.zeros(6 * IMAGES), np.zeros(LENSES), np.zeros(len(ERRORS))
    by_pose = np.zeros((len(term), term.dimension, 6 * IMAGES))
    for row, camera, block in zip(slopes.row, slopes.camera, slopes.by_pose, strict=True):
        by_pose[row, :, 6 * camera : 6 * camera + 6] += block
    close(by_pose, differences(lambda step: moved(step, no_lens, no_errors), 6 * IMAGES, 1e-3))
    close(slopes.by_errors, differences(lambda step: moved(no_pose, no_lens, step), len(ERRORS), 1e-3))
    of_lens = differences(lambda step: moved(no_pose, step * LENS_UNIT, no_errors), LENSES, 1e-3) / LENS_UNIT
    close(slopes.by_lens * LENS_UNIT, of_lens * LENS_UNIT)
    if slopes.by_similarity is not None:
        center = problem.at(state).center.mean(axis=0)

        def carried(step: np.ndarray) -> np.ndarray:
            similar = replace(state, geo_from_model=state.geo_from_model @ perturbation(step, center))
            return term.residuals(problem.at(similar))

        close(slopes.by_similarity, differences(carried, 7, 1e-3))


LENS_UNIT = np.array([100.0, 100.0, 100.0, 0.1])  # that move a pixel alike


def close(found: np.ndarray, expected: np.ndarray) -> None:
    """Compare derivatives relative to the largest."""
    np.testing.assert_allclose(found, expected, atol=1e-6 * max(np.abs(expected).max(initial=0.0), 1e-9))


def test_control_points_lie_where_their_rays_have_the_least_angles() -> None:
    network = readjusted(noisy(EXACT, np.random.default_rng(3)), np.zeros(size(EXACT)))
    term = control_points(network, Similarity(), np.random.default_rng(3), 1.0)
    problem = problem_of(network, (term,), SystematicErrors())
    found = term.residuals(problem.at(start_of(problem, Similarity()))) + term.position_in_geo
    poses = poses_of(network)
    ray = np.einsum("kji,kj->ki", poses.cam_from_model[term.camera], term.bearing_in_cam)

    def angles(point: np.ndarray) -> np.ndarray:
        arm = (found + point.reshape(-1, 3))[term.point] - poses.cam_center_in_model[term.camera]
        across = np.cross(ray, arm / np.linalg.norm(arm, axis=1, keepdims=True)) / term.sigma_rad[:, None]
        return across.ravel()

    design = differences(angles, found.size, 1e-3)
    step = np.linalg.lstsq(design, -angles(np.zeros(found.size)), rcond=None)[0]
    sigma = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    # The weights hold the distances of rays that do not quite meet: an effect of second order.
    assert np.abs(step / sigma).max() < 0.02


# Minimum and covariances.


@dataclass(frozen=True)
class Dense:
    """The plain adjustment: all poses, points, lens and errors are unknowns, all derivatives are differences."""

    network: Network
    problem: Problem

    @property
    def poses(self) -> int:
        return 6 * IMAGES

    @cached_property
    def follows(self) -> np.ndarray:
        """Mean similarity (7, 6 n + L) of the points that follow cameras and lens, by their information."""
        design = jacobian(self.network) / SIGMA_PX
        n, points = self.poses, 3 * POINTS
        rest, of_points = np.delete(design, np.s_[n : n + points], axis=1), design[:, n : n + points]
        followed = -np.linalg.lstsq(of_points, rest, rcond=None)[0]
        arm = self.network.point_in_world - self.network.cam_center_in_world.mean(axis=0)
        modes = np.zeros((POINTS, 3, 7))
        modes[:, :, 0], modes[:, :, 4:] = arm, np.eye(3)
        modes[:, :, 1:4] = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
        modes = modes.reshape(points, 7)
        return np.linalg.lstsq(of_points @ modes, of_points @ followed, rcond=None)[0]

    def residuals(self, change: np.ndarray, geo_from_model: Similarity) -> np.ndarray:
        """Whitened residuals of all observations after a change of all unknowns."""
        width = self.poses + 3 * POINTS + LENSES
        of_images, errors = change[:width], change[width:]
        pose, lens = of_images[: self.poses], of_images[-LENSES:]
        parts = [((pixels(self.network, of_images) - self.network.obs_xy_px) / SIGMA_PX).ravel()]
        state = State(geo_from_model, pose.reshape(-1, 6), lens, errors)
        for term in self.problem.terms:
            at = self.problem.at(state)
            if isinstance(term, Planes):  # on points that follow
                mean = self.follows @ np.concatenate([pose, lens])
                center = self.network.cam_center_in_world.mean(axis=0)
                at = replace(at, geo_from_model=geo_from_model @ perturbation(mean, center))
            parts.append(term.whitened(at).ravel())
        return np.concatenate(parts)

    def solved(self, geo_from_model: Similarity) -> tuple[np.ndarray, np.ndarray]:
        """Change of all unknowns at the minimum, and their covariance."""
        width = self.poses + 3 * POINTS + LENSES + len(self.problem.errors)
        unit = np.ones(width)
        unit[: self.poses] = np.tile([1e-2] * 3 + [1.0] * 3, IMAGES)
        unit[self.poses + 3 * POINTS :][:LENSES] = LENS_UNIT
        change = np.zeros(width)
        open_ = np.arange(width)
        if self.problem.lens_frozen:
            open_ = np.delete(open_, self.poses + 3 * POINTS + np.arange(LENSES))
        for _ in range(2):
            columns = []
            for column in np.eye(width)[open_] * 1e-4 * unit:
                ahead, behind = (self.residuals(change + sign * column, geo_from_model) for sign in (1, -1))
                columns.append((ahead - behind) / 2e-4)
            design = np.stack(columns, axis=1)
            step = np.linalg.lstsq(design, -self.residuals(change, geo_from_model), rcond=1e-14)[0]
            change[open_] += step * unit[open_]
        covariance = np.zeros((width, width))
        root = np.linalg.pinv(design, rcond=1e-14) * unit[open_, None]
        covariance[np.ix_(open_, open_)] = root @ root.T
        return change, covariance


CASES: dict[str, tuple[tuple[str, ...], SystematicErrors, bool]] = {
    "fixes": ((Fixes.kind,), of_kinds(), False),
    "control points": ((ControlPoints.kind,), of_kinds(), False),
    "two sessions": ((Fixes.kind, ControlPoints.kind), of_kinds("bias"), False),
    "lever arm": ((Fixes.kind, ControlPoints.kind), of_kinds("bias", "lever-arm"), False),
    "attitudes": ((Fixes.kind, Attitudes.kind), of_kinds("boresight", "common"), False),
    "distances": ((Fixes.kind, Distances.kind), of_kinds("bias"), False),
    "lidar": ((Fixes.kind, Planes.kind), of_kinds("lidar-shift"), False),
    "frozen lens": ((Fixes.kind, ControlPoints.kind), of_kinds("bias"), True),
    "frozen lens, fixes": ((Fixes.kind,), of_kinds(), True),
}


@dataclass(frozen=True)
class Case:
    """A problem with small errors, and its state before the adjustment."""

    network: Network
    problem: Problem
    start: State


def case_of(name: str, geo_from_model: Similarity = GEO_FROM_MODEL) -> Case:
    kinds, errors, frozen = CASES[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    drawn = replace(EXACT, obs_xy_px=EXACT.obs_xy_px + SMALL * rng.normal(0, SIGMA_PX, EXACT.obs_xy_px.shape))
    network = EXACT
    for _ in range(3):  # at the minimum of the image observations
        left = drawn.obs_xy_px - pixels(network, np.zeros(size(network)))
        network = replace(readjusted(network, SOLVE @ left.ravel()), obs_xy_px=drawn.obs_xy_px)
    terms = measured(EXACT, geo_from_model, rng, SMALL)
    problem = problem_of(network, tuple(terms[kind] for kind in kinds), errors, frozen=frozen)
    return Case(network, problem, start_of(problem, geo_from_model))


def ones(problem: Problem) -> dict[str, np.ndarray]:
    return {term.kind: np.ones(len(term)) for term in problem.terms}


@pytest.mark.parametrize("name", CASES)
def test_minimum_and_covariances_are_those_of_the_plain_adjustment(name: str) -> None:
    case = case_of(name)
    problem, network = case.problem, case.network
    dense = Dense(network, problem)
    change, covariance = dense.solved(GEO_FROM_MODEL)
    sigma = np.sqrt(np.diag(covariance))
    n, lens_at = dense.poses, dense.poses + 3 * POINTS
    minimum = minimise(problem, case.start)
    state = minimum.state

    # The same cameras on Earth, lens and errors; all changes are of the size SMALL σ.
    there = State(GEO_FROM_MODEL, change[:n].reshape(-1, 6), change[lens_at:][:LENSES], change[lens_at + LENSES :])
    axes = np.repeat(GEO_FROM_MODEL.rotation[None], IMAGES, axis=0)
    apart = np.einsum("nji,nj->ni", axes, on_earth(problem, state)[1] - on_earth(problem, there)[1])
    turn = on_earth(problem, state)[0] @ np.swapaxes(on_earth(problem, there)[0], 1, 2)
    turned = np.einsum("nji,nj->ni", axes, log_so3(turn))
    missed = np.column_stack([turned, apart / GEO_FROM_MODEL.scale]) / sigma[:n].reshape(-1, 6)
    assert np.abs(missed).max() < 1e-2 * SMALL
    np.testing.assert_allclose(state.errors, there.errors, atol=1e-2 * SMALL * 0.1)
    if not problem.lens_frozen:
        assert np.abs((state.lens - there.lens) / sigma[lens_at:][:LENSES]).max() < 1e-2 * SMALL
    expected = (dense.residuals(change, GEO_FROM_MODEL) ** 2).sum()
    assert minimum.cost == pytest.approx(expected - at_the_bundle(network), rel=1e-2)

    # The same covariances: of cameras, errors, lens, similarity, and of points that no tie observation knows.
    normal = linearised(problem, state).normal(ones(problem))
    of_errors = covariance[lens_at + LENSES :, lens_at + LENSES :]
    close_in_sigma(normal.of_errors(len(problem.lens), len(problem.errors)), of_errors)
    own = np.array([covariance[i : i + 6, i : i + 6] for i in range(0, n, 6)])
    cameras = camera_covariances(normal, np.eye(3), 1.0)
    for found, want in zip(cameras, own, strict=True):
        close_in_sigma(found, want)
    rest = np.r_[:n, lens_at : lens_at + LENSES]
    outer = covariance[np.ix_(rest, rest)]
    close_in_sigma(of_linear(normal, problem, problem.bundle.followed), dense.follows @ outer @ dense.follows.T)
    moved = intersection_jacobian(seeing(network, CONTROL + 1.0), np.ones(IMAGES * len(CONTROL)))
    by_unknowns = np.concatenate([moved.by_poses.toarray(), moved.by_lens.reshape(-1, LENSES)], axis=1)
    close_in_sigma(of_linear(normal, problem, by_unknowns), by_unknowns @ outer @ by_unknowns.T)


def test_threads_may_share_a_normal_matrix() -> None:
    """LAPACK's wrapper of SciPy changes the pivots that it is given while it solves."""
    case = case_of(next(name for name, (_, errors, _) in CASES.items() if errors))
    normal = linearised(case.problem, case.start).normal(ones(case.problem))
    lens, errors = len(case.problem.lens), len(case.problem.errors)
    alone = normal.of_errors(lens, errors)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: normal.of_errors(lens, errors), range(2000)))
    assert all(np.array_equal(each, alone) for each in found)


def of_linear(normal: NormalMatrix, problem: Problem, by_unknowns: np.ndarray) -> np.ndarray:
    """Covariance of quantities with derivatives (m, 6 n + L)."""
    n = 6 * IMAGES
    by_border = np.zeros((len(by_unknowns), len(normal.corner)))
    by_border[:, : len(problem.lens)] = by_unknowns[:, n + problem.lens]
    return normal.covariance(by_unknowns[:, :n], by_border)


def at_the_bundle(network: Network) -> float:
    """Squares of the image observations at their own minimum, which a problem does not count."""
    return float((((pixels(network, np.zeros(size(network))) - network.obs_xy_px) / SIGMA_PX) ** 2).sum())


def on_earth(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Rotations geo ← cam and centres in geo."""
    poses = state.poses(problem.base)
    turned = state.geo_from_model.rotation @ np.swapaxes(poses.cam_from_model, 1, 2)
    return turned, state.geo_from_model.apply(poses.cam_center_in_model)


def close_in_sigma(found: np.ndarray, expected: np.ndarray) -> None:
    """Compare covariances relative to their σ."""
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=6e-4)


# Frames.


@pytest.mark.parametrize("name", ["two sessions", "lidar", "lever arm"])
def test_frame_of_the_cameras_does_not_matter(name: str) -> None:
    case = case_of(name)
    new_from_old = Similarity(0.4, exp_so3([1.0, 0.5, -2.0]), np.array([5.0, 2.0, -9.0]))
    turn = new_from_old.rotation
    poses = CameraPoses(
        case.problem.base.cam_from_model @ turn.T, new_from_old.apply(case.problem.base.cam_center_in_model)
    )
    bundle = case.problem.bundle.turned(new_from_old, poses.cam_center_in_model)
    network = replace(
        case.network,
        cam_from_world=poses.cam_from_model,
        cam_center_in_world=poses.cam_center_in_model,
        point_in_world=new_from_old.apply(case.network.point_in_world),
    )
    again = stated_information(network, np.full(len(network.obs_point), SIGMA_PX))
    for part in ("poses", "cross", "lens", "pose_modes", "lens_modes", "modes"):
        ours, expected = (getattr(each.sums, part) for each in (bundle, again))
        dense = [each.toarray() if part == "poses" else each for each in (ours, expected)]
        np.testing.assert_allclose(*dense, atol=1e-6 * np.abs(dense[1]).max())
    np.testing.assert_allclose(bundle.unit, again.unit)
    assert bundle.loosest_sigma_m == pytest.approx(again.loosest_sigma_m)
    terms = tuple(
        replace(term, point_in_model=new_from_old.apply(term.point_in_model)) if isinstance(term, Planes) else term
        for term in case.problem.measured
    )
    turned = replace(case.problem, base=poses, bundle=bundle, measured=terms)
    old, new = (
        minimise(case.problem, case.start),
        minimise(turned, replace(case.start, geo_from_model=GEO_FROM_MODEL @ new_from_old.inverse())),
    )
    assert new.cost == pytest.approx(old.cost, rel=1e-6)
    np.testing.assert_allclose(new.state.errors, old.state.errors, atol=1e-8)
    for ours, expected in zip(on_earth(turned, new.state), on_earth(case.problem, old.state), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-7)
    for ours, expected in zip(covariances(turned, new), covariances(case.problem, old), strict=True):
        close_in_sigma(ours, expected)


def covariances(problem: Problem, minimum: Minimum) -> list[np.ndarray]:
    """Covariances of the cameras, and of the similarity of the scene, along the axes of geo."""
    normal, similarity = linearised(problem, minimum.state).normal(ones(problem)), minimum.state.geo_from_model
    of_cameras = camera_covariances(normal, similarity.rotation, similarity.scale)
    in_model = of_linear(normal, problem, problem.bundle.followed)
    turn = np.zeros((7, 7))
    turn[0, 0], turn[1:4, 1:4], turn[4:, 4:] = 1, similarity.rotation, similarity.scale * similarity.rotation
    return [*of_cameras, turn @ in_model @ turn.T]


# Layouts that leave something open.


def test_layouts_that_leave_the_similarity_open_are_refused() -> None:
    case = case_of("two sessions")
    fixes, control = case.problem.measured
    assert isinstance(fixes, Fixes)
    assert isinstance(control, ControlPoints)
    two = control.point < 2
    pair = replace(
        control,
        name=control.name[:2],
        point=control.point[two],
        camera=control.camera[two],
        bearing_in_cam=control.bearing_in_cam[two],
        sigma_rad=control.sigma_rad[two],
        bearing_by_lens=control.bearing_by_lens[two],
        position_in_geo=control.position_in_geo[:2],
        cov=control.cov[:2],
    )
    few = replace(
        fixes,
        name=fixes.name[:2],
        camera=fixes.camera[:2],
        position_in_geo=fixes.position_in_geo[:2],
        cov=fixes.cov[:2],
        session=fixes.session[:2],
    )
    for terms in ((), (pair,), (few,)):
        problem = replace(case.problem, measured=terms, errors=of_kinds())
        with refused("similarity-open", DegenerateGeometryError):
            minimise(problem, start_of(problem, GEO_FROM_MODEL))
    both = replace(case.problem, measured=(few, pair), errors=of_kinds())
    assert minimise(both, start_of(both, GEO_FROM_MODEL)).cost >= 0


def test_two_sessions_with_unknown_errors_differ_by_their_priors_alone() -> None:
    case = case_of("fixes")
    sessions = replace(case.problem, errors=of_kinds("bias"))
    normal = linearised(sessions, start_of(sessions, GEO_FROM_MODEL)).normal(ones(sessions))
    sigma = np.sqrt(np.diag(normal.of_errors(LENSES, 6)))
    # All fixes share what both errors have in common: only their difference is observed.
    prior = np.concatenate([block.sigma for block in sessions.errors.blocks])
    assert (sigma <= prior).all()
    common = 1 / np.sqrt(1 / prior[:3] ** 2 + 1 / prior[3:] ** 2)
    assert (sigma[:3] >= 0.99 * common).all()


# Raw measurements.


def raw_bundle() -> tuple[Network, np.ndarray, SurveyedPoints, SurveyedPoints]:
    """A noisy network off its minimum, σ of its observations, and control points: all, and two only."""
    rng = np.random.default_rng(8)
    network, sigma_px = noisy(EXACT, rng), rng.uniform(0.3, 0.8, len(EXACT.obs_point))
    surveyed = SurveyedPoints(
        np.array([3, 0, 11, 17]),
        EXACT.point_in_world[[3, 0, 11, 17]] + rng.normal(0, 0.02, (4, 3)),
        np.tile(np.diag([0.02, 0.02, 0.04]) ** 2, (4, 1, 1)),
    )
    # One ray is enough for a surveyed point.
    kept = (network.obs_point != 0) | (network.obs_image == 2)
    network = replace(
        network,
        obs_point=network.obs_point[kept],
        obs_image=network.obs_image[kept],
        obs_xy_px=network.obs_xy_px[kept],
        point_in_world=network.point_in_world + rng.normal(0, 0.3, (POINTS, 3)),
        cam_center_in_world=network.cam_center_in_world + rng.normal(0, 0.5, (IMAGES, 3)),
        cam_from_world=network.cam_from_world @ exp_so3(rng.normal(0, 0.01, (IMAGES, 3))),
    )
    two = SurveyedPoints(surveyed.point[:2], surveyed.position_in_world[:2], surveyed.cov_in_world[:2])
    return network, sigma_px[kept], surveyed, two


def test_bundle_of_raw_measurements_is_that_of_plain_least_squares() -> None:
    network, sigma_px, surveyed, two = raw_bundle()
    found = adjust_bundle(network, sigma_px, surveyed)
    width = 6 * IMAGES + 3 * POINTS
    design = [jacobian(found.network)[:, :width] / np.repeat(sigma_px, 2)[:, None]]
    residual = [(found.residual_px / sigma_px[:, None]).ravel()]
    for point, position, cov in zip(surveyed.point, surveyed.position_in_world, surveyed.cov_in_world, strict=True):
        rows = np.zeros((3, width))
        rows[:, 6 * IMAGES + 3 * point :][:, :3] = np.diag(1 / np.sqrt(np.diag(cov)))
        design.append(rows)
        residual.append((found.network.point_in_world[point] - position) / np.sqrt(np.diag(cov)))
    whole, left = np.concatenate(design), np.concatenate(residual)
    covariance = np.linalg.inv(whole.T @ whole)
    assert np.abs(covariance @ whole.T @ left / np.sqrt(np.diag(covariance))).max() < 1e-4  # no step is left
    assert found.redundancy == len(left) - width
    assert found.sigma0 == pytest.approx(np.sqrt(left @ left / found.redundancy), rel=1e-9)
    blocks = [covariance[i : i + 6, i : i + 6] for i in range(0, 6 * IMAGES, 6)]
    points = [covariance[i : i + 3, i : i + 3] for i in range(6 * IMAGES, width, 3)]
    for ours, expected in zip((*found.camera_cov, *found.point_cov), (*blocks, *points), strict=True):
        close_in_sigma(ours, expected)
    with refused("similarity-open", DegenerateGeometryError) as error:
        adjust_bundle(network, sigma_px, two)
    assert numbers(str(error.value))[0] == len(two.point)
    behind = replace(network, point_in_world=network.point_in_world + np.array([0, 0, 200.0]))
    with refused("point-behind-camera", InputError):
        adjust_bundle(behind, sigma_px, surveyed)
