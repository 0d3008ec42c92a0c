"""The statement of accuracy that a survey ends with, and the true errors that it is about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.core.products import Remark
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import mark_rays, triangulated_points
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey


@dataclass(frozen=True)
class Statement:
    """Result of a survey at its J check points.

    Attributes:
        position_in_geo: (J, 3) by camera.
        cov_in_geo: (J, 3, 3) predicted.
        solution: product of `init-sim3`.
        warnings: of `init-sim3`.
    """

    position_in_geo: np.ndarray
    cov_in_geo: np.ndarray
    solution: Solution
    warnings: tuple[Remark, ...]

    @property
    def cautions(self) -> tuple[Remark, ...]:
        """Cautions of the result."""
        return self.solution.cautions

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
    """Return the statement that a survey and its SfM model end with, without a training.

    Raises:
        GeorefError: a stage refuses the survey.
    """
    points = geolocate(survey, model, GeolocateOptions()).points
    posterior, warnings = estimate_similarity(survey, model, points, options or InitSim3Options())
    weighted = posterior.solution.weighted(survey)
    rays = mark_rays(weighted.check_points, posterior.sparse)
    position = triangulated_points(posterior.solution, rays)
    return Statement(position, posterior.of_marked_points(position, rays), posterior.solution, warnings)


def geo_from_local(statement: Statement) -> Similarity:
    """Return the similarity of a statement."""
    return Similarity.from_record(statement.solution.similarity_from_local())
