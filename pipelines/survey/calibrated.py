"""Survey with its calibrated rig: positions and attitudes computed anew from the navigation.

Navigation as recorded, with the times and the rig of the photographs.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.files import read_npz
from pipelines.core.products import load_json, save_npz
from pipelines.core.stages import RIG, SURVEY, TRACK
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.trajectory import Rig, Trajectory, boresight, with_rig
from pipelines.survey.survey import Attitude, Fix, RigCalibration, RigParameter, Survey, SurveyImage

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NavigationTrack:
    """Second product of `ingest`: the navigation as recorded, with the times and the rig of n photographs.

    `calibrate` fits the SfM cameras to this navigation. Positions are those of the antenna, attitudes those of the
    body (forward-right-down), both on the navigation's clock, without any correction by the rig. The rig is the one
    given to `ingest`.

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
        body_known: () bool; if false, the body's axes are set to the camera's nominal axes.
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
    body_known: BoolArray

    @property
    def positions(self) -> Trajectory:
        """Trajectory of the antenna in geo, on the navigation's clock."""
        return Trajectory.from_samples(
            self.position_time_s,
            position=self.antenna_in_geo,
            sigma_m=self.sigma_m,
            max_gap_s=float(self.max_gap_s),
        )

    @property
    def attitudes(self) -> Trajectory:
        """Rotations of the body in geo, on the navigation's clock."""
        return Trajectory.from_samples(
            self.attitude_time_s, rotation=self.geo_from_body, max_gap_s=float(self.max_gap_s)
        )

    @property
    def rig(self) -> Rig:
        """Rig of the n images, as given to `ingest`."""
        return Rig(self.cam_from_body, self.antenna_in_body, self.nominal_from_cam)

    def save(self, path: Path) -> None:
        """Write the navigation as NPZ."""
        save_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> NavigationTrack:
        """Read the navigation from NPZ.

        Raises:
            InputError: the file is no NPZ file with these arrays, or an array has another form.
        """
        arrays = read_npz(path, tuple(field.name for field in fields(cls)))
        lengths: dict[str, int] = {}
        for name, (kind, *shape) in _TRACK_ARRAYS.items():
            array = arrays[name]
            matches = array.dtype.kind in kind and array.ndim == len(shape)
            for length, wanted in zip(array.shape, shape, strict=False):
                expected = lengths.setdefault(wanted, length) if isinstance(wanted, str) else wanted
                matches = matches and length == expected
            if not matches:
                raise InputError(f"has the form {array.shape} {array.dtype}", path=path, field=name)
        return cls(**arrays)


# Kind of number, and shape, in which a letter stands for a length that several arrays share.
_TRACK_ARRAYS: dict[str, tuple[Any, ...]] = {
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


def load_track(workspace: Workspace) -> NavigationTrack:
    """Return the navigation of a workspace's survey.

    Raises:
        InputError: the navigation was not recorded by time, or the file is damaged.
    """
    try:
        path = workspace.path(TRACK)
    except MissingProductError as error:
        raise InputError(
            "the survey has no navigation recorded by time, only a position for each image: ingest a --bag, or a "
            "--trajectory by time",
            path=workspace.root / TRACK,
        ) from error
    return NavigationTrack.load(path)


def require_estimable(track: NavigationTrack | None, wanted: Sequence[RigParameter], field: str) -> None:
    """Refuse parameters of the rig that the navigation cannot determine.

    Args:
        track: the navigation; None: not recorded by time.
        wanted: parameters to be estimated.
        field: option that names them.

    Raises:
        InputError: the navigation was not recorded by time; or attitudes, the body's axes or the mount are needed
            and unknown.
    """
    if track is None or len(track.position_time_s) < 2:
        raise InputError(
            "needs the navigation recorded by time: a --bag, or a --trajectory without a column of images",
            field=field,
        )
    turned = len(track.attitude_time_s) > 1
    if "lever-arm" in wanted and not turned:
        raise InputError("lever-arm needs attitudes, which were not recorded", field=field)
    if "lever-arm" in wanted and not track.body_known:
        raise InputError("lever-arm needs the body's axes: give --camera-mount YAW,PITCH,ROLL", field=field)
    mounted = bool(np.isfinite(track.cam_from_body).all(axis=(1, 2)).any())
    if "boresight" in wanted and not (turned and mounted):
        raise InputError(
            "boresight needs recorded attitudes and the camera's mount (/tf or --camera-mount)", field=field
        )


# A position farther than this from the median of all is a blunder.
FIX_RANGE_M = 100_000.0
ValueT = TypeVar("ValueT")


def load_survey(workspace: Workspace) -> Survey:
    """Return the survey of a workspace, with the calibration of the rig in its positions and attitudes.

    Raises:
        MissingProductError: the survey does not exist.
        InputError: a product is damaged, or the calibration has no navigation to be applied to.
    """
    survey = load_json(Survey, workspace.path(SURVEY))
    try:
        calibration = load_json(RigCalibration, workspace.path(RIG))
    except MissingProductError:
        if survey.estimate:
            log.warning(
                "%s were to be estimated after sfm: `georef calibrate` or `georef run` does it",
                ", ".join(survey.estimate),
            )
        return survey
    return apply_calibration(survey, load_track(workspace), calibration) if calibration.applied else survey


def apply_calibration(survey: Survey, track: NavigationTrack, calibration: RigCalibration) -> Survey:
    """Return the survey with the applied estimates of a calibration in its positions and attitudes.

    The other parameters of the rig keep the values of `ingest`. A new time offset can bring further images into the
    span of the navigation. Their fixes and attitudes take σ from the image nearest in time.

    Args:
        survey: as recorded.
        track: its navigation.
        calibration: estimates of the rig; only `applied` counts.
    """
    values = {estimate.name: np.array(estimate.value) for estimate in calibration.applied}
    starts = {estimate.name: np.array(estimate.start) for estimate in calibration.applied}
    offset_s = float(values["time-offset"][0]) if "time-offset" in values else float(track.time_offset_s)
    rig = track.rig
    if "boresight" in values:
        rig = replace(rig, nominal_from_cam=boresight(values["boresight"]))
    if "lever-arm" in values:
        arm = np.nan_to_num(track.antenna_in_body) + (values["lever-arm"] - starts["lever-arm"])
        rig = replace(rig, antenna_in_body=arm)
    time_s = track.image_time_s + offset_s
    center, geo_from_cam = with_rig(track.positions.at(time_s).position, _bodies(survey, track, time_s), rig)
    center[_far_from_others(center)] = np.nan
    return survey.model_copy(update={"images": _images(survey, track, center, geo_from_cam)})


def _bodies(survey: Survey, track: NavigationTrack, time_s: FloatArray) -> FloatArray:
    """Return attitudes geo ← body (n, 3, 3) of the track's images at times (n,), NaN where unknown."""
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
    """Return the values; None is replaced by the value nearest in time, if there is any."""
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
    x, y, z = (float(value) for value in center)
    return like.model_copy(update={"position_in_geo": (x, y, z)})


def _attitude(like: Attitude | None, geo_from_cam: FloatArray) -> Attitude | None:
    if like is None or not np.isfinite(geo_from_cam).all():
        return None
    x, y, z, w = (float(value) for value in quat_xyzw_from_matrix(geo_from_cam))
    return like.model_copy(update={"quat_xyzw": (x, y, z, w)})
