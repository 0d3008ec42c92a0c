"""Rigs: the photographs of one instant keep one pose, with the poses of the lenses in the rig solved once for all.

1. The mapper solves all photographs freely, each lens with intrinsics of its own.
2. The pose of a lens in the rig is the robust mean over the instants at which both it and the reference lens are in
   the model. Instants that only another lens connects get the pose of the rig from it, and so do photographs that
   matched too little to be registered.
3. Everything is adjusted with one pose an instant and one relative pose a lens.

`sfm/rig/` has the whole model, with COLMAP's rigs and frames; `sfm/sparse/` has the photographs of the survey,
which are those of the reference lens.
"""

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray
from pipelines.formats.colmap import flatten, reconstruction_of
from pipelines.geometry.cameras import ColmapCamera, ColmapDatabase, Reconstruction
from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw
from pipelines.geometry.statistics import CAUCHY_95
from pipelines.sfm.adjustment import alignment_with, hold_lenses_in_place
from pipelines.sfm.colmap_database import copy_database, remove_database
from pipelines.sfm.features import SfmJob
from pipelines.survey.survey import Companion, Survey

log = logging.getLogger(__name__)

_FEWEST_INSTANTS = 2  # that show a lens and the reference
_FEWEST_POINTS = 30  # that both show
_WIDEST_BODY_M = 0.25  # between two lenses of one body
_FEWEST_FIXES = 4  # that tell metres
_LOSS_PX = 1.0
_MOST_STEPS = 50
_STATED_DIFFERS_DEG = 2.0


@dataclass(frozen=True)
class _Lens:
    """Pose of a lens in its rig: rotation (3, 3) and translation (3,) lens ← reference, in units of the model."""

    reference: int  # COLMAP's numbers of the two cameras
    rotation: FloatArray
    translation: FloatArray


def with_rigs(
    colmap: ModuleType, job: SfmJob, model: Reconstruction, *, lens_held: bool, progress: Progress
) -> Any:
    """Return a `pycolmap.Reconstruction` in which the photographs of an instant have one pose; of no rig, as it is.

    The survey of the job has its companions among its images.
    """
    lenses = _lenses(model, job.survey)
    if not lenses:
        return model
    draft = job.database.with_name("rig.db")
    remove_database(draft)
    copy_database(job.database, draft)
    try:
        with progress.task("rig", 1) as task:
            before = set(model.reg_image_ids())
            constrained = _rebuilt(colmap, job, model, lenses)
            _write_rigs(colmap, draft, constrained, job.survey, lenses)
            _adjust(colmap, job, constrained, lens_held=lens_held)
            _triangulate(colmap, job, draft, constrained, sorted(set(constrained.reg_image_ids()) - before))
            references = {key: lens.reference for key, lens in lenses.items()}
            if hold_in_body(colmap, constrained, job.survey, references):
                _adjust(colmap, job, constrained, lens_held=lens_held)
            task.advance()
    finally:
        remove_database(draft)
    _compare_stated(constrained, job.survey, lenses)
    return constrained


def reference_alone(model: Reconstruction, survey: Survey) -> Any:
    """Return a model without the photographs of companions, and without the points that only these show."""
    flat = flatten(model)
    others = {each.name for each in survey.companions}
    part = flat.of_images(np.flatnonzero([name not in others for name in flat.image_name]))
    used = set(part.image_camera_id.tolist())
    return reconstruction_of(
        replace(part, cameras={key: lens for key, lens in part.cameras.items() if key in used})
    )


def _numbers(survey: Survey) -> dict[str, int]:
    return {image.name: index + 1 for index, image in enumerate(survey.images)}


