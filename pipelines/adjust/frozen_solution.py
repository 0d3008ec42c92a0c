"""Solution of similarity, cameras, lens and constant errors, found once and held while Gaussians are trained.

A large survey is trained in blocks. If each block corrected its own cameras, its place on Earth would differ from
its neighbours'. One solution of all measurements, without photographs, is therefore held in every block.
"""

from __future__ import annotations

import numpy as np

from pipelines.adjust.cameras import CameraCorrections, HeldCorrections
from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.posterior import minimise, solution_covariances
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.core.cautions import union
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.scene import Scene
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import FrozenSolution, TrainedCamera, TrainedLens


def solve_once(
    scene: Scene, survey: Survey, initial: InitialSimilarity, options: GeographicOptions
) -> FrozenSolution:
    """Return the solution of all measurements of a survey, without photographs.

    L_rel is left out, because its distances repeat the fixes.

    Args:
        scene: cameras and points at the start of the training.
        survey: the measurements, with the variance factors of `initial`.
        initial: similarity of `init-sim3`.
        options: which measurements are used, and the constant errors to estimate.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
        InputError: a constant error is to be estimated, but its measurements were not recorded.
    """
    solving = options.model_copy(update={"rel_loss": False}).without_photographs(len(scene.sparse.image_name))
    problem = geo_problem(scene, survey, initial, solving)
    if problem.terms:
        minimise(problem)
    return solution_of(problem, scene, initial)


def solve_and_hold(problem: GeoProblem) -> None:
    """Move a problem with the information of its bundle to its minimum, and let training learn nothing of it.

    A problem whose cameras training refines stays as it is.

    Raises:
        ConvergenceError: the cameras do not settle.
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    if problem.bundle is not None:
        minimise(problem)
        problem.requires_grad_(requires_grad=False)


def solution_of(problem: GeoProblem, scene: Scene, initial: InitialSimilarity) -> FrozenSolution:
    """Return the present state of a problem as a product, with its covariances.

    Args:
        problem: similarity, cameras and constant errors with their measurements.
        scene: cameras at the start of the training.
        initial: similarity at the start of the training. Its verdict on each measurement stands: a training that
            is not at its minimum yet would blame good measurements. Its cautions are carried on.

    Raises:
        DegenerateGeometryError: the measurements do not determine the similarity.
    """
    similarity, control = problem.similarity, problem.control
    measured = problem.fixes is not None or control is not None
    covariance, of_errors = solution_covariances(problem) if measured else (similarity.prior_covariance(), None)
    return FrozenSolution(
        geo_from_model=similarity.current().to_record(
            "model", "geo", covariance=covariance, pivot=similarity.pivot_in_geo
        ),
        model_from_local=scene.model_from_local.to_record("local", "model"),
        cameras=_cameras(problem, scene),
        lenses=_lenses(problem, scene),
        gnss_outliers=initial.gnss_outliers,
        control_outliers=initial.control_outliers,
        estimated_errors=() if of_errors is None else problem.errors.estimates(of_errors),
        variance_factors=initial.variance_factors,
        cautions=union(initial.cautions),
    )


def with_exposures(solution: FrozenSolution, exposure: FloatArray) -> FrozenSolution:
    """Return a solution with the exposures (n, 3, 4) of its training cameras."""
    cameras = tuple(
        camera.model_copy(update={"exposure": tuple(map(tuple, affine.tolist()))})
        if camera.split == "train"
        else camera
        for camera, affine in zip(solution.cameras, exposure, strict=True)
    )
    return solution.model_copy(update={"cameras": cameras})


def exposures_of(solution: FrozenSolution) -> FloatArray | None:
    """Return the exposures (n, 3, 4) of a solution, the identity for cameras without one; None: nobody has one."""
    if all(camera.exposure is None for camera in solution.cameras):
        return None
    return np.array([np.eye(3, 4) if camera.exposure is None else camera.exposure for camera in solution.cameras])


def held_problem(scene: Scene, solution: FrozenSolution) -> GeoProblem:
    """Return the problem of a training that holds similarity, cameras and lens of a solution.

    The problem has no measurement, so that its loss is zero and nothing moves.
    """
    record = solution.geo_from_model
    similarity = LearnableSimilarity(
        Similarity.from_record(record), np.array(record.covariance), np.array(record.pivot)
    )
    sfm = scene.sparse.lenses
    lens = sfm.change_to(solution.with_lenses(scene.sparse).lenses) if solution.lenses else np.zeros(0)
    held = HeldCorrections(np.zeros((len(solution.cameras), 6)), lens)
    return GeoProblem(similarity, CameraCorrections.held(solution.poses, held), ())


def _cameras(problem: GeoProblem, scene: Scene) -> tuple[TrainedCamera, ...]:
    poses, train = problem.cameras.current(), set(map(int, scene.train))
    quats = quat_xyzw_from_matrix(poses.cam_from_model)
    translations = -np.einsum("nij,nj->ni", poses.cam_from_model, poses.cam_center_in_model)
    return tuple(
        TrainedCamera(
            name=name,
            split="train" if index in train else "test",
            quat_xyzw=tuple(quats[index]),
            translation=tuple(translations[index]),
        )
        for index, name in enumerate(scene.sparse.image_name)
    )


def _lenses(problem: GeoProblem, scene: Scene) -> tuple[TrainedLens, ...]:
    """Return the lenses that have followed the cameras; none if the lenses were held."""
    change = problem.cameras.lens().detach().cpu().numpy()
    if not len(change):
        return ()
    return tuple(
        TrainedLens(camera_id=key, model=camera.model, params=tuple(camera.params.tolist()))
        for key, camera in scene.sparse.lenses.moved(change).cameras.items()
    )
