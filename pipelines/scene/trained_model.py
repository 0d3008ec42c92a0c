"""Product of `train` beside the Gaussians: frames, cameras, lenses, constant errors."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.cautions import Caution
from pipelines.core.products import ImageName, Product, Rotation
from pipelines.core.types import Matrix34, Vector3
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.georef.estimated_error import EstimatedError
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


class TrainedModel(Product):
    """Product of `train` beside the Gaussians: frames, cameras, lenses and constant errors.

    Attributes:
        format_version: version of the format.
        geo_from_model: trained similarity with its covariance.
        model_from_local: fixed similarity from the SfM frame.
        max_image_size: limit of the longer side of the training photographs, in pixels.
        cameras: trained cameras, in the order of the SfM model's images.
        lenses: trained lenses; a camera of the SfM model without one keeps SfM's lens.
        background: colour behind the Gaussians, RGB.
        sh_degree: degree of the spherical harmonics.
        iterations: iterations of the training.
        gaussians: number of Gaussians.
        backend: rasteriser of the training.
        gnss_outliers: names of the images whose fixes contradict the solution.
        control_outliers: names of the control points that contradict the solution.
        estimated_errors: constant errors of the measurements.
        variance_factors: tests of the stated σ, of the initial similarity.
        cautions: limits of the model: those of the initial similarity, then the training's own.
    """

    format_version: Literal[1] = 1
    geo_from_model: SimilarityRecord
    model_from_local: SimilarityRecord
    max_image_size: int = Field(gt=0)
    cameras: tuple[TrainedCamera, ...]
    lenses: tuple[TrainedLens, ...] = ()
    background: Vector3
    sh_degree: int
    iterations: int
    gaussians: int
    backend: Literal["cpu", "cuda"]
    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    estimated_errors: tuple[EstimatedError, ...] = ()
    variance_factors: tuple[VarianceFactor, ...] = ()
    cautions: tuple[Caution, ...] = ()
