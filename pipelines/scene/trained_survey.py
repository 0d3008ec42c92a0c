"""Trained survey, read from the workspace: cameras in `model`, the similarity, and the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json
from pipelines.core.stages import GAUSSIANS, MODEL, SIM3, SPARSE
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity, SimilarityRecord
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.calibrated import load_survey
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.photographs import ImageCache
from pipelines.scene.pinholes import Pinholes
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import TrainedModel
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.storage import read_gaussians


@dataclass(frozen=True)
class TrainedSurvey:
    """Survey with its trained model.

    Attributes:
        survey: the measurements.
        sfm: the SfM model with SfM's lenses; its images have the order of `poses`.
        model: similarity, cameras, settings.
        poses: trained cameras in `model`.
        gaussians: Gaussians in `model`.
    """

    survey: Survey
    sfm: SparseModel
    model: TrainedModel
    poses: CameraPoses
    gaussians: Gaussians

    @cached_property
    def sparse(self) -> SparseModel:
        """SfM model with the trained lenses."""
        return self.model.with_lenses(self.sfm)

    @property
    def geo_from_model(self) -> Similarity:
        """Similarity of `model`."""
        return Similarity.from_record(self.model.geo_from_model)

    @property
    def point_in_model(self) -> FloatArray:
        """SfM points (N, 3) in `model`, in metres."""
        return Similarity.from_record(self.model.model_from_local).apply(self.sfm.point_in_local)

    def indices(self, split: str) -> list[int]:
        """Return the indices of the cameras of a split."""
        return [index for index, camera in enumerate(self.model.cameras) if camera.split == split]


def load_trained(workspace: Workspace, similarity: Literal["trained", "initial"] = "trained") -> TrainedSurvey:
    """Read the products of ingest, sfm and train.

    Args:
        workspace: holds the products.
        similarity: choice of `geo_from_model`: the trained one, or the one that follows from init-sim3.

    Raises:
        MissingProductError: a product does not exist.
        InputError: a product is damaged, or the cameras or lenses of `train` are not those of `sfm`.
    """
    model_path = workspace.path(MODEL)
    model = load_json(TrainedModel, model_path)
    sparse = read_sparse(workspace.path(SPARSE))
    names = tuple(camera.name for camera in model.cameras)
    if names != sparse.image_name:
        raise InputError("its cameras are not those of sfm/sparse: train again", path=model_path, field="cameras")
    for lens in model.lenses:
        camera = sparse.cameras.get(lens.camera_id)
        if camera is None or (camera.model, len(camera.params)) != (lens.model, len(lens.params)):
            raise InputError("its lenses are not those of sfm/sparse: train again", path=model_path, field="lenses")
    if similarity == "initial":
        record = _initially_placed(model, load_json(InitialSimilarity, workspace.path(SIM3)))
        model = model.model_copy(update={"geo_from_model": record})
    return TrainedSurvey(
        survey=_weighted_survey(workspace),
        sfm=sparse,
        model=model,
        poses=model.poses,
        gaussians=read_gaussians(workspace.path(GAUSSIANS)),
    )


def _weighted_survey(workspace: Workspace) -> Survey:
    """Return the survey with the variance factors of `init-sim3`; as stated for a model put there by hand."""
    survey = load_survey(workspace)
    try:
        return load_json(InitialSimilarity, workspace.path(SIM3)).weighted(survey)
    except MissingProductError:
        return survey


def trained_pinholes(trained: TrainedSurvey, images: ImageCache) -> Pinholes:
    """Return the pinholes of the photographs, undistorted with SfM's lenses, under the trained lenses."""
    pinholes = Pinholes(images, trained.sfm.lenses)
    pinholes.renew(trained.sparse.lenses)
    return pinholes


def _initially_placed(model: TrainedModel, initial: InitialSimilarity) -> SimilarityRecord:
    """Return `geo_from_model` of the initial similarity.

    The covariance carries over unchanged, because it describes a perturbation in the target frame `geo`.
    """
    geo_from_local = Similarity.from_record(initial.geo_from_local)
    geo_from_model = geo_from_local @ Similarity.from_record(model.model_from_local).inverse()
    covariance = np.array(initial.geo_from_local.covariance)
    return geo_from_model.to_record("model", "geo", covariance=covariance, pivot=initial.geo_from_local.pivot)