def _lenses(model: Reconstruction, survey: Survey) -> dict[int, _Lens]:
    """Return the poses of the lenses in their rigs, by COLMAP's number of the camera."""
    number = _numbers(survey)
    camera = {image.name: image.camera_id for image in survey.images}
    inside = set(model.reg_image_ids())
    seen_by = [
        {model.images[element.image_id].camera_id for element in point.track.elements}
        for point in model.points3D.values()
    ]
    references: dict[int, Counter[int]] = {}
    for each in survey.companions:
        references.setdefault(each.camera_id, Counter())[camera[each.beside]] += 1
    lenses = {}
    for lens, counts in references.items():
        reference = counts.most_common(1)[0][0]
        pairs = [
            (number[each.beside], number[each.name])
            for each in survey.companions
            if each.camera_id == lens and camera[each.beside] == reference
        ]
        poses = [
            model.images[other].cam_from_world().matrix() @ _inverse(model.images[one].cam_from_world().matrix())
            for one, other in pairs
            if one in inside and other in inside
        ]
        # Models that positions alone have placed beside each other are metres off: points tie lenses together.
        shared = sum({lens, reference} <= cameras for cameras in seen_by)
        if len(poses) < _FEWEST_INSTANTS or shared < _FEWEST_POINTS:
            log.warning(
                "The place of a lens in its rig is not determined: %d instants show it (camera %d) and the "
                "reference lens in one model, with %d points in common. Its photographs have poses of their own.",
                len(poses), lens, shared, extra={"code": "rig-lens-open"},
            )  # fmt: skip
            continue
        lenses[lens] = _Lens(reference, *_mean(np.array(poses)))
    return lenses


