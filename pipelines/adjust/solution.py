"""A solved state as a product: similarity, cameras, lens, systematic errors, measurements, posterior."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.sparse import block_diag, csr_matrix

from pipelines.adjust.accuracy_grid import accuracy_grid
from pipelines.adjust.posterior import CommonRows, Posterior, camera_covariances, load_posterior, of_earlier_cameras
from pipelines.adjust.state import State
from pipelines.adjust.system import Linearised, NormalMatrix, Problem, linearised, posterior_weights, robust_weights
from pipelines.adjust.terms import At, Attitudes, ControlPoints, Distances, EarlierPoints, Fixes
from pipelines.core.products import Remark, union
from pipelines.core.stages import SIM3_POSTERIOR, TRAIN_POSTERIOR
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import covariance_root
from pipelines.survey.measurement_errors import EstimatedError
from pipelines.survey.report import AccuracySummary
from pipelines.survey.scene import SparseScene
from pipelines.survey.solution import (
    Measurement,
    MeasurementVerdict,
    Solution,
    SolvedCamera,
    SolvedLens,
    TrainedModel,
)

Named = Fixes | ControlPoints | Distances | Attitudes
_EVIDENT_SIGMAS = 3.0
_OPEN = 1e-9  # redundancy below which the other observations leave a direction open
_REJECTED = "is inconsistent with the others at the 99.9 % level"


def adjusted(
    scene: SparseScene, problem: Problem, state: State, verdict: MeasurementVerdict, rejected: Problem | None = None
) -> Posterior:
    """Return a state as the solution of a survey, with its covariances.

    `problem` has the measurements in use. The verdict on each measurement stands, with its factors and cautions.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    near = linearised(problem, state)
    normal = near.normal(posterior_weights(near.residuals))
    sparse, similarity = scene.sparse, state.geo_from_model
    poses = state.poses(scene.poses)
    pivot = similarity.apply(poses.cam_center_in_model).mean(axis=0)
    covariance = normal.of_errors(len(problem.lens), len(problem.errors))
    solution = Solution(
        geo_from_model=similarity.to_record("model", "geo", pivot=pivot),
        model_from_local=scene.model_from_local.to_record("local", "model"),
        cameras=_cameras(scene, poses),
        lenses=tuple(
            SolvedLens(camera_id=key, model=camera.model, params=tuple(camera.params.tolist()))
            for key, camera in (sparse.lenses.moved(state.lens).cameras.items() if len(state.lens) else ())
        ),
        **verdict.verdict | {"cautions": union(verdict.cautions)},
        estimated_errors=problem.errors.estimates(state.errors, covariance),
        measurements=tuple(_measurements(near, normal, rejected)),
        sigma_px=problem.bundle.sigma_px,
        sigma_datum_m=problem.sigma_datum_m,
        earlier=problem.earlier,
    )
    of_cameras = camera_covariances(normal, similarity.rotation, similarity.scale)
    of_cameras[:, 3:, 3:] += np.diag(np.square(problem.sigma_datum_m))
    of_cameras += of_earlier_cameras(solution.earlier, similarity.apply(poses.cam_center_in_model))
    lens, moved = problem.lens, solution.with_lenses(sparse)
    common = _common_rows(near, normal)
    posterior = Posterior(solution, moved, normal, problem.bundle.followed, lens, of_cameras, common=common)
    record = similarity.to_record("model", "geo", covariance=posterior.of_similarity, pivot=pivot)
    grid = accuracy_grid(sparse, similarity.apply(scene.point_in_model), posterior.of_scene)
    summary = AccuracySummary(cells=0, reason="the scene has too few points") if grid is None else grid.summary()
    solution = solution.model_copy(update={"geo_from_model": record, "accuracy": summary})
    return replace(posterior, solution=solution, grid=grid)


def _common_rows(near: Linearised, normal: NormalMatrix) -> CommonRows | None:
    """Return the points in common with an earlier date as the normal matrix has them; None: there are none."""
    term = near.problem.term(EarlierPoints.kind)
    if not isinstance(term, EarlierPoints):
        return None
    rows, weight = near.rows[term.kind], posterior_weights(near.residuals)[term.kind]
    weigh = csr_matrix(block_diag(list(weight[:, None, None] * np.swapaxes(term.root_information, 1, 2))))
    by_border = np.pad(weigh @ rows.by_border, ((0, 0), (0, len(normal.corner) - rows.by_border.shape[1])))
    return CommonRows(np.array(term.name, dtype=np.int64), csr_matrix(weigh @ rows.by_poses), by_border)


