"""How near the estimates come to the Cramér–Rao bound: `python examples/benchmarks/cramer_rao.py WORKSPACE`.

The trained cameras and lens, and control and check points where their marks show them there, are taken for the
truth. Each run draws anew what was measured of it, with the σ that the survey states: the fixes, survey and marks
of the control points, marks of the check points, and what the noise of the image observations does to cameras and
lens. Then it estimates as the tool does: the similarity of `init-sim3`, and from there similarity, cameras and
the lens that follows them as in training, but without the photographs, solved to the end. The RMS errors at the
check points are divided by the bound.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from pipelines.adjust.alignment import align
from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.intersection_jacobian import IntersectionJacobian
from pipelines.adjust.networks import control_rays
from pipelines.adjust.posterior import minimise
from pipelines.adjust.prediction import jacobian_of_points
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.similarity_fit import Correspondences
from pipelines.adjust.solved_survey import SolvedSurvey, geographic_options_of, solve_survey
from pipelines.adjust.terms import ControlTerm, FixTerm
from pipelines.core.products import load_json
from pipelines.core.stages import SIM3
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.evaluate.cramer_rao import cramer_rao_bound
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.marks import MarkRays, mark_rays
from pipelines.scene.points_by_camera import points_by_camera
from pipelines.scene.trained_survey import load_trained


@dataclass(frozen=True)
class MarkedPoints:
    """Points (J, 3) in `model` where their marks show them, and their derivatives by the cameras."""

    position: FloatArray
    jacobian: IntersectionJacobian

    @classmethod
    def of(cls, solved: SolvedSurvey, rays: MarkRays) -> MarkedPoints:
        """J points from their marks."""
        in_geo = points_by_camera(solved.trained, rays)
        in_model = solved.trained.geo_from_model.inverse().apply(in_geo)
        return cls(in_model, jacobian_of_points(solved, in_geo, rays.point, rays.camera, rays.sigma_px))


@dataclass(frozen=True)
class Truth:
    """A trained survey that is taken for the truth."""

    solved: SolvedSurvey
    control: MarkedPoints | None
    check: MarkedPoints


@dataclass(frozen=True)
class Drawn:
    """One run's measurements, and where the check points (J, 3) truly are in `geo`."""

    fixes: FixTerm | None
    marks: ControlTerm | None
    check_in_geo: FloatArray


def draw(truth: Truth, rng: np.random.Generator, *, images: bool) -> Drawn:
    """Draw the measurements; without `images`, image observations and the check points' marks are exact."""
    problem, found = truth.solved.problem, truth.solved.scene.correction_basis
    geo_from_model, basis = truth.solved.trained.geo_from_model, problem.cameras.basis.numpy()
    follows = problem.cameras.lens_basis.numpy()
    z = rng.normal(size=basis.shape[2]) * images
    lens = np.zeros(truth.check.jacobian.by_lens.shape[2])
    if images and found is not None and len(follows):
        lens = follows @ z + _noise(found.lens_cov[None], rng)[0]

    def true(marked: MarkedPoints) -> FloatArray:
        return marked.position + marked.jacobian.by_corrections(basis) @ z + marked.jacobian.by_lens @ lens

    fixes, marks = problem.fixes, problem.control
    if fixes is not None:
        moved = truth.solved.trained.poses.cam_center_in_model + basis[:, 3:] @ z
        position = geo_from_model.apply(moved[fixes.camera.numpy()])
        position = position + _noise(_covariance(fixes.root_information), rng)
        fixes = replace(fixes, position_in_geo=torch.from_numpy(position))
    if marks is not None and truth.control is not None:
        position = geo_from_model.apply(true(truth.control)) + _noise(_covariance(marks.root_information), rng)
        marks = replace(marks, position_in_geo=torch.from_numpy(position))
    check = true(truth.check) + images * _noise(truth.check.jacobian.cov_of_marks, rng)
    return Drawn(fixes, marks, geo_from_model.apply(check))


def _covariance(root_information: torch.Tensor) -> FloatArray:
    root = root_information.numpy()
    return np.linalg.inv(np.swapaxes(root, 1, 2) @ root)


def _noise(cov: FloatArray, rng: np.random.Generator) -> FloatArray:
    value, vector = np.linalg.eigh(cov)
    white = rng.normal(size=value.shape) * np.sqrt(np.maximum(value, 0.0))
    return np.asarray((vector @ white[..., None])[..., 0])


