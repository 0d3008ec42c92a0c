"""Surveyed points, triangulated: intersections of the rays of their marks."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.scene.marks import MarkRays, RayErrors, intersect_marks
from pipelines.scene.trained_survey import SolvedSurvey

# Errors of the trained cameras: rays agree within these errors and the σ of their marks.
_CAMERA_ERRORS = RayErrors(sigma_center=0.02, sigma_attitude_rad=2e-4)


def points_by_camera(solved: SolvedSurvey, rays: MarkRays) -> FloatArray:
    """Return the intersections (J, 3) in `geo` of the rays of each point; NaN: marks in fewer than two images.

    Args:
        solved: cameras and similarity.
        rays: of the marks of J points.
    """
    poses = solved.poses
    met = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, _CAMERA_ERRORS)
    position = met.position_in_geo.copy()  # in the frame of the cameras, `model`
    position[rays.marks_of_point < 2] = np.nan
    return solved.geo_from_model.apply(position)