def remarks_of(error: EstimatedError, remedy: str) -> Iterator[Remark]:
    """Yield a warning if an error exceeds 3 σ, with the remedy, or if it is not observed along every axis."""
    evident = [
        abs(value) > _EVIDENT_SIGMAS * sigma and observed
        for value, sigma, observed in zip(error.value, error.sigma, error.observed, strict=True)
    ]
    if any(evident):
        evidence = f"The {error.name} of {error.text} exceeds 3 σ and was removed."
        yield Remark(code=f"{error.name}-estimated", sentence=evidence, remedy=remedy)
    elif not all(error.observed):
        sentence = f"The {error.name} is not observable along every axis: {error.text}."
        yield Remark(code=f"{error.name}-not-observable", sentence=sentence)


def posterior_of(workspace: Workspace, solution: Solution, sfm: SparseModel) -> Posterior:
    """Return the posterior that is stored beside a solution of a workspace.

    Raises:
        MissingProductError: there is none.
        InputError: the product is damaged, or of another solution.
    """
    product = TRAIN_POSTERIOR if isinstance(solution, TrainedModel) else SIM3_POSTERIOR
    return load_posterior(workspace.path(product), solution, sfm)


def _cameras(scene: SparseScene, poses: CameraPoses) -> tuple[SolvedCamera, ...]:
    train = set(map(int, scene.train))
    quats = quat_xyzw_from_matrix(poses.cam_from_model)
    translations = -np.einsum("nij,nj->ni", poses.cam_from_model, poses.cam_center_in_model)
    return tuple(
        SolvedCamera(
            name=name,
            split="train" if index in train else "test",
            quat_xyzw=tuple(quats[index]),
            translation=tuple(translations[index]),
        )
        for index, name in enumerate(scene.sparse.image_name)
    )


_KINDS: dict[str, Literal["fix", "control point", "distance", "attitude"]] = {
    Fixes.kind: "fix",
    ControlPoints.kind: "control point",
    Distances.kind: "distance",
    Attitudes.kind: "attitude",
}


def _measurements(near: Linearised, normal: NormalMatrix, rejected: Problem | None) -> Iterator[Measurement]:
    """Yield the state of every measurement in use, of every systematic error, and of the rejected measurements."""
    for term in near.problem.measured:
        if isinstance(term, Named):
            left_out = _left_out(near, term, normal) if isinstance(term, ControlPoints) else None
            yield from _states(term, near.problem.at(near.state), left_out=left_out)
    for error, row in zip(near.problem.errors.blocks, near.state.errors.reshape(-1, 3), strict=True):
        yield Measurement(
            kind="systematic error",
            name=error.label,
            used=True,
            residual=tuple(row.tolist()),
            normalised=float(np.linalg.norm(row / np.array(error.sigma))),
        )
    if rejected is not None:
        at = rejected.at(replace(near.state, errors=np.zeros(len(rejected.errors))))
        for term in rejected.measured:
            if isinstance(term, Named):
                yield from _states(term, at, reason=_REJECTED)


def _states(
    term: Named, at: At, *, reason: str = "", left_out: list[dict[str, object]] | None = None
) -> Iterator[Measurement]:
    residual, white = term.residuals(at), term.whitened(at)
    for row, name in enumerate(term.name):
        yield Measurement(
            kind=_KINDS[term.kind],
            name=name,
            used=not reason,
            reason=reason,
            residual=tuple(residual[row].tolist()),
            normalised=float(np.linalg.norm(white[row])),
            **({} if left_out is None else left_out[row]),
        )


def _left_out(near: Linearised, control: ControlPoints, normal: NormalMatrix) -> list[dict[str, object]]:
    """Return the error of each control point against the solution of all other observations, and its covariance.

    The computation is linear and needs no second solution. With the normal matrix N of all observations, a point
    with Jacobian A and weight w has the leverage H = w A N⁻¹ Aᵀ. Its residual without it is (I − H)⁻¹ r (Cook and
    Weisberg 1982, section 2.2). The weights of the other observations are frozen.
    """
    kind = control.kind
    white, residuals = near.rows[kind].residual, near.residuals
    weights, expected = robust_weights(residuals), posterior_weights(residuals)
    leverage = near.spread(weights, kind) * weights[kind][:, None, None]
    spread = near.spread(expected, kind, normal)
    free = np.eye(3) - leverage
    known = np.linalg.eigvalsh((free + np.swapaxes(free, 1, 2)) / 2)[:, 0] > _OPEN
    rows: list[dict[str, object]] = [{} for _ in known]
    for row in np.flatnonzero(known):
        unwhiten = covariance_root(control.cov[row])
        error = unwhiten @ np.linalg.solve(free[row], white[row])
        others = np.linalg.solve(np.eye(3) - expected[kind][row] * spread[row], spread[row])
        cov = unwhiten @ (np.eye(3) + (others + others.T) / 2) @ unwhiten.T
        rows[row] = {"left_out_error_m": tuple(error.tolist()), "left_out_cov_m2": tuple(map(tuple, cov.tolist()))}
    return rows
