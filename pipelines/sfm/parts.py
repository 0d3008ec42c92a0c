"""Models of one survey that share no photographs, placed beside each other on Earth by their positions.

Groups of photographs that do not overlap end in models of their own, each in a frame of its own. Where fixes, or
fixes and attitudes, place two of them, they become one model: the adjustment with the fixes then solves both, and
their place relative to each other is as accurate as the fixes.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import ColmapImage, Reconstruction
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity
from pipelines.sfm.adjustment import alignment_with
from pipelines.survey.survey import Survey, SurveyImage

_FEWEST_FIXES = 3  # with attitudes; positions alone need one more, which checks the others
_LEAST_WIDTH = 0.1  # of the longest extent: narrower positions leave the rotation about a line to the attitudes
_MOST_SIGMA = 5.0  # times a fix's stated σ: positions that fit worse do not place a model
_LEAST_EXTENT = 4.0  # times that σ: the scale of a shorter model is noise
_ATTITUDES_AGREE_DEG = 25.0  # median angle of attitudes and cameras


@dataclass(frozen=True)
class ModelPart:
    """A smaller model: its photographs that no larger one has, and the reason if it stays apart."""

    photographs: int
    apart: str  # empty: it was joined


def join_parts(
    colmap: ModuleType, models: list[Reconstruction], survey: Survey
) -> tuple[Any, tuple[ModelPart, ...]]:
    """Return the largest of some `pycolmap.Reconstruction`s, to which the others were added, and what these are.

    The models are sorted, the largest first. COLMAP lets two of them share a few photographs: the first one keeps
    these. A model all of whose photographs are in others is none of the parts.
    """
    whole = models[0]
    measured = {image.name: image for image in survey.images}
    anchor = placed_by_positions(whole, measured)
    parts = []
    for model in models[1:]:
        new = len(set(model.reg_image_ids()) - set(whole.reg_image_ids()))
        if new == 0:
            continue
        if isinstance(anchor, str):
            parts.append(ModelPart(new, f"of the largest model, {anchor}"))
            continue
        place = placed_by_positions(model, measured)
        if isinstance(place, str):
            parts.append(ModelPart(new, place))
            continue
        moved = anchor.inverse() @ place
        model.transform(colmap.Sim3d(moved.matrix()[:3]))
        add_part(colmap, whole, model)
        parts.append(ModelPart(new, ""))
    return whole, tuple(parts)


def placed_by_positions(model: Reconstruction, measured: dict[str, SurveyImage]) -> Similarity | str:
    """Return geo ← local of a model by its fixes and attitudes, or the reason why they do not place it."""
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    images = [image for image in images if image.name in measured and measured[image.name].fix is not None]
    if len(images) < _FEWEST_FIXES:
        return f"{len(images)} of its photographs have a position, and {_FEWEST_FIXES} are needed"
    fixes = [fix for image in images if (fix := measured[image.name].fix) is not None]
    center = np.array([image.projection_center() for image in images])
    position = np.array([fix.position_in_geo for fix in fixes])
    sigma_m = float(np.sqrt(np.median([np.trace(np.asarray(fix.cov_apart)) / 3 for fix in fixes])))
    extent = np.linalg.svd(position - position.mean(axis=0), compute_uv=False) / np.sqrt(len(position))
    if extent[0] < _LEAST_EXTENT * sigma_m / np.sqrt(len(position)):
        return f"its positions span {extent[0]:.1f} m, with σ {sigma_m:.1f} m each"
    turn = _mean_rotation(images, measured)
    wide = len(images) > _FEWEST_FIXES and extent[1] > max(_LEAST_WIDTH * extent[0], sigma_m)
    if wide:
        place, _ = alignment_with(center, position)
    elif turn is not None:
        place = _with_rotation(turn, center, position)
    else:
        return "its positions lie on one line, and no attitudes are known"
    residual_m = float(np.sqrt(np.median(((place.apply(center) - position) ** 2).sum(axis=1)) / 3))
    if residual_m > _MOST_SIGMA * sigma_m:
        return f"its positions fit to {residual_m:.1f} m only, with σ {sigma_m:.1f} m stated"
    return place


def _mean_rotation(images: list[ColmapImage], measured: dict[str, SurveyImage]) -> FloatArray | None:
    """Return the rotation geo ← local by the attitudes; None: too few, or they do not agree."""
    turns = []
    for image in images:
        attitude = measured[image.name].attitude
        if attitude is not None:
            cam_from_local = image.cam_from_world().matrix()[:, :3]
            turns.append(matrix_from_quat_xyzw(attitude.quat_xyzw) @ cam_from_local)
    if len(turns) < _FEWEST_FIXES:
        return None
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    cosine = [(np.trace(mean.T @ turn) - 1) / 2 for turn in turns]
    apart_deg = float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))
    return mean if apart_deg < _ATTITUDES_AGREE_DEG else None


def _with_rotation(rotation: FloatArray, source: FloatArray, target: FloatArray) -> Similarity:
    """Return the least-squares similarity with a known rotation that maps source (N, 3) onto target (N, 3)."""
    turned = (source - source.mean(axis=0)) @ rotation.T
    scale = float((turned * (target - target.mean(axis=0))).sum() / (turned**2).sum())
    scale = max(scale, np.finfo(float).tiny)
    return Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def add_part(colmap: ModuleType, whole: Reconstruction, part: Reconstruction) -> None:
    """Add the photographs and points of a model, in the frame of another one, to that one."""
    for frame_id in sorted(set(part.reg_frame_ids()) - set(whole.reg_frame_ids())):
        source = part.frames[frame_id]
        theirs = [part.images[data_id.id] for data_id in source.data_ids if part.exists_image(data_id.id)]
        for image in theirs:
            if not whole.exists_camera(image.camera_id):
                whole.add_camera(part.cameras[image.camera_id])
        if not whole.exists_rig(source.rig_id):
            whole.add_rig(part.rigs[source.rig_id])
        if whole.exists_frame(frame_id):  # a mapper's model has those that it has registered alone
            whole.frames[frame_id].rig_from_world = source.rig_from_world
        else:
            frame = colmap.Frame(frame_id=frame_id, rig_id=source.rig_id)
            for image in theirs:
                frame.add_data_id(image.data_id)
            frame.rig_from_world = source.rig_from_world
            whole.add_frame(frame)
            for image in theirs:
                seen = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
                copy = colmap.Image(image.name, keypoints=seen, camera_id=image.camera_id, image_id=image.image_id)
                copy.frame_id = frame_id
                whole.add_image(copy)
        whole.register_frame(frame_id)
    for point in part.points3D.values():
        track = colmap.Track()
        for element in point.track.elements:
            if not whole.images[element.image_id].points2D[element.point2D_idx].has_point3D():
                track.add_element(element.image_id, element.point2D_idx)
        if len(track.elements) > 1:
            whole.add_point3D(point.xyz, track, point.color)
