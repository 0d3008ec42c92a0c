"""Photographs and small models that the mapper leaves out, joined to the largest model by their matches with it.

1. The photographs left out are mapped by themselves, with the lens of the largest model: pairs become models, too.
2. `match_ties.py` finds the place of each beside the largest model, and refuses one that the matches leave open.
3. Points are triangulated across the seam, also those that two photographs alone show, and the part is adjusted
   to the model. A part that shares hardly a point with it after that is taken back.
4. What is left is tried again, photograph by photograph, until none is joined.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress, ProgressTask
from pipelines.geometry.cameras import ColmapDatabase, Reconstruction
from pipelines.geometry.statistics import CAUCHY_95
from pipelines.sfm.features import SfmJob
from pipelines.sfm.mapping import MapperRun, replaced_lens, run_mapper, scratch_beside
from pipelines.sfm.match_ties import Tie, side_of, tie
from pipelines.sfm.parts import add_part

log = logging.getLogger(__name__)

_FEWEST_MATCHES = 15  # COLMAP's fewest verified ones of a pair that counts
_FEWEST_SHARED = 15  # points that a part shares with the model when it is adjusted
_FEWEST_OF_PART = 2
_LOSS_PX = 1.0
_MOST_STEPS = 50

Pairs = dict[tuple[int, int], Any]


@dataclass(frozen=True)
class Join:
    """A part that was joined, by COLMAP's numbers of its photographs, and how it is tied."""

    images: tuple[int, ...]
    tie: Tie


def join_by_matches(
    colmap: ModuleType, job: SfmJob, whole: Reconstruction, progress: Progress
) -> tuple[Any, tuple[Join, ...]]:
    """Return a `pycolmap.Reconstruction` of the incremental mapper, with what its matches tie to it, and the joins.

    The given model stays as it is.
    """
    pairs = _pairs_across(colmap, job.database, whole)
    if not pairs:
        return whole, ()
    joins: list[Join] = []
    apart = len(job.survey.images) - whole.num_reg_images()
    with progress.task("joining by matches", apart) as task:
        for parts in (_models_apart(colmap, job, whole), None):
            while True:
                waiting = parts if parts is not None else _photographs_apart(colmap, job, whole)
                whole, joined = _join_some(colmap, job, whole, waiting, task)
                joins += joined
                if not joined:
                    break
    return whole, tuple(joins)


def _join_some(
    colmap: ModuleType, job: SfmJob, whole: Reconstruction, parts: list[Reconstruction], task: ProgressTask
) -> tuple[Any, list[Join]]:
    """Return the model with those parts that are tied to it as it is now, and their joins."""
    joins = []
    for part in parts:
        images = sorted(set(part.reg_image_ids()) - set(whole.reg_image_ids()))
        if not images:
            continue
        join = _tied(colmap, job, whole, part)
        if isinstance(join, str):
            log.info("A part of %d photographs is not joined: %s.", len(images), join)
            continue
        moved, joined = type(part)(part), type(whole)(whole)
        moved.transform(colmap.Sim3d(join.model_from_part.matrix()[:3]))
        add_part(colmap, joined, moved)
        if _settle(colmap, job, joined, images) < _FEWEST_SHARED:
            log.info("A part of %d photographs shares too few points with the model when adjusted.", len(images))
            continue
        whole = joined
        joins.append(Join(tuple(images), join))
        task.advance(len(images))
    return whole, joins


def _tied(colmap: ModuleType, job: SfmJob, whole: Reconstruction, part: Reconstruction) -> Tie | str:
    pairs = _pairs_across(colmap, job.database, whole, part)
    if not pairs:
        return "no photograph of it matches the model"
    image = [[key[side] for key, rows in pairs.items() for _ in rows] for side in (0, 1)]
    row = np.concatenate(list(pairs.values()))
    model, theirs = (side_of(each, image[side], row[:, side].tolist()) for side, each in ((1, whole), (0, part)))
    return tie(colmap, model, theirs, has_scale=part.num_reg_frames() > 1, seed=job.options.seed)


def _pairs_across(colmap: ModuleType, database: Path, whole: Reconstruction, part: Reconstruction = None) -> Pairs:
    """Return the verified matches, rows (N, 2) of features, of photographs outside a model with those in it.

    The keys are COLMAP's numbers of the two. With `part`, the photographs outside are those of another model.
    """
    inside = set(whole.reg_image_ids())
    outside = None if part is None else set(part.reg_image_ids()) - inside
    pairs: Pairs = {}
    with colmap.Database.open(database) as opened:
        for pair, count in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            if count < _FEWEST_MATCHES:
                continue
            first, second = colmap.pair_id_to_image_pair(pair)
            for one, other in ((first, second), (second, first)):
                if other in inside and one not in inside and (outside is None or one in outside):
                    rows = np.asarray(opened.read_two_view_geometry(one, other).inlier_matches, dtype=np.int64)
                    pairs[one, other] = rows
    return pairs


