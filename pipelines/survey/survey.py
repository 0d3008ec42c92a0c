"""Measurements of a survey, product of `ingest`.

All positions are in the frame `geo`: East-North-Up metres at the survey's origin. Without an origin, `geo` is a
local metric frame, z up, with no place on Earth.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, ConfigDict, Field, model_validator

from pipelines.core.errors import InputError
from pipelines.core.json_values import JsonValue
from pipelines.core.options import WRITTEN, from_text, listed_names
from pipelines.core.products import Covariance3, ImageName, Product, Remark, Rotation
from pipelines.core.types import Matrix3, Vector3, vector3
from pipelines.core.validators import image_dir
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.cameras import Camera
from pipelines.survey.common_points import CommonPoints

LOCAL_FRAME = "local-frame"  # code of the caution that a survey has no place on Earth
# What places a camera beside the instruments; the adjustment solves it. The time offset comes before all of that.
MountParameter = Literal["boresight", "lever-arm"]
MOUNT_PARAMETERS: tuple[MountParameter, ...] = get_args(MountParameter)
RigParameter = Literal["time-offset", "boresight", "lever-arm"]
RIG_PARAMETERS: tuple[RigParameter, ...] = get_args(RigParameter)
# σ of the drift of positions within a session, horizontal and vertical in metres, by kind of receiver, and its time
# constant: satellites' orbits and clocks, atmosphere and reflections change within minutes. With corrections from a
# base station next to nothing is left of it.
DRIFT_SIGMA_M = {"RTK float": (0.2, 0.4), "single-frequency": (1.5, 3.0), "unknown receiver": (2.0, 4.0)}
DRIFT_TIME_S = 300.0


def in_usual_order(names: Container[RigParameter]) -> tuple[RigParameter, ...]:
    """Return the named parameters of the rig in their usual order, without repetition."""
    return tuple(name for name in RIG_PARAMETERS if name in names)


# Type of the option that names parameters of the mount.
MountParameters = Annotated[
    tuple[MountParameter, ...], from_text(lambda text: listed_names(text, MOUNT_PARAMETERS)), WRITTEN
]


_NotNegative = Annotated[float, Field(ge=0)]


# A stated focal length is rounded, from a nominal sensor, or the 35 mm equivalent of another crop: real ones differ
# from the solved by up to a tenth. Beyond the second factor no tag of the same lens is.
FOCAL_DIFFERS, FOCAL_APART = 1.15, 1.5


class CameraPrior(Product):
    """Intrinsics of a camera before SfM: COLMAP's model and parameters, in pixels of the full image.

    `serial` is its serial number and `sensor` its kind (thermal, a band), as far as the photographs state them.
    """

    camera_id: int = Field(ge=1)
    model: str
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    params: tuple[float, ...]
    focal_source: Literal["exif", "option", "assumed", "calibrated"]
    make_model: str = ""
    serial: str = ""
    sensor: str = ""
    readout_s: float = Field(0.0, ge=0, le=1)  # of a rolling shutter, from the first row to the last; 0: global

    @property
    def camera(self) -> Camera:
        """Return the camera that these intrinsics describe."""
        return Camera(self.model, self.width, self.height, np.array(self.params))

    def focal_factor(self, solved: Camera) -> float:
        """Return the factor, 1 or more, between the focal length of a solved camera and the stated one.

        1 where none is stated: an assumed one contradicts nothing. `FOCAL_DIFFERS` and `FOCAL_APART` judge it.
        """
        if self.focal_source == "assumed":
            return 1.0
        ratio = solved.mean_focal_px / self.camera.mean_focal_px
        return max(ratio, 1 / ratio)


class Fix(Product):
    """Measured position of a camera centre in metres and m²; `session` is an index into the survey's `sessions`.

    `source` is the kind of file that it was read from, such as `exif`, `csv` or `bag`. `sigma_zero_m` is the
    vertical σ of a zero that is doubtful, such as that of heights above the take-off: a part of `cov_in_geo`, but
    common to all fixes of the session, whose `sigma_common_m` has it, too. 0: the zero is that of the datum.
    `common_along_m` is the part of the covariance, as a vector of one σ, that an error of all times causes: an
    estimated time offset removes it.
    """

    position_in_geo: Vector3
    cov_in_geo: Covariance3
    common_along_m: Vector3 = (0.0, 0.0, 0.0)
    source: str
    sigma_source: Literal["file", "option", "default"]
    session: int = Field(0, ge=0)
    sigma_zero_m: float = Field(0.0, ge=0)

    @property
    def cov_apart(self) -> Matrix3:
        """Covariance of the position against the others of its session, without the doubtful zero."""
        return _with_zero(self.cov_in_geo, -(self.sigma_zero_m**2))

    def scaled(self, factor: float) -> Fix:
        """Return the fix with its own variances times a factor; that of a doubtful zero stays."""
        cov = np.array(self.cov_apart) * factor
        return self.model_copy(update={"cov_in_geo": _with_zero(cov, self.sigma_zero_m**2)})


def _with_zero(cov: ArrayLike, variance_up: float) -> Matrix3:
    changed = np.array(cov, dtype=np.float64)
    changed[2, 2] += variance_up
    return vector3(changed[0]), vector3(changed[1]), vector3(changed[2])


class FixSession(Product):
    """Fixes that share one error beside their own: of the base station, the receiver, or the day.

    `sigma_common_m` is its σ east, north, up, 0 for none along that axis; `receiver` is one of
    `ingest.flight_record.RECEIVERS`. `sigma_datum_m` is the part east, north, up that the reference system causes:
    a vertical datum that was assumed, a doubtful zero of heights, a transformation of limited accuracy.
    `sigma_drift_m` is the σ, by axis, of a further error that neighbouring fixes share, whose correlation decays
    with a time constant; its mean over the session is in the first. None: that of the kind of receiver
    (`DRIFT_SIGMA_M`).
    """

    receiver: str
    sigma_common_m: tuple[_NotNegative, _NotNegative, _NotNegative]
    sigma_datum_m: tuple[_NotNegative, _NotNegative, _NotNegative] = (0.0, 0.0, 0.0)
    sigma_source: Literal["file", "option", "default"]
    sigma_drift_m: tuple[_NotNegative, _NotNegative, _NotNegative] | None = None
    drift_time_s: float = Field(DRIFT_TIME_S, gt=0)

    @property
    def drift_m(self) -> Vector3:
        """σ of the drift by axis, as stated, or as of the kind of receiver."""
        if self.sigma_drift_m is not None:
            return self.sigma_drift_m
        horizontal_m, vertical_m = DRIFT_SIGMA_M.get(self.receiver, (0.0, 0.0))
        return (horizontal_m, horizontal_m, vertical_m)


class UsedTransformation(Product):
    """Transformation to WGS84 of coordinates of the input; the accuracy is the published one, None: unknown.

    `sigma_m` is the σ of each horizontal axis that it adds as an error common to all points of the file; 0: none.
    """

    of: Literal["positions", "control points", "check points"]
    file: str
    crs: str
    operation: str
    accuracy_m: float | None
    sigma_m: float = Field(0.0, ge=0)
    missing_grids: tuple[str, ...] = ()


class Attitude(Product):
    """Measured rotation of a camera, with σ per axis: `p_geo = R(quat_xyzw) p_cam + centre`.

    `source` is the kind of file that it was read from; `gimbal`: the photograph's own XMP.
    """

    quat_xyzw: Rotation
    sigma_deg: float = Field(gt=0)
    source: str


class SurveyImage(Product):
    """Photograph, named by its path relative to the survey's `image_dir`; its time is the camera clock's.

    `sha256` is empty in a survey written by hand: the photograph is not checked then. `mask_sha256` is the hash of
    `ingest/masks/NAME.png`, where black pixels are left out; empty: all pixels count. `sharpness` is over that of
    the photographs around it, None where nothing tells it.
    """

    name: ImageName
    camera_id: int
    sha256: str
    timestamp_s: float | None = None
    fix: Fix | None = None
    attitude: Attitude | None = None
    velocity_in_geo: Vector3 | None = None  # of a camera with a rolling shutter, m/s
    mask_sha256: str = ""
    split: Literal["train", "test"] = "train"
    sharpness: float | None = None


class Companion(Product):
    """Photograph of another lens of a rig, exposed together with a photograph of the survey, `beside`.

    Its place follows from that of the photograph beside it: it has no measured pose, and no part in training.
    `stated_quat_xyzw` is the rotation of the lens, lens ← lens of the photograph beside it, if somebody stated it.
    """

    name: ImageName
    camera_id: int
    sha256: str
    beside: ImageName
    stated_quat_xyzw: Rotation | None = None


class Original(Product):
    """Photograph as it was taken, of which the folder of the survey has a copy with fewer bits."""

    name: ImageName
    sha256: str


class Mark(Product):
    """Image coordinates of a surveyed point: pixels of the full image, centre of the top-left pixel (0.5, 0.5)."""

    image: ImageName
    x_px: float
    y_px: float
    sigma_px: float = Field(gt=0)


class PointMarks(Product):
    """Point of the scene that is marked in photographs."""

    name: str
    marks: tuple[Mark, ...]

    @model_validator(mode="after")
    def _is_marked_once_an_image(self) -> PointMarks:
        images = [mark.image for mark in self.marks]
        if len(set(images)) != len(images):
            raise ValueError("marks: two are in one image")
        return self


class SurveyedPoint(PointMarks):
    """Control or check point: position in geo (m), 3×3 covariance (m²), marks, and what covers the ground there."""

    position_in_geo: Vector3
    cov_in_geo: Covariance3
    land_cover: Literal["open", "vegetated"] = "open"


class UnmarkedPoint(SurveyedPoint):
    """Surveyed point with marks in fewer than two images: it enters nothing until it is marked."""

    use: Literal["control", "check"]


class KnownDistance(Product):
    """Measured distance between two marked points, as of a scale bar: an observation, or a check of the scale."""

    ends: tuple[PointMarks, PointMarks]
    distance_m: float = Field(gt=0)
    sigma_m: float = Field(gt=0)
    use: Literal["control", "check"] = "control"

    @property
    def name(self) -> str:
        return "–".join(end.name for end in self.ends)


class Survey(Product):
    """Product of `ingest`: all measurements of a survey, in one frame.

    Positions and attitudes are as recorded, with the rig that was given to `ingest`. `navigation.load_survey`
    replaces that rig by the estimates of `calibrate`.

    Attributes:
        origin: of the frame `geo`; None: the frame is local, because nothing places the survey on Earth.
        image_dir: folder of photographs, absolute or inside the workspace.
        sessions: groups of fixes with one common error each; empty: no common error is modelled.
        transformations: ways of the input's coordinates to WGS84, where their CRS is another.
        sigma_datum_m: σ east, north, up that all control points share, because their CRS is tied to WGS84 no
            better; no adjustment reveals it, and all absolute σ of a result with control points include it.
        companions: photographs of the other lenses of a rig.
        original_dir: folder of the `originals`, which have the names of their copies.
        check_points: points that enter no solution.
        assumptions: decisions that `ingest` made where the input states nothing.
        cautions: limits of every result of the survey.
        estimate: parameters of the rig to be estimated after sfm: the time offset by `calibrate`, the mount by the
            adjustment.
        default_sigmas: groups of measurements whose σ nobody stated.
        common: points in common with an earlier date, which `sfm` finds; no part of the file.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    format_version: Literal[2] = 2
    origin: Origin | None
    source_crs: str
    vertical: VerticalDatum
    image_dir: Annotated[str, AfterValidator(image_dir)]
    cameras: tuple[CameraPrior, ...]
    images: tuple[SurveyImage, ...]
    companions: tuple[Companion, ...] = ()
    original_dir: Annotated[str, AfterValidator(image_dir)] | None = None
    originals: tuple[Original, ...] = ()
    sessions: tuple[FixSession, ...] = ()
    transformations: tuple[UsedTransformation, ...] = ()
    sigma_datum_m: Vector3 = (0.0, 0.0, 0.0)
    control_points: tuple[SurveyedPoint, ...] = ()
    check_points: tuple[SurveyedPoint, ...] = ()
    unmarked_points: tuple[UnmarkedPoint, ...] = ()
    distances: tuple[KnownDistance, ...] = ()
    assumptions: tuple[Remark, ...] = ()
    warnings: tuple[Remark, ...] = ()
    cautions: tuple[Remark, ...] = ()
    estimate: tuple[RigParameter, ...] = ()
    default_sigmas: tuple[Literal["fixes", "control points", "marks", "attitudes"], ...] = ()
    common: CommonPoints | None = Field(None, exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _is_of_this_version(cls, document: JsonValue) -> Any:
        if isinstance(document, dict) and document.get("format_version") == 1:
            raise ValueError(
                "an earlier version of georef made this survey, without the common errors of its positions: run "
                "`georef ingest` again, which knows its options"
            )
        return document

    @model_validator(mode="after")
    def _belongs_together(self) -> Survey:
        names = {
            "images": [image.name for image in self.images] + [each.name for each in self.companions],
            "control_points": [point.name for point in self.control_points],
            "check_points": [point.name for point in self.check_points],
            "unmarked_points": [point.name for point in self.unmarked_points],
            "distances": [distance.name for distance in self.distances],
        }
        for field, of_field in names.items():
            if len(set(of_field)) != len(of_field):
                raise ValueError(f"{field}: two have the same name")
        cameras = {camera.camera_id for camera in self.cameras}
        everything: tuple[SurveyImage | Companion, ...] = (*self.images, *self.companions)
        lost = next((image for image in everything if image.camera_id not in cameras), None)
        if lost is not None:
            raise ValueError(f"images: {lost.name} has camera {lost.camera_id}, which is not among the cameras")
        photographed = set(names["images"][: len(self.images)])
        alone = next((each for each in self.companions if each.beside not in photographed), None)
        if alone is not None:
            raise ValueError(f"companions: {alone.name} is beside {alone.beside}, which is not among the images")
        fixed = [(image, image.fix) for image in self.images if self.sessions and image.fix is not None]
        stray = next(((image, fix) for image, fix in fixed if fix.session >= len(self.sessions)), None)
        if stray is not None:
            raise ValueError(
                f"images: {stray[0].name} has session {stray[1].session}, which is not among the sessions"
            )
        return self

    @property
    def origin_on_earth(self) -> Origin:
        """Return the origin; an InputError: the survey has none."""
        if self.origin is None:
            raise InputError(
                "not-on-earth",
                "The survey has a local metric frame and no place on Earth, which this needs.",
                remedy="Run `georef ingest` with positions or control points.",
            )
        return self.origin

    def with_companions(self) -> Survey:
        """Return the survey whose images are also the companions, with the measured poses of those beside them."""
        beside = {image.name: image for image in self.images}
        more = (
            beside[each.beside].model_copy(
                update={"name": each.name, "camera_id": each.camera_id, "sha256": each.sha256, "mask_sha256": ""}
            )
            for each in self.companions
        )
        return self.model_copy(update={"images": (*self.images, *more)})

    @property
    def largest_photograph_px(self) -> tuple[int, int]:
        largest = max(self.cameras, key=lambda camera: camera.width * camera.height)
        return largest.width, largest.height

    @property
    def unknown_mount(self) -> tuple[MountParameter, ...]:
        """Parameters of the mount that the adjustment is to solve, in their usual order."""
        return tuple(name for name in MOUNT_PARAMETERS if name in self.estimate)

    @property
    def drifts(self) -> bool:
        """Whether the fixes of any session drift."""
        return any(any(session.drift_m) for session in self.sessions)

    def names(self, split: Literal["train", "test"]) -> tuple[str, ...]:
        """Return the names of the images in a split, in order."""
        return tuple(image.name for image in self.images if image.split == split)
