"""Differences between the trained cameras and their measured positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.scene.trained_survey import TrainedSurvey


@dataclass(frozen=True)
class FixDifferences:
    """Trained minus measured position of the F registered cameras that have a fix.

    Attributes:
        camera: (F,) index into the images of the SfM model.
        difference_in_geo: (F, 3) metres.
        is_training: (F,) whether the fix is that of a training camera: only these enter the solution.
        is_outlier: (F,) whether the solution has left the fix out.
    """

    camera: IntArray
    difference_in_geo: FloatArray
    is_training: BoolArray
    is_outlier: BoolArray


def fix_differences(trained: TrainedSurvey) -> FixDifferences:
    """Return the differences between the trained cameras of a survey and their fixes."""
    center_in_geo = trained.geo_from_model.apply(trained.poses.cam_center_in_model)
    fixes = {image.name: image.fix for image in trained.survey.images}
    outliers = set(trained.model.gnss_outliers)
    cameras = trained.model.cameras
    rows = [(index, fix) for index, camera in enumerate(cameras) if (fix := fixes.get(camera.name)) is not None]
    index = np.array([row for row, _ in rows], dtype=np.int64)
    measured = np.array([fix.position_in_geo for _, fix in rows]).reshape(-1, 3)
    return FixDifferences(
        camera=index,
        difference_in_geo=center_in_geo[index] - measured,
        is_training=np.array([cameras[row].split == "train" for row in index], dtype=bool),
        is_outlier=np.array([cameras[row].name in outliers for row in index], dtype=bool),
    )
