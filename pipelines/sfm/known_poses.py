"""Triangulation from known poses: points of a model whose poses come from elsewhere and stay as they are."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json
from pipelines.core.progress import Progress
from pipelines.formats.colmap import flatten
from pipelines.geometry.cameras import ColmapDatabase, Reconstruction
from pipelines.sfm.chunks import PLAN, ChunkPlan, join_chunks
from pipelines.sfm.colmap_database import require_sound
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features, match_features
from pipelines.sfm.mapping import triangulate
from pipelines.sfm.model_poses import Matches, check_matches, epipolar_error_px

_LEAST_POINTS = 10
_LIMIT_PX = 4.0  # COLMAP's own
_LIMIT_OF_EPIPOLAR = 8.0  # times the median distance of matches: nearly all that are right, across the line too


def triangulated_from(
    colmap: ModuleType, imported: Reconstruction, job: SfmJob, folder: Path, progress: Progress, *, held: bool
) -> Any:
    """Return a model with poses and lenses of an imported `pycolmap.Reconstruction`, and points without colour.

    Poses and lenses are not changed. Images that the imported model lacks have no pose. Of poses not `held`
    later, observations beyond COLMAP's limit are kept if the poses are as inaccurate (`triangulated_again`).

    Raises:
        InputError: the poses contradict the matches; names the convention that fits.
        DegenerateGeometryError: hardly a match fits the poses.
        GeorefError: a photograph is not that of the survey.
    """
    colmap.set_random_seed(job.options.seed)
    if len(job.survey.images) > job.options.chunk_size:
        join_chunks(colmap, job, load_json(ChunkPlan, job.database.parent / PLAN), job.database.parent, progress)
    else:
        require_sound(job.database)
        extract_features(colmap, job, range(len(job.survey.images)), progress)
        match_features(colmap, job, candidate_pairs(job.survey, job.options), progress)
    model = _with_numbers_of(colmap, imported, job.database)
    matches = _matches(colmap, model, job.database)
    check_matches(flatten(model), matches, folder)
    limit_px = _LIMIT_PX if held else _limit_px(model, matches)
    triangulate(colmap, model, job.database, progress, limit_px=limit_px)
    if model.num_points3D() < _LEAST_POINTS:
        raise _without_points(model, sum(len(pixels) for pixels, _ in matches.values()), len(matches))
    return model


def triangulated_again(colmap: ModuleType, model: Reconstruction, database: Path, progress: Progress) -> Any:
    """Return the cameras of a `pycolmap.Reconstruction` of this database with points triangulated anew.

    The limit of an observation follows the distances of the matches from their epipolar lines: with COLMAP's own,
    cameras with the largest errors would lose the observations that show these.
    """
    limit_px = _limit_px(model, _matches(colmap, model, database))
    bare = type(model)(model)
    bare.delete_all_points2D_and_points3D()
    triangulate(colmap, bare, database, progress, limit_px=limit_px)
    return bare


def _limit_px(model: Reconstruction, matches: Matches) -> float:
    return max(_LIMIT_PX, _LIMIT_OF_EPIPOLAR * epipolar_error_px(flatten(model), matches))


def _without_points(model: Reconstruction, matches: int, pairs: int) -> DegenerateGeometryError:
    """Return the error of poses that give hardly a point: the photographs or the poses are the cause."""
    triangulated = f"{model.num_points3D()} points could be triangulated from the imported poses"
    if matches < _LEAST_POINTS:
        return DegenerateGeometryError(
            "no-matches",
            (
                f"{triangulated}: {matches} verified matches were found between the {model.num_images()} "
                "photographs. They do not show the same ground, or it lacks texture; poses play no part in that."
            ),
            remedy="Check that the photographs overlap, and are those of the model.",
        )
    return DegenerateGeometryError(
        "no-points-triangulated",
        f"{triangulated}, although {matches} matches were found in {pairs} pairs of photographs: the poses or the "
        "focal length are too inaccurate. Reconstruct without --import.",
    )


def _with_numbers_of(colmap: ModuleType, imported: Reconstruction, database: Path) -> Any:
    """Return the posed images of a model, without points, with their numbers in a database, which gets the cameras.

    COLMAP requires that images have the same cameras in a model and in its database.
    """
    model = colmap.Reconstruction()
    with colmap.Database.open(database) as opened, colmap.DatabaseTransaction(opened):
        listed = {image.name: image for image in opened.read_all_images()}
        first = 1 + max((camera.camera_id for camera in opened.read_all_cameras()), default=0)
        number_of: dict[int, int] = {}
        for image_id in sorted(imported.reg_image_ids()):
            source = imported.images[image_id]
            if source.camera_id not in number_of:
                number_of[source.camera_id] = first + len(number_of)
                camera = colmap.Camera(imported.cameras[source.camera_id].todict())
                camera.camera_id = number_of[source.camera_id]
                model.add_camera_with_trivial_rig(camera)
                opened.write_camera(camera, use_camera_id=True)
                opened.write_rig(model.rigs[camera.camera_id], use_rig_id=True)
            row = listed[source.name]
            row.camera_id = number_of[source.camera_id]
            frame = colmap.Frame(frame_id=row.frame_id, rig_id=row.camera_id)
            frame.add_data_id(row.data_id)
            opened.update_frame(frame)
            opened.update_image(row)
            posed = colmap.Image(name=row.name, camera_id=row.camera_id, image_id=row.image_id)
            model.add_image_with_trivial_frame(posed, source.cam_from_world())
    return model


def _matches(colmap: ModuleType, model: Reconstruction, database: Path) -> Matches:
    """Return pixels of the verified matches between the posed images, by rows of the flat model."""
    row_of = {int(image_id): row for row, image_id in enumerate(sorted(model.reg_image_ids()))}
    matches = {}
    with colmap.Database.open(database) as opened:
        keypoints = {image_id: np.asarray(opened.read_keypoints(image_id))[:, :2] for image_id in row_of}
        for (first, second), geometry in _geometries(colmap, opened):
            if first in row_of and second in row_of and len(geometry.inlier_matches):
                pairs = np.asarray(geometry.inlier_matches)
                matches[row_of[first], row_of[second]] = (
                    keypoints[first][pairs[:, 0]].astype(np.float64),
                    keypoints[second][pairs[:, 1]].astype(np.float64),
                )
    return matches


def _geometries(colmap: ModuleType, opened: ColmapDatabase) -> list[tuple[tuple[int, int], Any]]:
    pair_ids, geometries = opened.read_two_view_geometries()
    pairs = [tuple(colmap.pair_id_to_image_pair(pair_id)) for pair_id in pair_ids]
    return list(zip(pairs, geometries, strict=True))
