"""Networks of the cameras with other points than the tie points: marked points, or places in the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.adjust.solved_survey import SolvedSurvey
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.bundle import Network
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.marks import MarkRays, mark_rays
from pipelines.scene.survey import SurveyedPoint


def control_points(solved: SolvedSurvey) -> tuple[SurveyedPoint, ...]:
    """Return the control points that entered the training, in the order of its control term."""
    by_name = {point.name: point for point in solved.trained.survey.control_points}
    control = solved.problem.control
    return () if control is None else tuple(by_name[name] for name in control.point_id)


def control_rays(solved: SolvedSurvey) -> MarkRays:
    """Return the rays of the control points' marks in training images, through the trained lens."""
    return mark_rays(control_points(solved), solved.trained.sparse, solved.scene.train)


def network_of_points(network: Network, position: FloatArray, point: IntArray, camera: IntArray) -> Network:
    """Return a network with other points; its pixels are NaN, because derivatives do not need them.

    Args:
        network: gives the n cameras.
        position: (J, 3) points in the frame of the network.
        point: (K,) index into the points, of each observation.
        camera: (K,) index into the cameras.
    """
    return replace(
        network,
        point_in_world=position,
        obs_point=point,
        obs_image=camera,
        obs_xy_px=np.full((len(point), 2), np.nan),
    )


def in_geo(network: Network, geo_from_model: Similarity) -> Network:
    """Return a network of the frame `model`, transformed to `geo`."""
    return replace(
        network,
        cam_from_world=network.cam_from_world @ geo_from_model.rotation.T,
        cam_center_in_world=geo_from_model.apply(network.cam_center_in_world),
        point_in_world=geo_from_model.apply(network.point_in_world),
    )


def mean_focal_px(sparse: SparseModel, camera: IntArray) -> FloatArray:
    """Return the mean focal lengths (K,) in pixels of images with indices `camera` (K,)."""
    of_image = np.array([sparse.camera_of(index).mean_focal_px for index in range(len(sparse.image_name))])
    return np.asarray(of_image[camera])
