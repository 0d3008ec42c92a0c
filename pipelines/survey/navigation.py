"""Navigation of a survey as it was recorded, its calibration, and the survey with the calibration applied.

`ingest` writes the navigation, and `calibrate` the estimates of the rig that carries its instruments.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import ArrayProduct, ImageName, Product, Remark, load_json, union
from pipelines.core.stages import COMMON_POINTS, RIG, SURVEY, TRACK
from pipelines.core.types import BoolArray, FloatArray, Matrix3, Vector3, vector3
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import exp_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.trajectory import Rig, Trajectory, with_rig
from pipelines.survey.common_points import CommonPoints
from pipelines.survey.survey import (
    RIG_PARAMETERS,
    Attitude,
    Fix,
    RigParameter,
    Survey,
    SurveyImage,
    in_usual_order,
)

# A position that is farther from the median of all positions is a blunder.
FIX_RANGE_M = 100_000.0
FIX_LAG, FIX_LAG_OPEN = "fix-lag", "fix-lag-open"  # codes of cautions
ValueT = TypeVar("ValueT")
_COMPONENTS: dict[RigParameter, int] = {"time-offset": 1, "boresight": 3, "lever-arm": 3}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NavigationTrack(ArrayProduct):
    """Second product of `ingest`: the navigation as recorded, with the times and the rig of n photographs.

    `calibrate` fits the SfM cameras to this navigation. Positions are those of the antenna, attitudes those of the
    body (forward-right-down), both on the navigation's clock, without any correction by the rig. The rig is the one
    given to `ingest`. Lengths are metres, times seconds.

    Attributes:
        sigma_m: σ east, north, up; NaN where the receiver states none.
        image, image_time_s: names of images, and their times on the camera clock.
        cam_from_body, antenna_in_body: nominal mount and lever arm; NaN where unknown.
        nominal_from_cam: boresight, from the camera's axes to those of the nominal mount.
        time_offset_s: navigation clock minus camera clock.
        max_gap_s: longest gap to interpolate over.
        body_known: if false, the body's axes are set to the camera's nominal axes.
    """

    FORMS: ClassVar = {
        "position_time_s": ("f", "K"),
        "antenna_in_geo": ("f", "K", 3),
        "sigma_m": ("f", "K", 3),
        "attitude_time_s": ("f", "M"),
        "geo_from_body": ("f", "M", 3, 3),
        "image": ("U", "n"),
        "image_time_s": ("f", "n"),
        "cam_from_body": ("f", "n", 3, 3),
        "antenna_in_body": ("f", "n", 3),
        "nominal_from_cam": ("f", 3, 3),
        "time_offset_s": ("fi",),
        "max_gap_s": ("fi",),
        "body_known": ("b",),
    }

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
    body_known: BoolArray

    @property
    def positions(self) -> Trajectory:
        return Trajectory.from_samples(
            self.position_time_s,
            position=self.antenna_in_geo,
            sigma_m=self.sigma_m,
            max_gap_s=float(self.max_gap_s),
        )

    @property
    def attitudes(self) -> Trajectory:
        return Trajectory.from_samples(
            self.attitude_time_s, rotation=self.geo_from_body, max_gap_s=float(self.max_gap_s)
        )


def load_track(workspace: Workspace) -> NavigationTrack:
    """Return the navigation of a workspace's survey.

    Raises:
        InputError: the navigation was not recorded by time, or the file is damaged.
    """
    try:
        path = workspace.path(TRACK)
    except MissingProductError as error:
        raise InputError(
            "navigation-not-recorded",
            "The survey has one position for each image, and no navigation with times.",
            path=workspace.root / TRACK,
            remedy="Run `georef ingest` with --bag, or with a --trajectory that has times.",
        ) from error
    return NavigationTrack.load(path)


def shown_by(track: NavigationTrack | None) -> tuple[RigParameter, ...]:
    """Return the parameters of the rig that a recorded navigation can show, in their usual order.

    The boresight needs recorded attitudes and a mount, the lever arm recorded attitudes and the axes of the body.
    """
    if track is None or len(track.position_time_s) < 2:
        return ()
    turned = len(track.attitude_time_s) > 1
    mounted = turned and bool(np.isfinite(track.cam_from_body).all(axis=(1, 2)).any())
    shown = {"time-offset": True, "boresight": mounted, "lever-arm": turned and bool(track.body_known)}
    return tuple(name for name in RIG_PARAMETERS if shown[name])


class RigEstimate(Product):
    """Parameter of the rig, estimated from the SfM cameras, by component.

    Sign and unit are those of the option of `ingest` with the same name, whose value was the `start`.

    Attributes:
        value, sigma: of the time offset one number, else three.
        observable: whether the flight shows the component.
    """

    name: RigParameter
    unit: Literal["s", "deg", "m"]
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    start: tuple[float, ...]
    observable: tuple[bool, ...]

    @model_validator(mode="after")
    def _has_all_components(self) -> RigEstimate:
        lengths = {len(self.value), len(self.sigma), len(self.start), len(self.observable)}
        if lengths != {_COMPONENTS[self.name]}:
            raise ValueError(
                f"{self.name} has {_COMPONENTS[self.name]} components: value, sigma, start, observable"
            )
        return self


class FixLag(Product):
    """Time by which the positions of photographs lag the exposure, from the motion of the SfM cameras.

    Attributes:
        lag_s: a position is that of so many seconds before the exposure; negative: after it.
        applied: whether positions are moved to the exposure when the survey is read.
        sigma_along_s: σ that positions get along the motion, times the velocity.
        scatter_m: robust σ of the fixes about the SfM model along a horizontal axis, without and with the lag.
        velocity_in_geo: of the photographs that took part, in m/s.
    """

    lag_s: float
    sigma_s: float = Field(ge=0)
    applied: bool
    sigma_along_s: float = Field(ge=0)
    scatter_m: tuple[float, float]
    velocity_in_geo: dict[ImageName, Vector3]

    @property
    def sentence(self) -> str:
        """The lag and its use, for people."""
        found = f"{abs(self.lag_s):.2f} ± {self.sigma_s:.2f} s"
        if self.applied:
            side = "before" if self.lag_s > 0 else "after"
            return (
                f"The positions are those of {found} {side} the exposures, by the motion of the SfM cameras: a "
                f"{'lag' if self.lag_s > 0 else 'lead'} of the receiver, or of clocks. They are moved to the "
                f"exposures, which leaves {self.scatter_m[1]:.2f} m of {self.scatter_m[0]:.2f} m along an axis."
            )
        if self.sigma_along_s:
            return (
                "The flight does not show whether the positions lag the exposures, as it has no lines in two "
                f"directions or too few photographs, or scatters about the SfM model: a lag of "
                f"± {self.sigma_along_s:.2f} s is part of their σ "
                "along the motion."
            )
        return f"The positions are those of the exposures: lag {self.lag_s:+.2f} ± {self.sigma_s:.2f} s."


class RigCalibration(Product):
    """Product of `calibrate`: estimates of the rig, divided into those that `load_survey` applies and the others.

    Attributes:
        wanted: any of `time-offset`, `boresight`, `lever-arm`.
        images, control_points: how many took part.
        rms_position_m, rms_attitude_deg: robust σ of the residuals along an axis.
        problem, remedy: why nothing could be estimated, and what to type against it, else empty.
        fix_lag: of positions by photograph.
    """

    format_version: Literal[1] = 1
    wanted: tuple[RigParameter, ...] = ()
    applied: tuple[RigEstimate, ...] = ()
    not_applied: tuple[RigEstimate, ...] = ()
    images: int = 0
    control_points: int = 0
    rms_position_m: float | None = None
    rms_attitude_deg: float | None = None
    problem: str = ""
    remedy: str = ""
    fix_lag: FixLag | None = None

    @model_validator(mode="after")
    def _names_each_once(self) -> RigCalibration:
        names = [estimate.name for estimate in (*self.applied, *self.not_applied)]
        if len(set(names)) != len(names):
            raise ValueError("a parameter is estimated twice")
        return self

    @property
    def estimates(self) -> tuple[RigEstimate, ...]:
        """All estimates, in the usual order of the parameters."""
        by_name = {estimate.name: estimate for estimate in (*self.applied, *self.not_applied)}
        return tuple(by_name[name] for name in in_usual_order(by_name))


def load_survey(workspace: Workspace) -> Survey:
    """Return the survey of a workspace, with the calibration of the rig in its positions and attitudes.

    It has the points in common with an earlier date, if `sfm` has found any.

    Raises:
        MissingProductError: the survey does not exist.
        InputError: a product is damaged, or the calibration has no navigation to be applied to.
    """
    survey = load_json(Survey, workspace.path(SURVEY))
    if workspace.has(COMMON_POINTS):
        survey = survey.model_copy(update={"common": CommonPoints.load(workspace.path(COMMON_POINTS))})
    try:
        calibration = load_json(RigCalibration, workspace.path(RIG))
    except MissingProductError:
        if survey.estimate:
            log.warning(
                "Not estimated yet: %s. Run `georef calibrate`, or `georef run`.",
                ", ".join(survey.estimate),
            )
        return survey
    if calibration.applied:
        survey = apply_calibration(survey, load_track(workspace), calibration)
    return survey if calibration.fix_lag is None else at_exposures(survey, calibration.fix_lag)


def at_exposures(survey: Survey, lag: FixLag) -> Survey:
    """Return the survey with positions moved to the exposures, or with the σ of an open lag along the motion."""
    if not lag.applied and not lag.sigma_along_s:
        return survey
    images = []
    for image in survey.images:
        moving = lag.velocity_in_geo.get(image.name)
        if moving is None or image.fix is None:
            images.append(image)
            continue
        velocity = np.array(moving)
        position = np.array(image.fix.position_in_geo) + (lag.lag_s if lag.applied else 0.0) * velocity
        along = lag.sigma_along_s * velocity
        fix = _without_common(image.fix) if lag.applied else image.fix
        cov = np.array(fix.cov_in_geo) + along[:, None] * along[None, :]
        update = {"position_in_geo": vector3(position), "cov_in_geo": _matrix(cov)}
        images.append(image.model_copy(update={"fix": fix.model_copy(update=update)}))
    code = FIX_LAG if lag.applied else FIX_LAG_OPEN
    cautions = union(survey.cautions, (Remark(code=code, sentence=lag.sentence),))
    return survey.model_copy(update={"images": tuple(images), "cautions": cautions})


def _without_common(fix: Fix) -> Fix:
    """Return a fix without the σ of a time that is known now."""
    common = np.array(fix.common_along_m)
    cov = np.array(fix.cov_in_geo) - common[:, None] * common[None, :]
    return fix.model_copy(update={"cov_in_geo": _matrix(cov), "common_along_m": (0.0, 0.0, 0.0)})


def _matrix(values: FloatArray) -> Matrix3:
    return (vector3(values[0]), vector3(values[1]), vector3(values[2]))


def apply_calibration(survey: Survey, track: NavigationTrack, calibration: RigCalibration) -> Survey:
    """Return the survey with the applied estimates of a calibration in its positions and attitudes.

    The other parameters of the rig keep the values of `ingest`. With a new time offset, the navigation may cover
    further images. Their fixes and attitudes take σ from the image nearest in time.
    """
    values = {estimate.name: np.array(estimate.value) for estimate in calibration.applied}
    starts = {estimate.name: np.array(estimate.start) for estimate in calibration.applied}
    offset_s = float(values["time-offset"][0]) if "time-offset" in values else float(track.time_offset_s)
    rig = Rig(track.cam_from_body, track.antenna_in_body, track.nominal_from_cam)
    if "boresight" in values:
        rig = replace(rig, nominal_from_cam=exp_so3(np.radians(values["boresight"])))
    if "lever-arm" in values:
        arm = np.nan_to_num(track.antenna_in_body) + (values["lever-arm"] - starts["lever-arm"])
        rig = replace(rig, antenna_in_body=arm)
    time_s = track.image_time_s + offset_s
    center, geo_from_cam = with_rig(track.positions.at(time_s).position, _bodies(survey, track, time_s), rig)
    center[_far_from_others(center)] = np.nan
    if "time-offset" in values:
        kept = [None if image.fix is None else _without_common(image.fix) for image in survey.images]
        pairs = zip(survey.images, kept, strict=True)
        survey = survey.model_copy(
            update={"images": tuple(image.model_copy(update={"fix": fix}) for image, fix in pairs)}
        )
    return survey.model_copy(update={"images": _images(survey, track, center, geo_from_cam)})


def _bodies(survey: Survey, track: NavigationTrack, time_s: FloatArray) -> FloatArray:
    """Return attitudes geo ← body (n, 3, 3) of the track's images, NaN where unknown."""
    if len(track.attitude_time_s) > 1:
        return track.attitudes.at(time_s).rotation
    # The attitudes were recorded with the photographs: mount and boresight of `ingest` give those of the body.
    recorded = {image.name: image.attitude.quat_xyzw for image in survey.images if image.attitude}
    unknown = (np.nan,) * 4
    quat = np.array([recorded.get(name, unknown) for name in track.image.tolist()]).reshape(-1, 4)
    geo_from_cam = np.full((len(quat), 3, 3), np.nan)
    known = np.isfinite(quat).all(axis=1)
    geo_from_cam[known] = matrix_from_quat_xyzw(quat[known])
    return geo_from_cam @ track.nominal_from_cam.T @ track.cam_from_body


