"""Surveyed points measured in the model by its cameras: where the rays of their marks meet."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.scene.marks import MarkRays, RayErrors, intersect_marks
from pipelines.scene.trained_survey import TrainedSurvey

# Rays of a mark are held to agree within their mark's σ and this much of the cameras' own error.
_CAMERA_ERRORS = RayErrors(sigma_center=0.02, sigma_attitude_rad=2e-4)


def points_by_camera(trained: TrainedSurvey, rays: MarkRays) -> FloatArray:
    """Return points (J, 3) in `geo` where the rays of their marks meet; NaN for one in fewer than two images."""
    poses = trained.poses
    solved = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, _CAMERA_ERRORS)
    position = solved.position_in_geo.copy()  # the frame of the cameras stands for `geo` there
    position[rays.marks_of_point < 2] = np.nan
    return trained.geo_from_model.apply(position)
