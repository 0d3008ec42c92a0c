"""Tie points of a rolling shutter, moved to where a global shutter would have shown them.

Positions and times give the velocity of each camera (`ingest`), the model gives depths: each adjustment improves
both. Marks and photographs are corrected later, by the motion that lies beside the model.
"""

import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from pipelines.core.types import FloatArray, IntArray, vector3
from pipelines.formats.colmap import RollingShutter, flatten
from pipelines.geometry.cameras import Reconstruction
from pipelines.geometry.rolling_shutter import in_global_shutter
from pipelines.geometry.sparse_model import SparseModel
from pipelines.sfm.adjustment import alignment_with
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

_WORSE = 1.01  # ratio of reprojection errors; a lens absorbs the motion of parallel lines, at the same error
_ROUNDS = 2  # the second moves tie points by hundredths of a pixel
_LEAST_PX = 0.05  # largest motion of a row in the image that is worth a correction


def correct_tie_points(
    model: Reconstruction, survey: Survey, adjust: Callable[[Reconstruction], None]
) -> tuple[Any, RollingShutter | None]:
    """Return a `pycolmap.Reconstruction` with corrected observations, adjusted, and the motion of its cameras.

    None, and the model as it is: no camera has a rolling shutter and a known velocity, none moved by as much as a
    twentieth of a pixel, or the corrected observations fit worse. Then readout time or velocities are wrong, such
    as those of an aircraft that stops for each photograph.
    """
    flat = flatten(model)
    travel = _travel_in_cam(flat, survey)
    if travel is None or _largest_px(flat, travel) < _LEAST_PX:
        return model, None
    corrected = type(model)(model)
    seen = _observed(corrected)
    for _ in range(_ROUNDS):
        for place, (image_id, (rows, xy_px)) in enumerate(seen.items()):
            image = corrected.images[image_id]
            points = np.array([corrected.points3D[image.points2D[row].point3D_id].xyz for row in rows.tolist()])
            points = points.reshape(-1, 3)  # a photograph may have lost all of them
            depth = points @ flat.rotation_cam_from_local[place, 2] + flat.translation_cam_from_local[place, 2]
            moved = in_global_shutter(flat.camera_of(place), xy_px, depth, travel[place])
            for row, xy in zip(rows.tolist(), np.where(np.isfinite(moved), moved, xy_px), strict=True):
                image.points2D[row].xy = xy
        adjust(corrected)
        flat = flatten(corrected)
        travel = _travel_in_cam(flat, survey)
        assert travel is not None
    before_px, after_px = (each.compute_mean_reprojection_error() for each in (model, corrected))
    if after_px > _WORSE * before_px:
        log.warning(
            "The rolling shutter is not corrected: tie points would fit worse (%.3f px, %.3f px without). "
            "Check --rolling-shutter and the times of the photographs.",
            after_px, before_px, extra={"code": "rolling-shutter-refused"},
        )  # fmt: skip
        return model, None
    motion = zip(flat.image_name, travel, strict=True)
    return corrected, RollingShutter(travel_in_cam={name: vector3(along) for name, along in motion})


def _observed(model: Reconstruction) -> dict[int, tuple[IntArray, FloatArray]]:
    """Return places and pixels of the points that each registered image observes, in the order of `flatten`."""
    seen = {}
    for image_id in sorted(model.reg_image_ids()):
        points = model.images[image_id].points2D
        rows = [row for row, point in enumerate(points) if point.has_point3D()]
        xy_px = np.array([points[row].xy for row in rows]).reshape(-1, 2)
        seen[image_id] = (np.array(rows, dtype=np.int64), xy_px)
    return seen


def _travel_in_cam(flat: SparseModel, survey: Survey) -> FloatArray | None:
    """Return the motion (n, 3) of the cameras during the readout, in units of the model; None: nothing is known."""
    readout_s = {camera.camera_id: camera.readout_s for camera in survey.cameras}
    images = {image.name: image for image in survey.images}
    here = [images[name] for name in flat.image_name]
    moving = [image.velocity_in_geo is not None and readout_s[image.camera_id] > 0 for image in here]
    fixed = [place for place, image in enumerate(here) if image.fix is not None]
    if not any(moving) or len(fixed) < 3:
        return None
    positions = np.array([image.fix.position_in_geo for image in here if image.fix is not None])
    geo_from_local = alignment_with(flat.cam_center_in_local[fixed], positions)[0]
    travel_in_geo = np.array([
        readout_s[image.camera_id] * np.array(image.velocity_in_geo or (0.0, 0.0, 0.0)) for image in here
    ])  # fmt: skip
    travel_in_local = travel_in_geo @ geo_from_local.rotation / geo_from_local.scale
    return np.asarray(np.einsum("nij,nj->ni", flat.rotation_cam_from_local, travel_in_local))


def _largest_px(flat: SparseModel, travel: FloatArray) -> float:
    in_cam = np.einsum(
        "mj,mj->m", flat.rotation_cam_from_local[flat.obs_image, 2], flat.point_in_local[flat.obs_point]
    )
    depth = np.median(in_cam + flat.translation_cam_from_local[flat.obs_image, 2])
    return float((flat.focal_px * np.linalg.norm(travel, axis=1)).max() / depth)