def _far_from_others(center: FloatArray) -> BoolArray:
    """Return the mask (n,) of the positions (n, 3) that are blunders; NaN is none."""
    if np.isnan(center).all():
        return np.zeros(len(center), dtype=bool)
    distance_m = np.linalg.norm(center - np.nanmedian(center, axis=0), axis=1)
    return np.asarray(distance_m > FIX_RANGE_M)


def _images(
    survey: Survey, track: NavigationTrack, center: FloatArray, geo_from_cam: FloatArray
) -> tuple[SurveyImage, ...]:
    by_name = {image.name: image for image in survey.images}
    recorded = [by_name.get(name) for name in track.image.tolist()]
    fixes = _filled([None if image is None else image.fix for image in recorded], track.image_time_s)
    attitudes = _filled([None if image is None else image.attitude for image in recorded], track.image_time_s)
    row_of = {name: row for row, name in enumerate(track.image.tolist())}
    images = []
    for image in survey.images:
        row = row_of.get(image.name)
        if row is None:
            images.append(image)
            continue
        update: dict[str, Fix | Attitude | None] = {"fix": _fix(fixes[row], center[row])}
        if len(track.attitude_time_s) > 1:
            update["attitude"] = _attitude(attitudes[row], geo_from_cam[row])
        images.append(image.model_copy(update=update))
    return tuple(images)


def _filled(values: list[ValueT | None], time_s: FloatArray) -> list[ValueT | None]:
    known = np.array([row for row, value in enumerate(values) if value is not None], dtype=np.int64)
    if not len(known):
        return values
    return [
        values[known[np.abs(time_s[known] - time_s[row]).argmin()]] if value is None else value
        for row, value in enumerate(values)
    ]


def _fix(like: Fix | None, center: FloatArray) -> Fix | None:
    if like is None or not np.isfinite(center).all():
        return None
    return like.model_copy(update={"position_in_geo": vector3(center)})


def _attitude(like: Attitude | None, geo_from_cam: FloatArray) -> Attitude | None:
    if like is None or not np.isfinite(geo_from_cam).all():
        return None
    x, y, z, w = (float(value) for value in quat_xyzw_from_matrix(geo_from_cam))
    return like.model_copy(update={"quat_xyzw": (x, y, z, w)})
