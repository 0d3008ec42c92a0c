"""The one system of the adjustment: sparse normal equations of all cameras, lens and systematic errors.

The unknowns are corrections x of all cameras, which contain a similarity of the whole, changes ℓ of the lens and
systematic errors v. Image observations enter as the information of the bundle about SfM's minimum
(`geometry.bundle`), with the points eliminated; all other measurements as terms (`adjust.terms`):

    | N   Bᵀ | | x      |
    | B   C  | | border | ,   Schur complement of N: S = C − B N⁻¹ Bᵀ,   border = (ℓ, v).

N is sparse and is factorised by nested dissection (`geometry.sparse_cholesky`); the border is dense and small. A
similarity of the whole costs the bundle nothing, so that fixes and control points alone determine it. After each
step, it is moved from the corrections into the similarity: the information about SfM's minimum then holds, wherever
on Earth the cameras have gone.

Terms that depend on the mean similarity g of the SfM points (planes of a LiDAR) add g to the border, with the
constraint g = F (x, ℓ) and its multipliers: F is dense, but has seven rows.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.sparse import bsr_matrix, csr_matrix, diags

from pipelines.adjust.state import State, SystematicErrors
from pipelines.adjust.terms import At, CommonErrors, Level, LocalFrame, Slopes, Term
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray, Vector3
from pipelines.geometry.bundle import BundleInformation
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import skew
from pipelines.geometry.similarity import perturbation
from pipelines.geometry.sparse_cholesky import SparseCholesky
from pipelines.geometry.statistics import NOISE_WEIGHT, cauchy_loss, cauchy_weight
from pipelines.survey.solution import EarlierDate

_ROUNDS = 150
_STILL = 5e-6  # change of a whitened residual that ends the descent
_NOISE = 1e-10  # relative rise of the cost that rounding causes
_HALVINGS = 12  # of a step that raises the cost
_SLOW = 0.8  # of the step before: a step that is longer is slow to shrink
_NEW_FACTOR = 0.6  # a step that leaves more of the last change of the residuals asks for a new factor
_CHUNK = 32  # groups of rows whose covariances are computed together
_EQUILIBRATIONS = 8
_OPEN = 1e-13  # singular value of the equilibrated Schur complement over the largest
_FRAME_RIDGE = 1e-12  # of the diagonal, where no term fixes the similarity of the cameras themselves
_UNSEEN = 10.0  # times the bundle's loosest σ, at which a camera is frozen that nothing observes
_ADVICE = "Fixes and control points do not determine the similarity. Add at least three control points."

# By kind of observation: residuals (M, d), weights (M,).
Residuals = Mapping[str, FloatArray]
Weights = Mapping[str, FloatArray]


@dataclass(frozen=True)
class Problem:
    """Cameras with poses as SfM left them, and all that was measured of them; at most one term of a kind."""

    base: CameraPoses
    bundle: BundleInformation
    measured: tuple[Term, ...]
    errors: SystematicErrors = field(default_factory=SystematicErrors)
    lens_frozen: bool = False
    # σ east, north, up in m of an error that all positions share, and that no measurement reveals
    sigma_datum_m: Vector3 = (0.0, 0.0, 0.0)
    earlier: EarlierDate | None = None  # whose places this survey takes over, with their error

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """All terms, the prior of the systematic errors among them."""
        if not self.errors.blocks:
            return self.measured
        prior = CommonErrors(np.array([np.diag(np.square(block.sigma)) for block in self.errors.blocks]))
        return (*self.measured, prior)

    def term(self, kind: str) -> Term | None:
        return next((term for term in self.terms if term.kind == kind), None)

    @cached_property
    def lens(self) -> IntArray:
        """Lens parameters that are unknowns: those that an observation reveals, unless the lens is frozen."""
        seen = np.flatnonzero(np.diag(self.bundle.sums.lens) > 0)
        return seen[:0] if self.lens_frozen else seen

    @cached_property
    def poses(self) -> bsr_matrix:
        """Information (6 n, 6 n) of the image observations on x, with a prior of cameras that nothing observes."""
        bundle = self.bundle
        variance = bundle.sums.poses.diagonal() * bundle.unit**2
        weak = variance < bundle.loosest_sigma_m**-2
        prior = diags(weak * (_UNSEEN * bundle.unit * bundle.loosest_sigma_m) ** -2.0).tobsr((6, 6))
        return (self._images + prior).tobsr((6, 6))

    @cached_property
    def _images(self) -> bsr_matrix:
        """Information (6 n, 6 n) of the image observations, regular also where the border alone has a frame."""
        poses = self.bundle.sums.poses
        if self.term(LocalFrame.kind) is None:
            return poses
        return (poses + diags(_FRAME_RIDGE * poses.diagonal()).tobsr((6, 6))).tobsr((6, 6))

    @cached_property
    def of_rounding(self) -> FloatArray:
        """Information (7, 7) on a similarity of the whole in `poses`, which should be zero: ridge and rounding."""
        modes = self.bundle.similarity_modes
        return np.asarray(modes.T @ (self._images @ modes))

    def at(self, state: State) -> At:
        poses, turn = state.poses(self.base), skew(state.correction[:, :3])
        # Exp(−(ω + δ)) = Exp(−ω) Exp(−J δ) with J = I + ½ [ω] + ⅙ [ω]² + …
        jacobian = np.eye(3) + turn / 2 + turn @ turn / 6
        rotation, center = poses.cam_from_model, poses.cam_center_in_model
        return At(rotation, center, state.geo_from_model, state.lens, self.errors, state.errors, jacobian)

    def residuals(self, state: State) -> dict[str, FloatArray]:
        at = self.at(state)
        return {term.kind: term.whitened(at) for term in self.terms}

    def start_at(self, state: State, errors: SystematicErrors) -> State:
        """Return a state of a problem with other systematic errors, with those that this one has as well."""
        values = np.zeros(len(self.errors))
        for block in self.errors.blocks:
            here, there = (each.columns(block.name, block.session, block.mode) for each in (self.errors, errors))
            if here is not None and there is not None:
                values[here] = state.errors[there]
        return replace(state, errors=values)


@dataclass(frozen=True)
class WhitenedRows:
    """M whitened observations of one kind near a state."""

    residual: FloatArray  # (M, d) at the state
    by_poses: csr_matrix  # (M d, 6 n) sparse derivative by the corrections of the cameras
    # (M d, b) derivative by the border: lens, systematic errors, similarity of the points if any
    by_border: FloatArray


@dataclass(frozen=True)
class NormalMatrix:
    """Matrix of the normal equations: the information of all measurements on all unknowns."""

    poses: bsr_matrix  # (6 n, 6 n) N, sparse in blocks (6, 6)
    border: FloatArray  # (b, 6 n) B
    corner: FloatArray  # (b, b) C
    position: FloatArray  # (n, 3) of the cameras; decides the cost of the factorisation, not its result

    @cached_property
    def factor(self) -> SparseCholesky:
        try:
            return SparseCholesky(self.poses, self.position)
        except DegenerateGeometryError:
            raise DegenerateGeometryError("similarity-open", _ADVICE) from None

    @cached_property
    def response(self) -> FloatArray:
        """N⁻¹ Bᵀ (6 n, b)."""
        right = np.ascontiguousarray(self.border.T)
        return self.factor.solve(right) if right.size else right

    @cached_property
    def _schur_solve(self) -> Callable[[FloatArray], FloatArray]:
        """Return the solver S⁻¹ of right sides (b, m), by S scaled to a largest entry of 1 in rows and columns.

        S is symmetric, and indefinite where there are multipliers.
        """
        schur = self.corner - self.border @ self.response
        if not len(schur):
            return lambda right: right
        scale = np.ones(len(schur))
        for _ in range(_EQUILIBRATIONS):
            largest = np.abs(schur * scale[:, None] * scale).max(axis=1)
            scale /= np.sqrt(np.where(largest > 0, largest, 1.0))
        scaled = schur * scale[:, None] * scale
        size = np.linalg.svd(scaled, compute_uv=False)
        if size[-1] <= _OPEN * size[0]:
            raise DegenerateGeometryError("similarity-open", _ADVICE)
        lu, pivots = lu_factor(scaled)
        # SciPy counts the pivots up and down in place: threads that share them would damage memory.
        return lambda right: np.asarray(lu_solve((lu, pivots.copy()), right * scale[:, None]) * scale[:, None])

    def solve(self, poses: FloatArray, border: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the unknowns (6 n, m) and (b, m) for right sides of the same shapes."""
        inner = self.factor.solve(poses)
        outer = self._schur_solve(border - self.border @ inner)
        return inner - self.response @ outer, outer

    def covariance(self, by_poses: csr_matrix, by_border: FloatArray) -> FloatArray:
        """Return the covariance (m, m) of quantities with derivatives (m, 6 n) and (m, b)."""
        if not len(by_border):
            return np.zeros((0, 0))
        by_poses = csr_matrix(by_poses)
        within = self.factor.inverse_form(by_poses.T.tocsc()) if by_poses.nnz else 0.0
        return np.asarray(within + self._of_border(by_border - by_poses @ self.response))

    def covariances(self, by_poses: csr_matrix, by_border: FloatArray, size: int) -> FloatArray:
        """Return the covariances (m, size, size) of groups of `size` quantities; derivatives as in `covariance`."""
        by_poses, count = csr_matrix(by_poses), len(by_border) // size
        covariance = np.empty((count, size, size))
        for first in range(0, count, _CHUNK):
            rows = slice(size * first, size * (first + _CHUNK))
            joint = self.covariance(by_poses[rows], by_border[rows])
            among = np.arange(len(joint) // size)
            covariance[first : first + _CHUNK] = joint.reshape(len(among), size, -1, size)[among, :, among]
        return covariance

    def of_errors(self, lens: int, count: int) -> FloatArray:
        """Return the covariance (count, count) of the systematic errors, which follow `lens` parameters."""
        return self._of_border(np.eye(count, len(self.corner), lens))

    def of_each_camera(self, camera: IntArray, by_pose: FloatArray, by_border: FloatArray) -> FloatArray:
        """Return the covariances (m, d, d) of quantities that depend on one camera (m,) each.

        Their derivatives are (m, d, 6) by its corrections, and (m, d, b) by the border.
        """
        response = self.response.reshape(len(self.position), 6, -1)[camera]
        across = by_border - by_pose @ response
        within = by_pose @ self.factor.inverse_diagonal[camera] @ np.swapaxes(by_pose, 1, 2)
        return np.asarray(within + self._of_border(across))

    def _of_border(self, left: FloatArray) -> FloatArray:
        """Return the products left S⁻¹ leftᵀ (…, m, m) of border vectors (…, m, b)."""
        if not len(self.corner):
            return np.zeros((*left.shape[:-1], left.shape[-2]))
        solved = self._schur_solve(left.reshape(-1, left.shape[-1]).T).T.reshape(left.shape)
        return np.asarray(left @ np.swapaxes(solved, -1, -2))


@dataclass(frozen=True)
class Linearised:
    """Problem near a state: whitened observations by kind, and whether any depends on the SfM points' mean."""

    problem: Problem
    state: State
    rows: dict[str, WhitenedRows]
    has_points: bool

    @property
    def residuals(self) -> Residuals:
        return {kind: rows.residual for kind, rows in self.rows.items()}

    def normal(self, weights: Weights) -> NormalMatrix:
        """Return the normal equations with weights (M,) of the observations.

        Raises:
            DegenerateGeometryError: the measurements leave the similarity open.
        """
        self._refuse_open_layouts()
        problem, lens = self.problem, self.problem.lens
        matrix, width = problem.poses, self._width
        border, corner = np.zeros((width, matrix.shape[0])), np.zeros((width, width))
        border[: len(lens)] = problem.bundle.sums.cross[:, lens].T
        corner[: len(lens), : len(lens)] = problem.bundle.sums.lens[np.ix_(lens, lens)]
        for kind, rows in self.rows.items():
            weight = np.repeat(weights[kind], rows.residual.shape[1])
            weighted = rows.by_poses.T @ diags(weight)
            if rows.by_poses.nnz:
                matrix = matrix + (weighted @ rows.by_poses).tobsr((6, 6))
            border += (weighted @ rows.by_border).T
            corner += rows.by_border.T @ (weight[:, None] * rows.by_border)
        if self.has_points:  # g = F (x, ℓ), with multipliers
            followed, n = problem.bundle.followed, matrix.shape[0]
            known = np.zeros((7, width))
            known[:, : len(lens)], known[:, -7:] = -followed[:, n + lens], np.eye(7)
            border = np.concatenate([border, -followed[:, :n]])
            corner = np.block([[corner, known.T], [known, np.zeros((7, 7))]])
        return NormalMatrix(matrix.tobsr((6, 6)), border, corner, problem.base.cam_center_in_model)

    def step(self, normal: NormalMatrix, weights: Weights) -> tuple[FloatArray, FloatArray]:
        """Return the step (n, 6), (L + p,) to the minimum of the weighted squares."""
        problem, state = self.problem, self.state
        slope_poses, slope_lens = _slope_of_bundle(problem, state)
        border = np.zeros(len(normal.corner))
        border[: len(problem.lens)] = slope_lens[problem.lens]
        for kind, rows in self.rows.items():
            weighted = (weights[kind][:, None] * rows.residual).ravel()
            slope_poses = slope_poses + rows.by_poses.T @ weighted
            border[: self._width] += rows.by_border.T @ weighted
        poses, unknowns = normal.solve(-slope_poses[:, None], -border[:, None])
        moved = np.zeros(len(state.lens) + len(problem.errors))
        moved[problem.lens] = unknowns[: len(problem.lens), 0]
        moved[len(state.lens) :] = unknowns[len(problem.lens) :, 0][: len(problem.errors)]
        return poses.reshape(-1, 6), moved

    def spread(self, weights: Weights, kind: str, normal: NormalMatrix | None = None) -> FloatArray:
        """Return the covariances (M, d, d) that the unknowns cause in the whitened observations of a kind."""
        normal, rows = self.normal(weights) if normal is None else normal, self.rows[kind]
        count, d = rows.residual.shape
        by_border = np.pad(rows.by_border, ((0, 0), (0, len(normal.corner) - self._width)))
        blocks = rows.by_poses.tobsr((d, 6)) if rows.by_poses.nnz else None
        if blocks is not None and (np.diff(blocks.indptr) == 1).all():  # each observation belongs to one camera
            return normal.of_each_camera(
                blocks.indices, blocks.data, by_border.reshape(count, d, len(normal.corner))
            )
        return normal.covariances(rows.by_poses, by_border, d)

    def _refuse_open_layouts(self) -> None:
        """Refuse measurements that know less of some movement of the whole than ridge and rounding of the bundle.

        The factor of N does not show an open direction: the ridge on each point closes it, with a σ that grows
        smaller with the number of points.
        """
        problem, lenses, count = self.problem, len(self.problem.lens), len(self.problem.errors)
        known = np.zeros((7 + count, 7 + count))
        for rows in self.rows.values():
            whole = rows.by_poses @ problem.bundle.similarity_modes
            if self.has_points:
                whole = whole + rows.by_border[:, lenses + count :]
            by_unknowns = np.hstack([whole, rows.by_border[:, lenses : lenses + count]])
            known += by_unknowns.T @ by_unknowns
        information = known[:7, :7] - known[:7, 7:] @ np.linalg.solve(known[7:, 7:], known[7:, :7])
        scale = 1.0 / np.sqrt(np.diag(information) + np.abs(np.diag(problem.of_rounding)))
        beyond = (information - problem.of_rounding) * scale[:, None] * scale
        if np.linalg.eigvalsh(beyond)[0] <= _OPEN:
            raise DegenerateGeometryError("similarity-open", _ADVICE)

    @property
    def _width(self) -> int:
        """Number of unknowns of the border, without multipliers."""
        return len(self.problem.lens) + len(self.problem.errors) + 7 * self.has_points


@dataclass(frozen=True)
class Minimum:
    """Minimum of a problem: the state there, and −2 ln likelihood."""

    state: State
    cost: float


def linearised(problem: Problem, state: State) -> Linearised:
    """Return the problem linearised at a state: whitened residuals and derivatives of all terms, by kind."""
    at = problem.at(state)
    slopes = {term.kind: (term.root_information, term.slopes(at)) for term in problem.terms}
    has_points = any(slope.by_similarity is not None for _, slope in slopes.values())
    rows = {kind: _rows(problem, *of_kind, has_points=has_points) for kind, of_kind in slopes.items()}
    return Linearised(problem, state, rows, has_points)


def _rows(problem: Problem, root: FloatArray, slopes: Slopes, *, has_points: bool) -> WhitenedRows:
    """Return the observations of a term in units of σ, from its root information (M, d, d)."""
    count, d = slopes.residual.shape
    by_pose = root[slopes.row] @ slopes.by_pose
    parts = [(root @ slopes.by_lens)[:, :, problem.lens], root @ slopes.by_errors]
    if has_points:
        parts.append(np.zeros((count, d, 7)) if slopes.by_similarity is None else root @ slopes.by_similarity)
    by_border = np.concatenate(parts, axis=2).reshape(count * d, -1)
    row = np.broadcast_to((d * slopes.row)[:, None, None] + np.arange(d)[:, None], by_pose.shape)
    column = np.broadcast_to((6 * slopes.camera)[:, None, None] + np.arange(6), by_pose.shape)
    shape = (count * d, 6 * len(problem.base.cam_center_in_model))
    by_poses = csr_matrix((by_pose.ravel(), (row.ravel(), column.ravel())), shape=shape)
    return WhitenedRows((root @ slopes.residual[:, :, None])[:, :, 0], by_poses, by_border)


def minimise(problem: Problem, start: State, normal: NormalMatrix | None = None) -> Minimum:
    """Return the minimum of Cauchy's cost of all terms, with the information of the bundle.

    A quasi-Newton step takes the slope at the present state and a factor that may be older: the minimum is exact,
    and few factorisations are needed. The first steps take that of `normal`, if there is one. A step that raises
    the cost is halved. Where steps shrink slowly, because the weights of a redescending kernel are stiff, the next
    one is stretched.

    Raises:
        ConvergenceError: the steps do not end.
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    state, residuals = start, problem.residuals(start)
    cost, last = cost_at(problem, start, residuals), np.inf
    stretch, unstretched = 1.0, np.inf
    for _ in range(_ROUNDS):
        near, weights = linearised(problem, state), robust_weights(residuals)
        if normal is None:
            normal, last = near.normal(weights), np.inf
        step = near.step(normal, weights)
        for halving in range(_HALVINGS + 1):
            moved = _moved(problem, state, step, stretch * 0.5**halving)
            new = problem.residuals(moved)
            differences = (float(np.abs(new[kind] - residuals[kind]).max(initial=0.0)) for kind in new)
            change, reached = max(differences, default=0.0), cost_at(problem, moved, new)
            if reached <= cost + _NOISE * (1 + abs(cost)) or change < _STILL:
                break
        else:
            raise _not_converged(change)
        state, residuals, cost = moved, new, reached
        if change < _STILL:
            return Minimum(state, cost)
        if halving or change > _NEW_FACTOR * last:
            normal = None
        whole = change / (stretch * 0.5**halving)
        stretch = 2 * stretch if not halving and _SLOW * unstretched < whole < unstretched else 1.0
        last, unstretched = change, whole
    raise _not_converged(last)


def _not_converged(change: float) -> ConvergenceError:
    sentence = f"The cameras have not converged: the last step changed a residual by {change:.1e} σ."
    return ConvergenceError("cameras-not-converged", sentence)


def _moved(problem: Problem, state: State, step: tuple[FloatArray, FloatArray], part: float) -> State:
    """Return the state after a part of a step, with a similarity of the whole moved from the corrections to it."""
    poses, border = step
    lenses, modes = len(state.lens), problem.bundle.similarity_modes
    correction, lens = state.correction + part * poses, state.lens + part * border[:lenses]
    errors = state.errors + part * border[lenses:]
    mean = problem.bundle.followed @ np.concatenate([correction.ravel(), lens])
    about = perturbation(mean, problem.base.cam_center_in_model.mean(axis=0))
    return State(state.geo_from_model @ about, correction - (modes @ mean).reshape(-1, 6), lens, errors)


def _slope_of_bundle(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Return the slope (6 n,), (L,) of half the cost of the image observations."""
    sums, x, lens = problem.bundle.sums, state.correction.ravel(), state.lens
    return np.asarray(problem.poses @ x + sums.cross @ lens), np.asarray(sums.cross.T @ x + sums.lens @ lens)


def cost_at(problem: Problem, state: State, residuals: Residuals) -> float:
    """Return −2 ln likelihood of a state: Cauchy's cost of the residuals, and that of the image observations."""
    by_poses, by_lens = _slope_of_bundle(problem, state)
    of_bundle = state.correction.ravel() @ by_poses + state.lens @ by_lens
    return float(of_bundle) + sum(
        float(cauchy_loss((rows**2).sum(axis=1), rows.shape[1]).sum()) for rows in residuals.values()
    )


def robust_weights(residuals: Residuals) -> dict[str, FloatArray]:
    """Return Cauchy's weights (M,) of whitened residuals (M, d), by kind."""
    return {kind: cauchy_weight((rows**2).sum(axis=1), rows.shape[1]) for kind, rows in residuals.items()}


def posterior_weights(residuals: Residuals) -> dict[str, FloatArray]:
    """Return the weights (M,), by kind, whose normal matrix is the inverse covariance of the estimate.

    Cauchy's weight is also below 1 under pure noise (`statistics.NOISE_WEIGHT`). A prior counts at most once.
    """
    weights = robust_weights(residuals)
    for kind, rows in residuals.items():
        weights[kind] = weights[kind] / NOISE_WEIGHT[rows.shape[1]]
        if kind in (CommonErrors.kind, Level.kind):
            weights[kind] = np.minimum(weights[kind], 1.0)
    return weights
