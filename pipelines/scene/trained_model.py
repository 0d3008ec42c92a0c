"""The product of `train` beside the Gaussians: frames, cameras, lenses, constant errors."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.products import ImageName, Product, Rotation
from pipelines.core.types import Matrix34, Vector3
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.georef.estimated_error import EstimatedError


class TrainedCamera(Product):
    """A camera after training, as `cam_from_model`. A test camera has moved only with its neighbours.

    `exposure` is the gain matrix and offset (A | b) with which the photograph shows a colour c: A c + b.
    """

    name: ImageName
    split: Literal["train", "test"]
    quat_xyzw: Rotation
    translation: Vector3
    exposure: Matrix34 | None = None


class TrainedLens(Product):
    """The lens of a camera of the SfM model after training: COLMAP's parameters of COLMAP's camera model."""

    camera_id: int
    model: str
    params: tuple[float, ...]


class TrainedModel(Product):
    """Product of `train` beside the Gaussians: frames, cameras and what was optimised.

    `lenses`: of the cameras of the SfM model; one that is not among them is as SfM found it.
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