def _models_apart(colmap: ModuleType, job: SfmJob, whole: Reconstruction) -> list[Any]:
    """Return models of the photographs that are not in a model, with its lens held."""
    inside = set(whole.reg_image_ids())
    names = [image.name for index, image in enumerate(job.survey.images) if index + 1 not in inside]
    if len(names) < _FEWEST_OF_PART:
        return []
    used = {whole.images[image_id].camera_id for image_id in inside}
    lens = {camera_id: whole.cameras[camera_id].params.copy() for camera_id in used}
    with replaced_lens(colmap, job.database, lens), scratch_beside(job.database) as scratch:
        threads = chosen_threads(job.options.threads)
        run = MapperRun(job.database, job.images, scratch, threads, job.options.seed, True, names, _FEWEST_OF_PART)
        return run_mapper(colmap, "incremental", run, lambda: None)


def _photographs_apart(colmap: ModuleType, job: SfmJob, whole: Reconstruction) -> list[Any]:
    """Return a model of each photograph that matches a model and is not in it, those with most matches first."""
    matches: dict[int, int] = {}
    for (one, _), rows in _pairs_across(colmap, job.database, whole).items():
        matches[one] = matches.get(one, 0) + len(rows)
    with colmap.Database.open(job.database) as opened:
        alone = [
            _model_of_one(colmap, opened, whole, one) for one in sorted(matches, key=lambda one: -matches[one])
        ]
    return [model for model in alone if model is not None]


def _model_of_one(colmap: ModuleType, database: ColmapDatabase, whole: Reconstruction, image_id: int) -> Any:
    """Return a model of one photograph, in its own frame; None: its camera is one of several of a rig."""
    stored = database.read_image(image_id)
    rig = database.read_rig_with_sensor(stored.data_id.sensor_id)
    if rig.num_sensors() > 1:
        return None
    camera = database.read_camera(stored.camera_id)
    if whole.exists_camera(camera.camera_id):
        camera.params = whole.cameras[camera.camera_id].params
    model = colmap.Reconstruction()
    model.add_camera(camera)
    model.add_rig(rig)
    frame = colmap.Frame(frame_id=stored.frame_id, rig_id=rig.rig_id)
    frame.add_data_id(stored.data_id)
    frame.rig_from_world = colmap.Rigid3d()
    model.add_frame(frame)
    seen = np.asarray(database.read_keypoints(image_id), dtype=np.float64)[:, :2]
    image = colmap.Image(stored.name, keypoints=seen, camera_id=stored.camera_id, image_id=image_id)
    image.frame_id = stored.frame_id
    model.add_image(image)
    model.register_frame(stored.frame_id)
    return model


def _settle(colmap: ModuleType, job: SfmJob, whole: Reconstruction, images: list[int]) -> int:
    """Triangulate and adjust photographs that have joined a model, in place; the number of points they share."""
    with colmap.Database.open(job.database) as opened:
        cache = colmap.DatabaseCache.create(opened, colmap.DatabaseCacheOptions())
    mapper, options = colmap.IncrementalMapper(cache), colmap.IncrementalTriangulatorOptions()
    options.random_seed = job.options.seed
    options.ignore_two_view_tracks = False
    mapper.begin_reconstruction(whole)
    for image_id in images:
        mapper.triangulate_image(options, image_id)
    mapper.complete_and_merge_tracks(options)
    _adjust_part(colmap, job, whole, images)
    # Parts beside it that positions have placed fit the lens of this one only when all is adjusted: they stay.
    limits = colmap.IncrementalMapperOptions()
    mapper.observation_manager.filter_points3D_in_images(
        limits.filter_max_reproj_error, limits.filter_min_tri_angle, set(images)
    )
    mapper.end_reconstruction(False)
    new = set(images)
    tracks = ({element.image_id for element in point.track.elements} for point in whole.points3D.values())
    return sum(bool(track & new) and not track <= new for track in tracks)


def _adjust_part(colmap: ModuleType, job: SfmJob, whole: Reconstruction, images: list[int]) -> None:
    """Adjust photographs to those of the model that they share points with, which stay where they are."""
    new, beside = set(images), set()
    for point in whole.points3D.values():
        track = {element.image_id for element in point.track.elements}
        if track & new:
            beside |= track - new
    bundle = colmap.BundleAdjustmentConfig()
    for image_id in new | beside:
        bundle.add_image(image_id)
    for image_id in beside:
        bundle.set_constant_rig_from_world_pose(whole.images[image_id].frame_id)
    adjustment = colmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.refine_focal_length = adjustment.refine_extra_params = adjustment.refine_sensor_from_rig = False
    adjustment.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = CAUCHY_95 * _LOSS_PX
    adjustment.ceres.solver_options.max_num_iterations = _MOST_STEPS
    adjustment.ceres.solver_options.num_threads = chosen_threads(job.options.threads)
    colmap.create_default_bundle_adjuster(adjustment, bundle, whole).solve()
