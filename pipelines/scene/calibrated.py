"""What is known of the rig after sfm, put into a survey: positions and attitudes anew from the navigation."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.rig import boresight
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.trajectory import covered, places_at, turns_at
from pipelines.scene.navigation import NavigationTrack
from pipelines.scene.rig import RigCalibration
from pipelines.scene.survey import Attitude, Fix, Survey, SurveyImage

# A position this far from the middle of all is a blunder, as `ingest` has it.
_RANGE_M = 100_000.0
ValueT = TypeVar("ValueT")


def with_rig(survey: Survey, track: NavigationTrack, rig: RigCalibration) -> Survey:
    """The survey with everything usable of `rig` in its positions and attitudes, the rest as `ingest` was told.

    An image that only now lies within the navigation takes σ from the nearest one in time.
    """
    found = {one.name: np.array(one.value) for one in rig.estimates if one.usable}
    start = {one.name: np.array(one.start) for one in rig.estimates}
    offset_s = float(found["time-offset"][0]) if "time-offset" in found else float(track.time_offset_s)
    nominal_from_cam = boresight(found["boresight"]) if "boresight" in found else track.nominal_from_cam
    arm = track.antenna_in_body
    if "lever-arm" in found:
        arm = np.nan_to_num(arm) + (found["lever-arm"] - start["lever-arm"])
    bodies = _bodies(survey, track, offset_s)
    places = _cameras(track, offset_s, bodies, np.nan_to_num(arm))
    turned = bodies @ np.swapaxes(track.cam_from_body, 1, 2) @ nominal_from_cam
    return survey.model_copy(update={"rig": rig, "images": _images(survey, track, places, turned)})


def _bodies(survey: Survey, track: NavigationTrack, offset_s: float) -> FloatArray:
    """Attitudes geo ← body (n, 3, 3) at the track's images, NaN where unknown."""
    count = len(track.image)
    if len(track.attitude_time_s) > 1:
        bodies = np.full((count, 3, 3), np.nan)
        at = track.image_time_s + offset_s
        known = covered(track.attitude_time_s, at, float(track.max_gap_s))
        bodies[known] = turns_at(track.attitude_time_s, track.geo_from_body, at[known])
        return bodies
    # Attitudes that came with the photographs, whose boresight nothing has changed.
    recorded = {image.name: image.attitude.quat_xyzw for image in survey.images if image.attitude}
    unknown = (np.nan,) * 4
    quat = np.array([recorded.get(name, unknown) for name in track.image.tolist()]).reshape(-1, 4)
    cameras = np.full((count, 3, 3), np.nan)
    known = np.isfinite(quat).all(axis=1)
    cameras[known] = matrix_from_quat_xyzw(quat[known])
    return cameras @ track.nominal_from_cam.T @ track.cam_from_body


def _cameras(track: NavigationTrack, offset_s: float, bodies: FloatArray, arm: FloatArray) -> FloatArray:
    """Camera centres (n, 3) in geo, NaN where unknown: without attitude no lever arm can be applied."""
    at = track.image_time_s + offset_s
    places = np.full((len(at), 3), np.nan)
    known = covered(track.position_time_s, at, float(track.max_gap_s))
    places[known] = places_at(track.position_time_s, track.antenna_in_geo, at[known])
    moved = arm.any(axis=1)
    places[moved] -= np.einsum("nij,nj->ni", bodies[moved], arm[moved])
    middle = np.nanmedian(places, axis=0) if known.any() else np.zeros(3)
    places[np.linalg.norm(np.nan_to_num(places - middle), axis=1) > _RANGE_M] = np.nan
    return places


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
