"""What is known of the rig after sfm, put into a survey: positions and attitudes anew from the navigation."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rig import boresight, with_rig
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.scene.navigation import NavigationTrack
from pipelines.scene.rig import RigCalibration
from pipelines.scene.survey import Attitude, Fix, Survey, SurveyImage

# A position this far from the middle of all is a blunder.
FIX_RANGE_M = 100_000.0
ValueT = TypeVar("ValueT")


def apply_calibration(survey: Survey, track: NavigationTrack, calibration: RigCalibration) -> Survey:
    """Return the survey with everything usable of a calibration in its positions and attitudes.

    The rest of the rig stays as `ingest` was told. An image that only now lies within the navigation takes σ from
    the nearest one in time.
    """
    values = {estimate.name: np.array(estimate.value) for estimate in calibration.estimates if estimate.usable}
    starts = {estimate.name: np.array(estimate.start) for estimate in calibration.estimates}
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
    return survey.model_copy(update={"rig": calibration, "images": _images(survey, track, center, geo_from_cam)})


def _bodies(survey: Survey, track: NavigationTrack, time_s: FloatArray) -> FloatArray:
    """Return attitudes geo ← body (n, 3, 3) of the track's images at times (n,), NaN where unknown."""
    if len(track.attitude_time_s) > 1:
        return track.attitudes.at(time_s).rotation
    # Attitudes that came with the photographs, whose boresight nothing has changed.
    recorded = {image.name: image.attitude.quat_xyzw for image in survey.images if image.attitude}
    unknown = (np.nan,) * 4
    quat = np.array([recorded.get(name, unknown) for name in track.image.tolist()]).reshape(-1, 4)
    geo_from_cam = np.full((len(quat), 3, 3), np.nan)
    known = np.isfinite(quat).all(axis=1)
    geo_from_cam[known] = matrix_from_quat_xyzw(quat[known])
    return geo_from_cam @ track.nominal_from_cam.T @ track.cam_from_body


def _far_from_others(center: FloatArray) -> BoolArray:
    """Return which of the places (n, 3) are blunders; NaN is none."""
    if np.isnan(center).all():
        return np.zeros(len(center), dtype=bool)
    distance_m = np.linalg.norm(center - np.nanmedian(center, axis=0), axis=1)
    return np.asarray(distance_m > FIX_RANGE_M)


def _images(
    survey: Survey, track: NavigationTrack, places: FloatArray, turned: FloatArray
) -> tuple[SurveyImage, ...]:
    own = {image.name: image for image in survey.images}
    images = [own.get(name) for name in track.image.tolist()]
    fixes = _filled([None if image is None else image.fix for image in images], track.image_time_s)
    attitudes = _filled([None if image is None else image.attitude for image in images], track.image_time_s)
    row_of = {name: row for row, name in enumerate(track.image.tolist())}
    found = []
    for image in survey.images:
        row = row_of.get(image.name)
        if row is None:
            found.append(image)
            continue
        update: dict[str, Fix | Attitude | None] = {"fix": _fix(fixes[row], places[row])}
        if len(track.attitude_time_s) > 1:
            update["attitude"] = _attitude(attitudes[row], turned[row])
        found.append(image.model_copy(update=update))
    return tuple(found)


def _filled(values: list[ValueT | None], time_s: FloatArray) -> list[ValueT | None]:
    """The values, with that of the nearest in time where there is none."""
    known = np.array([row for row, value in enumerate(values) if value is not None], dtype=np.int64)
    if not len(known):
        return values
    return [
        values[known[np.abs(time_s[known] - time_s[row]).argmin()]] if value is None else value
        for row, value in enumerate(values)
    ]


def _fix(like: Fix | None, place: FloatArray) -> Fix | None:
    if like is None or not np.isfinite(place).all():
        return None
    x, y, z = (float(value) for value in place)
    return like.model_copy(update={"position_in_geo": (x, y, z)})


def _attitude(like: Attitude | None, turned: FloatArray) -> Attitude | None:
    if like is None or not np.isfinite(turned).all():
        return None
    x, y, z, w = (float(value) for value in quat_xyzw_from_matrix(turned))
    return like.model_copy(update={"quat_xyzw": (x, y, z, w)})