def estimate(truth: Truth, drawn: Drawn, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The check points (J, 3) in `geo`: by the similarity of `init-sim3`, and by similarity and cameras."""
    poses, cameras = truth.solved.trained.poses, truth.solved.problem.cameras
    basis, follows = cameras.basis.numpy(), cameras.lens_basis.numpy()
    solution = align(_correspondences(truth, drawn), rng).solution
    start = solution.state.geo_from_local
    problem = GeoProblem(
        LearnableSimilarity(start, solution.covariance, solution.pivot),
        CameraCorrections(poses, basis, follows),
        [term for term in (drawn.fixes, _through_trained_lens(truth, drawn.marks)) if term is not None],
    )
    minimise(problem)
    by_lens = truth.check.jacobian.by_lens[:, :, : len(follows)] @ follows
    followed = (
        truth.check.position
        + (truth.check.jacobian.by_corrections(basis) + by_lens) @ problem.cameras.z.detach().numpy()
    )
    return start.apply(truth.check.position), problem.similarity.current().apply(followed)


def _through_trained_lens(truth: Truth, marks: ControlTerm | None) -> ControlTerm | None:
    """The marks as the cameras see them from which the estimate starts."""
    if marks is None:
        return None
    return replace(marks, bearing_in_cam=marks.bearings(_trained_lens(truth.solved)))


def _trained_lens(solved: SolvedSurvey) -> torch.Tensor:
    """Change (L,) of the lens parameters that training made, in the order of `geometry.lens.Lenses`."""
    return torch.from_numpy(solved.trained.sfm.lenses.change_to(solved.trained.sparse.lenses))


def _correspondences(truth: Truth, drawn: Drawn) -> Correspondences:
    """What `init-sim3` would be given, the frame `model` standing for `local`."""
    local, geo, cov, control = [np.empty((0, 3))], [np.empty((0, 3))], [], []
    if drawn.fixes is not None:
        local.append(truth.solved.trained.poses.cam_center_in_model[drawn.fixes.camera.numpy()])
        geo.append(drawn.fixes.position_in_geo.numpy())
        cov.append(_covariance(drawn.fixes.root_information))
        control += [False] * len(geo[-1])
    if drawn.marks is not None and truth.control is not None:
        local.append(truth.control.position)
        geo.append(drawn.marks.position_in_geo.numpy())
        cov.append(_covariance(drawn.marks.root_information))
        control += [True] * len(geo[-1])
    count = len(control)
    return Correspondences(
        tuple(str(index) for index in range(count)),
        np.array(control),
        np.concatenate(local),
        np.zeros((count, 3, 3)),
        np.concatenate(geo),
        np.concatenate(cov),
    )


def rms(errors: FloatArray) -> tuple[float, float]:
    """Horizontal and vertical root mean square of errors (…, 3)."""
    east, north, up = (errors**2).reshape(-1, 3).mean(axis=0)
    return float(np.sqrt(east + north)), float(np.sqrt(up))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path, help="trained, with check points")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exact-images", action="store_true", help="draw fixes and control points only")
    options = parser.parse_args()
    workspace = Workspace(options.workspace)
    trained = load_trained(workspace)
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    solved = solve_survey(trained, initial, geographic_options_of(workspace))
    points = trained.survey.check_points
    rays = mark_rays(points, trained.sparse)
    control = None if solved.problem.control is None else MarkedPoints.of(solved, control_rays(solved))
    truth = Truth(solved, control, MarkedPoints.of(solved, rays))
    bound = np.sqrt(np.diagonal(cramer_rao_bound(solved, rays), axis1=1, axis2=2))
    clock, errors = time.perf_counter(), []
    for run in range(options.runs):
        rng = np.random.default_rng([options.seed, run])
        drawn = draw(truth, rng, images=not options.exact_images)
        errors.append([found - drawn.check_in_geo for found in estimate(truth, drawn, rng)])
    seconds = time.perf_counter() - clock
    least = rms(bound)
    print(f"{options.runs} runs, {len(points)} check points, {seconds:.0f} s")
    print(f"Cramér–Rao bound:        {least[0]:.4f} m H, {least[1]:.4f} m V")
    for name, found in zip(("init-sim3", "similarity and cameras"), np.array(errors).swapaxes(0, 1), strict=True):
        h, v = rms(found)
        print(f"{name + ':':24s} {h:.4f} m H, {v:.4f} m V; × bound: {h / least[0]:.3f} H, {v / least[1]:.3f} V")


if __name__ == "__main__":
    main()