def _inverse(pose: FloatArray) -> FloatArray:
    """Return the inverse (4, 4) of a pose (3, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:, :3].T
    inverse[:3, 3] = -pose[:, :3].T @ pose[:, 3]
    return inverse


def _mean(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the robust mean of poses (N, 3, 4): of rotations near the median one, and the median translation."""
    rotation = poses[:, :, :3]
    apart = np.array([[np.linalg.norm(log_so3(a.T @ b)) for b in rotation] for a in rotation])
    near = apart[np.median(apart, axis=1).argmin()]
    kept = near <= 3 * max(float(np.median(near)), 1e-9)
    u, _, vt = np.linalg.svd(rotation[kept].sum(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return mean, np.median(poses[kept, :, 3], axis=0)


def _rebuilt(colmap: ModuleType, job: SfmJob, model: Reconstruction, lenses: Mapping[int, _Lens]) -> Any:
    """Return a model with rigs and frames: poses of the reference lens, else by another one of the instant."""
    new = colmap.Reconstruction()
    for camera in model.cameras.values():
        new.add_camera(camera)
    for rig in _rigs(colmap, new.cameras, lenses):
        new.add_rig(rig)
    with colmap.Database.open(job.database) as opened:
        for frame_id, images in _instants(job.survey, lenses).items():
            _add_instant(colmap, opened, new, model=model, frame_id=frame_id, images=images)
    inside = set(new.reg_image_ids())
    for point_id, point in model.points3D.items():
        track = colmap.Track()
        for element in point.track.elements:
            if element.image_id in inside:
                track.add_element(element.image_id, element.point2D_idx)
        if len(track.elements) > 1:
            new.add_point3D_with_id(point_id, colmap.Point3D(xyz=point.xyz, color=point.color, track=track))
    return new


def _add_instant(
    colmap: ModuleType,
    database: ColmapDatabase,
    new: Reconstruction,
    *,
    model: Reconstruction,
    frame_id: int,
    images: Mapping[int, _Lens | None],
) -> None:
    """Add the photographs of an instant, if one of them is in the model; `images` has the reference's first."""
    posed = next((key for key in images if model.exists_image(key) and model.images[key].has_pose), None)
    if posed is None:
        return
    lens, pose = images[posed], np.vstack([model.images[posed].cam_from_world().matrix(), [0, 0, 0, 1]])
    if lens is not None:
        pose = _inverse(np.column_stack([lens.rotation, lens.translation])) @ pose
    stored = {key: database.read_image(key) for key in images}
    stored = {key: image for key, image in stored.items() if new.exists_camera(image.camera_id)}
    first = stored[next(iter(stored))]
    rig_id = next((lens.reference for lens in images.values() if lens is not None), first.camera_id)
    frame = colmap.Frame(frame_id=frame_id, rig_id=rig_id)
    for image in stored.values():
        frame.add_data_id(image.data_id)
    frame.rig_from_world = colmap.Rigid3d(colmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
    new.add_frame(frame)
    for key, image in stored.items():
        if model.exists_image(key):
            seen = np.array([point.xy for point in model.images[key].points2D]).reshape(-1, 2)
        else:
            seen = np.asarray(database.read_keypoints(key), dtype=np.float64)[:, :2]
        copy = colmap.Image(image.name, keypoints=seen, camera_id=image.camera_id, image_id=key)
        copy.frame_id = frame_id
        new.add_image(copy)
    new.register_frame(frame_id)


def _instants(survey: Survey, lenses: Mapping[int, _Lens]) -> dict[int, dict[int, _Lens | None]]:
    """Return the photographs of each instant by COLMAP's numbers; the reference's, its key, is the first.

    Companions of a lens whose place in the rig is not known have an instant of their own.
    """
    number = _numbers(survey)
    beside: dict[str, Companion] = {each.name: each for each in survey.companions}
    camera = {image.name: image.camera_id for image in survey.images}
    instants: dict[int, dict[int, _Lens | None]] = {}
    for image in survey.images:  # companions follow the others
        companion = beside.get(image.name)
        lens = None if companion is None else lenses.get(image.camera_id)
        if companion is None or lens is None or camera[companion.beside] != lens.reference:
            instants[number[image.name]] = {number[image.name]: None}
        else:
            instants[number[companion.beside]][number[image.name]] = lens
    return instants


def _rigs(colmap: ModuleType, cameras: Mapping[int, ColmapCamera], lenses: Mapping[int, _Lens]) -> list[Any]:
    """Return the rigs of all cameras, with the numbers of their reference cameras; most consist of one camera."""
    rigs = {}
    for key, camera in cameras.items():
        if key not in lenses:
            rigs[key] = colmap.Rig(rig_id=key)
            rigs[key].add_ref_sensor(camera.sensor_id)
    for key, lens in lenses.items():
        pose = colmap.Rigid3d(colmap.Rotation3d(lens.rotation), lens.translation)
        rigs[lens.reference].add_sensor(cameras[key].sensor_id, pose)
    return list(rigs.values())


def _write_rigs(
    colmap: ModuleType, database: Path, model: Reconstruction, survey: Survey, lenses: Mapping[int, _Lens]
) -> None:
    """Replace the rigs and frames of a database by those of a model, and of the photographs outside it alike."""
    with colmap.Database.open(database) as opened, colmap.DatabaseTransaction(opened):
        stored = {image.image_id: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        opened.clear_frames()
        opened.clear_rigs()
        for rig in _rigs(colmap, cameras, lenses):
            opened.write_rig(rig, use_rig_id=True)
        for frame_id, images in _instants(survey, lenses).items():
            rig_id = next((lens.reference for lens in images.values() if lens), stored[frame_id].camera_id)
            frame = colmap.Frame(frame_id=frame_id, rig_id=rig_id)
            for key in images:
                frame.add_data_id(stored[key].data_id)
            opened.write_frame(frame, use_frame_id=True)


def hold_in_body(colmap: ModuleType, model: Reconstruction, survey: Survey, references: Mapping[int, int]) -> bool:
    """Put lenses that were solved outside of their body to the place of the reference lens; whether any was.

    `references` has the reference's camera of each camera. Adjustments hold these lenses (`hold_lenses_in_place`).

    From far above, a lens that moves along its axis differs from one of another focal length by the relief alone:
    photographs of flat ground may leave decimetres open, where the lenses of one body are centimetres apart.
    Rotation and focal length follow, so that what lies at the median distance is seen where it was.
    """
    fixes = {image.name: image.fix for image in survey.images}
    seen = [model.images[key] for key in sorted(model.reg_image_ids())]
    placed = [(image.projection_center(), fix) for image in seen if (fix := fixes[image.name]) is not None]
    if len(placed) < _FEWEST_FIXES:
        return False
    centers, positions = np.array([at for at, _ in placed]), np.array([fix.position_in_geo for _, fix in placed])
    metres = alignment_with(centers, positions)[0].scale
    prior = {each.camera_id: each for each in survey.cameras}
    moved = False
    for key, reference in references.items():
        one, other = prior[key], prior[reference]
        rig, camera = model.rigs[reference], model.cameras[key]
        pose = rig.sensor_from_rig(camera.sensor_id).matrix()
        offset_m = metres * float(np.linalg.norm(pose[:, 3]))
        same_body = one.serial == other.serial != "" and one.make_model == other.make_model
        if not same_body or offset_m <= _WIDEST_BODY_M:
            continue
        distance = _median_distance(model, key)
        x, y, z = pose[:, 3] / distance
        turned = exp_so3(np.array([-y, x, 0.0])) @ pose[:, :3]
        rig.set_sensor_from_rig(camera.sensor_id, colmap.Rigid3d(colmap.Rotation3d(turned), np.zeros(3)))
        params = np.array(camera.params)
        params[camera.focal_length_idxs()] *= 1 - z
        camera.params = params
        log.info(
            "assumed: the lens of camera %d is at the place of the reference lens of the same body; the "
            "photographs would put it %.2f m away, which they do not determine.",
            key, offset_m,
        )  # fmt: skip
        moved = True
    return moved


def _median_distance(model: Reconstruction, camera_id: int) -> float:
    """Return the median distance of the points that a camera's photographs show, along their axes."""
    depth = [
        image.cam_from_world().matrix()[2] @ [*model.points3D[point.point3D_id].xyz, 1.0]
        for image in model.images.values()
        if image.camera_id == camera_id and image.has_pose
        for point in image.points2D
        if point.has_point3D()
    ]
    return float(np.median(depth))


def _adjust(colmap: ModuleType, job: SfmJob, model: Reconstruction, *, lens_held: bool) -> None:
    bundle = colmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        bundle.add_image(image_id)
    hold_lenses_in_place(bundle, model)
    bundle.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjustment = colmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.refine_focal_length = adjustment.refine_extra_params = not lens_held
    adjustment.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = CAUCHY_95 * _LOSS_PX
    adjustment.ceres.solver_options.max_num_iterations = _MOST_STEPS
    adjustment.ceres.solver_options.num_threads = chosen_threads(job.options.threads)
    colmap.create_default_bundle_adjuster(adjustment, bundle, model).solve()


def _triangulate(colmap: ModuleType, job: SfmJob, database: Path, model: Reconstruction, new: list[int]) -> None:
    """Add the points of photographs that the rig alone has placed, and leave out what does not fit."""
    with colmap.Database.open(database) as opened:
        cache = colmap.DatabaseCache.create(opened, colmap.DatabaseCacheOptions())
    mapper, options = colmap.IncrementalMapper(cache), colmap.IncrementalTriangulatorOptions()
    options.random_seed = job.options.seed
    mapper.begin_reconstruction(model)
    for image_id in new:
        mapper.triangulate_image(options, image_id)
    mapper.complete_and_merge_tracks(options)
    mapper.filter_points(colmap.IncrementalMapperOptions())
    mapper.end_reconstruction(False)


def _compare_stated(model: Reconstruction, survey: Survey, lenses: Mapping[int, _Lens]) -> None:
    """Warn of lenses whose solved rotation is not the one that somebody stated."""
    stated = {each.camera_id: each.stated_quat_xyzw for each in survey.companions if each.stated_quat_xyzw}
    for key in sorted(set(stated) & set(lenses)):
        solved = model.rigs[lenses[key].reference].sensor_from_rig(model.cameras[key].sensor_id)
        quat = stated[key]
        assert quat is not None
        turn = solved.rotation.matrix() @ matrix_from_quat_xyzw(quat).T
        apart_deg = float(np.degrees(np.linalg.norm(log_so3(turn))))
        if apart_deg > _STATED_DIFFERS_DEG:
            log.warning(
                "The photographs turn camera %d by %.1f° against the rotation in the rig that is stated for it: "
                "they are followed. Check the rotations of --rig.",
                key, apart_deg, extra={"code": "rig-rotation-differs"},
            )  # fmt: skip
