"""The survey's records: what was measured, and with what. The products of `ingest`.

All places are in the frame `geo`: East-North-Up metres at the survey's origin.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from pipelines.core.options import RigParameter
from pipelines.core.products import Covariance3, ImageName, Product, Rotation
from pipelines.core.types import Vector3
from pipelines.core.validators import image_dir
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.scene.rig import RigCalibration


class CameraPrior(Product):
    """Intrinsics before SfM. `params` are COLMAP's for `model`, in pixels of the full image."""

    camera_id: int = Field(ge=1)
    model: str
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    params: tuple[float, ...]
    focal_source: Literal["exif", "option", "assumed", "calibrated"]
    make_model: str = ""


class Fix(Product):
    """Measured position of a camera centre.

    `position_in_geo` in metres; `cov_in_geo` 3×3 in m²; `sigma_source` tells who gave σ.
    """

    position_in_geo: Vector3
    cov_in_geo: Covariance3
    source: Literal["exif", "csv", "geo.txt", "bag"]
    sigma_source: Literal["file", "option", "default"]


class Attitude(Product):
    """Measured rotation of a camera: `p_geo = R(quat_xyzw) p_cam + centre`, σ per axis in degrees."""

    quat_xyzw: Rotation
    sigma_deg: float = Field(gt=0)
    source: Literal["gimbal", "csv", "geo.txt", "bag"]


class SurveyImage(Product):
    """One photograph. `name` is relative to the survey's `image_dir`; `sha256` is of the file."""

    name: ImageName
    camera_id: int
    sha256: str
    timestamp_s: float | None = None
    fix: Fix | None = None
    attitude: Attitude | None = None
    split: Literal["train", "test"] = "train"


class Mark(Product):
    """Where a surveyed point is seen: full-image pixels, centre of the top-left pixel (0.5, 0.5)."""

    image: ImageName
    x_px: float
    y_px: float
    sigma_px: float = Field(gt=0)


class SurveyedPoint(Product):
    """A control or check point: position in geo (m), covariance (m²), its marks."""

    name: str
    position_in_geo: Vector3
    cov_in_geo: Covariance3
    marks: tuple[Mark, ...]

    @model_validator(mode="after")
    def _is_marked_once_an_image(self) -> SurveyedPoint:
        images = [mark.image for mark in self.marks]
        if len(set(images)) != len(images):
            raise ValueError("marks: two are in one image")
        return self


class Survey(Product):
    """Product of `ingest`: everything that was measured, in one frame.

    `estimate` names what of the rig is to be estimated after sfm, `rig` is what came out.
    """

    format_version: Literal[1] = 1
    origin: Origin
    source_crs: str
    vertical: VerticalDatum
    image_dir: Annotated[str, AfterValidator(image_dir)]
    cameras: tuple[CameraPrior, ...]
    images: tuple[SurveyImage, ...]
    control_points: tuple[SurveyedPoint, ...] = ()
    check_points: tuple[SurveyedPoint, ...] = ()
    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    estimate: tuple[RigParameter, ...] = ()
    rig: RigCalibration | None = None

    @model_validator(mode="after")
    def _belongs_together(self) -> Survey:
        names = {
            "images": [image.name for image in self.images],
            "control_points": [point.name for point in self.control_points],
            "check_points": [point.name for point in self.check_points],
        }
        for field, of_field in names.items():
            if len(set(of_field)) != len(of_field):
                raise ValueError(f"{field}: two have the same name")
        cameras = {camera.camera_id for camera in self.cameras}
        lost = next((image for image in self.images if image.camera_id not in cameras), None)
        if lost is not None:
            raise ValueError(f"images: {lost.name} has camera {lost.camera_id}, which is not among the cameras")
        return self

    def image(self, name: str) -> SurveyImage | None:
        """The image of that name, or None."""
        return next((image for image in self.images if image.name == name), None)

    def names(self, split: Literal["train", "test"]) -> tuple[str, ...]:
        """Names of the images in a split, in order."""
        return tuple(image.name for image in self.images if image.split == split)
