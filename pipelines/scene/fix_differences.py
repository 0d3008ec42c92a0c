"""Differences between the adjusted cameras and their measured positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.scene.trained_survey import SolvedSurvey


@dataclass(frozen=True)
class FixDifferences:
    """Adjusted minus measured position of the F registered cameras that have a fix.

    Attributes:
        camera: (F,) index into the images of the SfM model.
        difference_in_geo: (F, 3) metres.
        is_outlier: (F,) whether the solution has left the fix out.
    """

    camera: IntArray
    difference_in_geo: FloatArray
    is_outlier: BoolArray


def fix_differences(solved: SolvedSurvey) -> FixDifferences:
    """Return the differences between the adjusted cameras of a survey and their fixes."""
    center_in_geo = solved.geo_from_model.apply(solved.poses.cam_center_in_model)
    fixes = {image.name: image.fix for image in solved.survey.images}
    outliers = set(solved.model.gnss_outliers)
    cameras = solved.model.cameras
    rows = [(index, fix) for index, camera in enumerate(cameras) if (fix := fixes.get(camera.name)) is not None]
    index = np.array([row for row, _ in rows], dtype=np.int64)
    measured = np.array([fix.position_in_geo for _, fix in rows]).reshape(-1, 3)
    return FixDifferences(
        camera=index,
        difference_in_geo=center_in_geo[index] - measured,
        is_outlier=np.array([cameras[row].name in outliers for row in index], dtype=bool),
    )
