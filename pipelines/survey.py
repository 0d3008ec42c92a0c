"""The survey's records: what was measured, and with what. The products of `ingest`.

All places are in the frame `geo`: East-North-Up metres at the survey's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from pipelines.config import RigParameter
from pipelines.products import (
    Covariance3,
    FloatArray,
    ImageName,
    Product,
    Rotation,
    Vector3,
    load_npz,
    save_npz,
)
from pipelines.validators import image_dir


class Origin(Product):
    """Origin of the `geo` frame: WGS84 degrees and ellipsoidal metres."""

    lat_deg: float = Field(ge=-90, le=90)
    lon_deg: float = Field(ge=-180, le=180)
    alt_m: float


class VerticalDatum(Product):
    """What the input heights refer to, and whether the user (or file) said so or it was assumed."""

    name: str
    stated: bool
    note: str = ""


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


class RigEstimate(Product):
    """A parameter of the rig, estimated from the SfM cameras, in sense and unit of `ingest`'s option of that name.

    `start` is what `ingest` was told, `sigma` of each component; `observable` by component: whether σ is small
    enough to use it.
    """

    name: RigParameter
    unit: Literal["s", "deg", "m"]
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    start: tuple[float, ...]
    observable: tuple[bool, ...]

    @property
    def usable(self) -> bool:
        """Whether every component is observable."""
        return all(self.observable)


class RigCalibration(Product):
    """Estimates of the rig, and what is left over: robust σ per axis of positions (m) and attitudes (degrees).

    `problem` tells why there are none. `model` is the fingerprint of the SfM model that they are from, `layout`
    that of the survey's positions and attitudes before what is usable was applied to them.
    """

    wanted: tuple[RigParameter, ...]
    estimates: tuple[RigEstimate, ...] = ()
    images: int = 0
    control_points: int = 0
    rms_position_m: float | None = None
    rms_attitude_deg: float | None = None
    problem: str = ""
    model: str = ""
    layout: str = ""


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
        names = [image.name for image in self.images]
        if len(set(names)) != len(names):
            raise ValueError("images: two have the same name")
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


@dataclass(frozen=True)
class NavigationTrack:
    """Product of `ingest` beside the survey: the navigation as recorded, and how n cameras sit in it.

    What `calibrate` fits the SfM cameras to. Positions are the antenna's, attitudes the body's
    (forward-right-down), both on the navigation's clock; nothing of the rig is applied to them. What is said of the
    rig is what `ingest` was told.

    Attributes:
        position_time_s: (K,) float64, seconds.
        antenna_in_geo: (K, 3) float64, metres.
        sigma_m: (K, 3) float64, σ east, north, up; NaN where the receiver states none.
        attitude_time_s: (M,) float64, seconds.
        geo_from_body: (M, 3, 3) float64.
        image: (n,) names of images.
        image_time_s: (n,) float64, camera clock.
        cam_from_body: (n, 3, 3) float64, mount; NaN where unknown.
        antenna_in_body: (n, 3) float64, lever arm; NaN where unknown.
        nominal_from_cam: (3, 3) float64, boresight.
        time_offset_s: () float64, navigation clock minus camera clock.
        max_gap_s: () float64, longest gap to interpolate over.
        body_known: () bool; where not, the camera's nominal axes stand for the body's.
    """

    position_time_s: FloatArray
    antenna_in_geo: FloatArray
    sigma_m: FloatArray
    attitude_time_s: FloatArray
    geo_from_body: FloatArray
    image: NDArray[np.str_]
    image_time_s: FloatArray
    cam_from_body: FloatArray
    antenna_in_body: FloatArray
    nominal_from_cam: FloatArray
    time_offset_s: FloatArray
    max_gap_s: FloatArray
    body_known: NDArray[np.bool_]

    def save(self, path: Path) -> None:
        """Write as NPZ."""
        save_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> NavigationTrack:
        """Read from NPZ.

        Raises:
            InputError: not an NPZ file of that form.
        """
        return cls(**load_npz(path, tuple(field.name for field in fields(cls))))
