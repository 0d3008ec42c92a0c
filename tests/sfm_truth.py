"""Databases of photographs whose features and matches are the truth's with noise: no picture is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.progress import SILENT
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera, project
from pipelines.sfm.colmap_database import add_features, write_frame
from pipelines.sfm.features import SfmJob, candidate_pairs, verify_matches
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import CameraPrior, Survey
from tests.sfm_scenes import survey_of

_FEWEST_MATCHES = 15


@dataclass(frozen=True)
class Views:
    """N photographs: their cameras' numbers, rotations (N, 3, 3) camera ← world, centres (N, 3)."""

    names: list[str]
    camera_id: list[int]
    rotation: FloatArray
    center: FloatArray


def prior_of(camera_id: int, camera: Camera, sensor: str = "") -> CameraPrior:
    return CameraPrior(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=tuple(camera.params.tolist()),
        focal_source="calibrated",
        sensor=sensor,
    )


def survey_of_views(views: Views, cameras: Mapping[int, Camera]) -> Survey:
    survey = survey_of(views.names)
    images = [
        image.model_copy(update={"camera_id": camera})
        for image, camera in zip(survey.images, views.camera_id, strict=True)
    ]
    priors = tuple(prior_of(key, camera) for key, camera in cameras.items())
    return survey.model_copy(update={"cameras": priors, "images": tuple(images)})


def matched_views(
    folder: Path,
    survey: Survey,
    views: Views,
    cameras: Mapping[int, Camera],
    point: FloatArray,
    *,
    noise_px: float,
    shown: FloatArray | None = None,
    seed: int = 0,
) -> SfmJob:
    """A job whose database has the projections of points (P, 3), verified; `cameras` are the true ones.

    `shown` (N, P) says which photograph may show which point; None: any.
    """
    pycolmap: Any = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(seed)
    job = SfmJob(survey, folder, folder / "database.db", SfmOptions(camera_model="SIMPLE_RADIAL", threads=1))
    with pycolmap.Database.open(job.database):
        pass
    write_frame(pycolmap, job.database, survey, range(len(views.names)), job.options)
    nothing = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.zeros((1, 128), np.uint8))
    places, rows = {}, []
    for index, key in enumerate(views.camera_id):
        camera = cameras[key]
        xy = project(camera, (point - views.center[index]) @ views.rotation[index].T)
        xy = xy + rng.normal(0, noise_px, xy.shape)
        seen = ((xy > 0) & (xy < (camera.width, camera.height))).all(axis=1)
        inside = np.flatnonzero(seen if shown is None else seen & (shown[index] > 0))
        places[index], row = xy[inside], np.full(len(point), -1)
        row[inside] = np.arange(len(inside))
        rows.append(row)
        with pycolmap.Database.open(job.database) as database:
            database.write_keypoints(index + 1, np.array([[5.0, 5.0, 1.0, 0.0, 0.0, 1.0]], np.float32))
            database.write_descriptors(index + 1, nothing)
    matches = {}
    for a, b in candidate_pairs(survey, job.options).tolist():
        both = np.flatnonzero((rows[a] >= 0) & (rows[b] >= 0))
        if len(both) >= _FEWEST_MATCHES:
            matches[a, b] = np.stack([rows[a][both], rows[b][both]], axis=1)
    add_features(pycolmap, job.database, places, matches)
    verify_matches(pycolmap, job, np.array(sorted(matches)), SILENT)
    return job
