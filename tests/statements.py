"""The statement of accuracy that a survey ends with, and the true errors that it is about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import minimise
from pipelines.adjust.prediction import AccuracyPrediction
from pipelines.adjust.solved_survey import solve_survey
from pipelines.core.cautions import Caution
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.marks import mark_rays
from pipelines.scene.points_by_camera import points_by_camera
from pipelines.scene.scene import initial_scene
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import TrainedCamera, TrainedLens
from pipelines.scene.trained_survey import TrainedSurvey
from tests.scenes import trained_model

OPTIONS = GeographicOptions(rel_loss=False)


@dataclass(frozen=True)
class Statement:
    """Result of a survey at its J check points.

    Attributes:
        position_in_geo: (J, 3) by camera.
        cov_in_geo: (J, 3, 3) predicted.
        initial: product of `init-sim3`.
        warnings: of `init-sim3`.
    """

    position_in_geo: np.ndarray
    cov_in_geo: np.ndarray
    initial: InitialSimilarity
    warnings: tuple[str, ...]

    @property
    def cautions(self) -> tuple[Caution, ...]:
        """Cautions of the result."""
        return self.initial.cautions

    @property
    def codes(self) -> set[str]:
        """Codes of the cautions."""
        return {caution.code for caution in self.cautions}

    def normalised_errors(self, true_in_geo: np.ndarray) -> np.ndarray:
        """Return normalised errors² (J,), each of expectation 1."""
        error = self.position_in_geo - true_in_geo
        return np.einsum("ji,jik,jk->j", error, np.linalg.inv(self.cov_in_geo), error) / 3

    def sigmas_off(self, true_in_geo: np.ndarray) -> float:
        """Return the RMS error over the RMS σ, of the worse of the horizontal and the vertical."""
        squared = ((self.position_in_geo - true_in_geo) ** 2).mean(axis=0)
        variance = np.diagonal(self.cov_in_geo, axis1=1, axis2=2).mean(axis=0)
        return float(np.sqrt(max(squared[:2].sum() / variance[:2].sum(), squared[2] / variance[2])))


def state(survey: Survey, model: SparseModel, options: InitSim3Options | None = None) -> Statement:
    """Return the statement that a survey and its SfM model end with, after a training without photographs.

    Raises:
        GeorefError: a stage refuses the survey.
    """
    points = geolocate(survey, model, GeolocateOptions()).points
    initial, warnings = estimate_similarity(survey, model, points, options or InitSim3Options())
    weighted = initial.weighted(survey)
    scene = initial_scene(model, weighted, initial)
    problem = geo_problem(scene, weighted, initial, OPTIONS)
    minimise(problem)
    poses, lens = problem.cameras.current(), problem.cameras.lens().detach().numpy()
    lenses = model.lenses.moved(lens).cameras if len(lens) else {}
    shift = -np.einsum("nij,nj->ni", poses.cam_from_model, poses.cam_center_in_model)
    product = trained_model(
        problem.similarity.current(),
        scene.model_from_local,
        cameras=tuple(
            TrainedCamera(name=name, split="train", quat_xyzw=tuple(quat), translation=tuple(translation))
            for name, quat, translation in zip(
                model.image_name, quat_xyzw_from_matrix(poses.cam_from_model), shift, strict=True
            )
        ),
    ).model_copy(
        update={
            "lenses": tuple(
                TrainedLens(camera_id=key, model=camera.model, params=tuple(camera.params.tolist()))
                for key, camera in lenses.items()
            )
        }
    )
    trained = TrainedSurvey(weighted, model, product, poses, gaussians=None)  # type: ignore[arg-type]
    rays = mark_rays(weighted.check_points, trained.sparse)
    position = points_by_camera(trained, rays)
    prediction = AccuracyPrediction(solve_survey(trained, initial, OPTIONS))
    return Statement(position, prediction.of_marked_points(position, rays), initial, warnings)


def geo_from_local(statement: Statement) -> Similarity:
    """Return the similarity of a statement."""
    return Similarity.from_record(statement.initial.geo_from_local)
