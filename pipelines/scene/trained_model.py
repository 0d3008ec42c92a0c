"""Product of `train` beside the Gaussians: frames, cameras, lenses, constant errors; and the part of it without
Gaussians.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from pipelines.core.cautions import Caution
from pipelines.core.products import ImageName, Product, Rotation
from pipelines.core.types import Matrix34, Vector3
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.estimated_error import EstimatedError
from pipelines.scene.variance_factors import VarianceFactor


class TrainedCamera(Product):
    """Pose `cam_from_model` of a camera after training. A test camera has moved only with its neighbours.

    Attributes:
        name: of the image.
        split: use of the image.
        quat_xyzw: rotation cam ← model.
        translation: metres, p_cam = R p_model + translation.
        exposure: gain matrix and offset (A | b): the photograph shows a colour c as A c + b. None: not estimated.
    """

    name: ImageName
    split: Literal["train", "test"]
    quat_xyzw: Rotation
    translation: Vector3
    exposure: Matrix34 | None = None


class TrainedLens(Product):
    """Lens of a camera of the SfM model after training: COLMAP's parameters of COLMAP's camera model."""

    camera_id: int
    model: str
    params: tuple[float, ...]


class FrozenSolution(Product):
    """Solution of all that does not depend on Gaussians: similarity, cameras, lenses, constant errors.

    Attributes:
        format_version: version of the format.
        geo_from_model: similarity with its covariance.
        model_from_local: fixed similarity from the SfM frame.
        cameras: corrected cameras, in the order of the SfM model's images.
        lenses: corrected lenses; a camera of the SfM model without one keeps SfM's lens.
        gnss_outliers, control_outliers: names of the images whose fixes, and of the control points that `init-sim3`
            has rejected: they entered no solution.
        estimated_errors: constant errors of the measurements.
        variance_factors: tests of the stated σ, of the initial similarity.
        cautions: limits: those of the initial similarity, then the solution's own.
    """

    format_version: Literal[1] = 1
    geo_from_model: SimilarityRecord
    model_from_local: SimilarityRecord
    cameras: tuple[TrainedCamera, ...]
    lenses: tuple[TrainedLens, ...] = ()
    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    estimated_errors: tuple[EstimatedError, ...] = ()
    variance_factors: tuple[VarianceFactor, ...] = ()
    cautions: tuple[Caution, ...] = ()

    @property
    def poses(self) -> CameraPoses:
        """Cameras in `model`."""
        rotation = matrix_from_quat_xyzw([camera.quat_xyzw for camera in self.cameras])
        translation = np.array([camera.translation for camera in self.cameras])
        return CameraPoses(rotation, -np.einsum("nji,nj->ni", rotation, translation))

    def with_lenses(self, sfm: SparseModel) -> SparseModel:
        """Return the SfM model with the lenses of this solution."""
        solved = {
            lens.camera_id: replace(sfm.cameras[lens.camera_id], params=np.array(lens.params))
            for lens in self.lenses
        }
        return replace(sfm, cameras=sfm.cameras | solved)


class TrainedModel(FrozenSolution):
    """Product of `train` beside the Gaussians: the solution of the training, and its settings.

    Attributes:
        max_image_size: limit of the longer side of the training photographs, in pixels.
        background: colour behind the Gaussians, RGB.
        sh_degree: degree of the spherical harmonics.
        iterations: iterations of the training.
        gaussians: number of Gaussians.
        backend: rasteriser of the training.
    """

    max_image_size: int = Field(gt=0)
    background: Vector3
    sh_degree: int
    iterations: int
    gaussians: int
    backend: Literal["cpu", "cuda"]
