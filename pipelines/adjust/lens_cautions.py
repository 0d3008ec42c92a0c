"""Cautions of the lens that SfM has found: its focal length against the tags, and rows that move with the flight.

A focal length far from that of the photographs' tags belongs to a model that is bent, or to tags of another size;
one that differs by a third is a question to what checks the survey.

The bundle estimates the motion of the rows of each photograph (`geometry.row_motion`). A camera of velocity v along
the axes of a photograph, whose rows are read within T seconds, shifts the last row by −F v T / (2 d) at depth d.
One T for all photographs explains the motions of a rolling shutter; those of a lens beyond its model, it does not.
"""

from __future__ import annotations

import numpy as np

from pipelines.adjust.fix_patterns import CameraPath
from pipelines.core.products import NOT_CHECKED, Remark
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera
from pipelines.geometry.row_motion import RowMotion
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.survey import FOCAL_APART, FOCAL_DIFFERS, CameraPrior, Survey

_LEAST_IMAGES = 8
_EXPLAINED = 0.6  # part of the motion's information that one readout time explains
_STRAIGHT = np.cos(np.radians(30.0))  # of the way to a photograph with that from it
_LEAST_PX = 0.1  # typical motion of the last row that is worth a caution


def focal_length_of(survey: Survey, model: SparseModel) -> tuple[Remark, ...]:
    """Return the cautions that a camera's focal length differs from the one that tags, or the user, state.

    Up to `FOCAL_APART`, either may be wrong, and what checks the survey decides. Beyond, no accuracy is stated.
    """
    prior_of = {camera.camera_id: camera for camera in survey.cameras}
    camera_of = {image.name: image.camera_id for image in survey.images}
    changed = {}
    for image, name in enumerate(model.image_name):
        prior, solved = prior_of[camera_of[name]], model.camera_of(image)
        if prior.focal_factor(solved) > FOCAL_DIFFERS:
            changed[prior.make_model.strip() or f"camera {prior.camera_id}"] = prior, solved
    cautions = tuple(_apart(camera, prior, solved) for camera, (prior, solved) in changed.items())
    unchecked = Remark(
        code=NOT_CHECKED, sentence="No accuracy is stated: σ describe errors of a model, not a model that is bent."
    )
    return (*cautions, unchecked) if any(one.code == _NO_LENS for one in cautions) else cautions


_NO_LENS = "focal-length-apart"


def _apart(camera: str, prior: CameraPrior, solved: Camera) -> Remark:
    """Return the caution of one camera whose focal length is not the stated one."""
    stated, share = prior.camera.mean_focal_px, solved.mean_focal_px / prior.camera.mean_focal_px - 1
    by = "its tags state" if prior.focal_source == "exif" else "the input states"
    sentence = (
        f"SfM gives {camera} a focal length of {solved.mean_focal_px:.0f} px, where {by} {stated:.0f} px "
        f"({100 * share:+.0f} %). "
    )
    if prior.focal_factor(solved) > FOCAL_APART:
        return Remark(
            code=_NO_LENS,
            sentence=sentence + "No lens is so far off: the SfM model is bent, most likely because too few "
            "photographs overlap, or the tags belong to another size.",
            remedy="Leave out photographs that connect to few others, add photographs, or state the focal length "
            "with --focal-px.",
        )
    return Remark(
        code="focal-length-differs",
        sentence=sentence + "Tags are rounded, or of a crop, and then the solved one is right; or the photographs "
        "do not determine it, and then the ground may be wrong by as large a share of the flying height. Control "
        "or check points tell which.",
        remedy="--focal-px states a focal length that is known.",
    )


def rolling_shutter_of(
    survey: Survey, model: SparseModel, scale: float, motion: RowMotion | None
) -> tuple[Remark, ...]:
    """Return the caution that a rolling shutter bends an SfM model, a unit of which is `scale` metres.

    Without times, photographs are taken as equally far apart in time, in the order of their names.
    """
    if motion is None or len(model.image_name) < _LEAST_IMAGES:
        return ()
    time_of = {image.name: image.timestamp_s for image in survey.images}
    seconds = [time_of[name] for name in model.image_name]
    timed = all(second is not None for second in seconds)
    clock = np.array(seconds, dtype=np.float64) if timed else np.argsort(np.argsort(model.image_name)).astype(float)
    shift = _shift_of_last_row(model, clock)
    known = np.repeat(np.isfinite(shift).all(axis=1), 2)
    if known.sum() < 2 * _LEAST_IMAGES:
        return ()
    unit, predicted = shift.ravel()[known], motion.motion_px.ravel()[known]
    information = motion.information[np.ix_(known, known)]
    own, cross, size = (
        unit @ information @ unit,
        unit @ information @ predicted,
        predicted @ information @ predicted,
    )
    if cross <= 0 or cross**2 < _EXPLAINED * own * size:
        return ()
    readout = float(cross / own)
    last_row_px = float(np.sqrt(((readout * shift[np.isfinite(shift).all(axis=1)]) ** 2).sum(axis=1).mean()))
    if last_row_px < _LEAST_PX:
        return ()
    stated_s = max(camera.readout_s for camera in survey.cameras)
    beyond = f" beyond the {1000 * stated_s:.0f} ms that are assumed or stated" if stated_s else ""
    if timed:
        told_as = f"as of rows that are read one after another, in about {1000 * readout:.0f} ms{beyond}"
        remedy = f"State the readout time of the camera with --rolling-shutter ({stated_s + readout:.3f})."
    else:
        path_m = readout * scale * float(np.nanmedian(np.linalg.norm(_velocity(model, clock), axis=1)))
        told_as = f"as of rows that are read one after another while it flies about {path_m:.2f} m{beyond}"
        remedy = "State the readout time of the camera with --rolling-shutter, and times of the photographs."
    caution = Remark(
        code="rolling-shutter-unstated",
        sentence=f"The last row of a photograph moves by {last_row_px:.1f} px along the flight, {told_as}. "
        f"That bends the SfM model. The predicted σ contain what the photographs tell of it, not all.",
        remedy=remedy,
    )
    return (caution,)


def _velocity(model: SparseModel, clock: FloatArray) -> FloatArray:
    """Return the velocity (n, 3) of the cameras in local by the clock (n,), NaN where the flight turns."""
    order = np.argsort(clock, kind="stable")
    center = model.cam_center_in_local[order]
    path, step = CameraPath(clock[order], center), np.diff(center, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
    straight = np.zeros(len(clock), dtype=bool)
    straight[1:-1] = (step[1:] * step[:-1]).sum(axis=1) > _STRAIGHT * length[1:] * length[:-1]
    velocity = np.full((len(clock), 3), np.nan)
    known = path.known & straight
    velocity[order[known]] = path.moved(0.0)[1][known]
    return velocity


def _shift_of_last_row(model: SparseModel, clock: FloatArray) -> FloatArray:
    """Return the shift (n, 2) in pixels of the last row of each photograph, by a readout of one unit of time."""
    in_cam = np.einsum("nij,nj->ni", model.rotation_cam_from_local, _velocity(model, clock))
    depth = np.einsum(
        "mj,mj->m", model.rotation_cam_from_local[model.obs_image, 2], model.point_in_local[model.obs_point]
    )
    depth += model.translation_cam_from_local[model.obs_image, 2]
    typical = np.array([
        np.median(depth[model.obs_image == image]) if (model.obs_image == image).any() else np.nan
        for image in range(len(clock))
    ])  # fmt: skip
    return np.asarray(-(model.focal_px / (2.0 * typical))[:, None] * in_cam[:, :2])
