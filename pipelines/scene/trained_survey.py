"""A trained model, read back for evaluation: cameras in `model`, the similarity, and the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.core.stages import GAUSSIANS, MODEL, SIM3, SPARSE, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity, SimilarityRecord
from pipelines.geometry.sparse_model import SparseModel
from pipelines.georef.cameras import CameraPoses
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.photographs import ImageCache
from pipelines.scene.pinholes import Pinholes
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import TrainedModel
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.storage import read_gaussians


@dataclass(frozen=True)
class TrainedSurvey:
    """What training left.

    Attributes:
        survey: what was measured.
        sfm: the SfM model, with SfM's lenses; its images have the order of `poses`.
        model: similarity, cameras, settings.
        poses: refined cameras in `model`.
        gaussians: in `model`.
    """

    survey: Survey
    sfm: SparseModel
    model: TrainedModel
    poses: CameraPoses
    gaussians: Gaussians

    @cached_property
    def sparse(self) -> SparseModel:
        """The SfM model with the trained lenses."""
        trained = {
            lens.camera_id: replace(self.sfm.cameras[lens.camera_id], params=np.array(lens.params))
            for lens in self.model.lenses
        }
        return replace(self.sfm, cameras=self.sfm.cameras | trained)

    @property
    def geo_from_model(self) -> Similarity:
        """The refined similarity."""
        return Similarity.from_record(self.model.geo_from_model)

    def indices(self, split: str) -> list[int]:
        """Indices of the cameras of a split."""
        return [index for index, camera in enumerate(self.model.cameras) if camera.split == split]


def load_trained(workspace: Workspace, similarity: Literal["trained", "initial"] = "trained") -> TrainedSurvey:
    """Read the products of ingest, sfm and train.

    Args:
        similarity: what places the model on Earth: `geo_from_model` as training left it, or that which follows
            from the similarity of init-sim3, whatever training made of its own.

    Raises:
        MissingProductError: one of them is not there.
        InputError: they do not belong together.
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
        record = _placed(model, load_json(InitialSimilarity, workspace.path(SIM3)))
        model = model.model_copy(update={"geo_from_model": record})
    rotation = matrix_from_quat_xyzw([camera.quat_xyzw for camera in model.cameras])
    translation = np.array([camera.translation for camera in model.cameras])
    return TrainedSurvey(
        survey=load_json(Survey, workspace.path(SURVEY)),
        sfm=sparse,
        model=model,
        poses=CameraPoses(rotation, -np.einsum("nji,nj->ni", rotation, translation)),
        gaussians=read_gaussians(workspace.path(GAUSSIANS)),
    )


def trained_pinholes(trained: TrainedSurvey, images: ImageCache) -> Pinholes:
    """Cameras of the photographs that were undistorted with SfM's lenses, as the trained ones have them."""
    found = Pinholes(images, trained.sfm.lenses)
    found.renew(trained.sparse.lenses)
    return found


def _placed(model: TrainedModel, initial: InitialSimilarity) -> SimilarityRecord:
    """`geo_from_model` of a similarity geo ← local; its covariance, of a movement on Earth, stays as it is."""
    geo_from_local = Similarity.from_record(initial.geo_from_local)
    geo_from_model = geo_from_local @ Similarity.from_record(model.model_from_local).inverse()
    covariance = np.array(initial.geo_from_local.covariance)
    return geo_from_model.to_record("model", "geo", covariance=covariance, pivot=initial.geo_from_local.pivot)
