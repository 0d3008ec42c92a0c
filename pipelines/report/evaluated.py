"""Evaluated survey: what the sections of the report take their facts from, loaded and computed once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.cautions import is_checked
from pipelines.core.stages import BY_NAME, REPORT
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.bundle import Network, has_positive_depth
from pipelines.geometry.cameras import project_each
from pipelines.geometry.footprints import PointSurface
from pipelines.geometry.refined_points import refined_points
from pipelines.report.options import ReportOptions
from pipelines.scene.report import EvaluationReport, read_report
from pipelines.scene.target_crs import TargetCrs, usable_crs
from pipelines.scene.trained_survey import SolvedSurvey, load_solved

_LEAST_RAYS = 3  # of a point that counts as a part of the surface
_RIM = 0.005  # fraction of the points that are taken for errors above, and below


@dataclass(frozen=True)
class CameraSigma:
    """Covariance of the n cameras, or the reason why it is not known.

    Attributes:
        covariance: (n, 6, 6) of (δθ [rad], δc [m]) along the axes of `geo`; None: not known.
        reason: why not; empty if known.
    """

    covariance: FloatArray | None
    reason: str


@dataclass(frozen=True)
class EvaluatedSurvey:
    """Solved survey with its evaluation.

    Attributes:
        workspace: it was read from.
        solved: survey, cameras, and the Gaussians if there are any.
        report: of `evaluate`.
        posterior: covariances of the solution.
        crs: of the coordinates in the report.
    """

    workspace: Workspace
    solved: SolvedSurvey
    report: EvaluationReport
    posterior: Posterior
    crs: TargetCrs

    @cached_property
    def document(self) -> dict[str, Any]:
        """The report of `evaluate` as JSON."""
        return self.report.model_dump(mode="json")

    @cached_property
    def center_in_geo(self) -> FloatArray:
        """Adjusted projection centres (n, 3), metres."""
        return self.solved.geo_from_model.apply(self.solved.poses.cam_center_in_model)

    @cached_property
    def network(self) -> Network:
        """The image observations with adjusted cameras and lenses, and points where these see them, in `model`."""
        sparse, poses = self.solved.sparse, self.solved.poses
        network = Network(
            sparse.cameras,
            sparse.image_camera_id,
            poses.cam_from_model,
            poses.cam_center_in_model,
            self.solved.point_in_model,
            sparse.obs_point,
            sparse.obs_image,
            sparse.obs_xy_px,
        )
        return replace(network, point_in_world=refined_points(network).point_in_world)

    @cached_property
    def residual_px(self) -> FloatArray:
        """Reprojection residuals (M, 2), projected minus observed; NaN where a point lies behind its camera."""
        network = self.network
        ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
        in_cam = np.einsum("mij,mj->mi", network.cam_from_world[network.obs_image], ray)
        projected = project_each(network.cameras, network.camera_id[network.obs_image], in_cam)
        return np.asarray(np.where(has_positive_depth(network)[:, None], projected - network.obs_xy_px, np.nan))

    @cached_property
    def scene_in_geo(self) -> FloatArray:
        """SfM points (N, 3) in `geo` that three photographs show, without the highest and lowest."""
        network = self.network
        points = self.solved.geo_from_model.apply(network.point_in_world)
        points = points[np.bincount(network.obs_point, minlength=len(points)) >= _LEAST_RAYS]
        if not len(points):
            return points
        low, high = np.quantile(points[:, 2], [_RIM, 1 - _RIM])
        return np.asarray(points[(points[:, 2] >= low) & (points[:, 2] <= high)])

    @cached_property
    def surface(self) -> PointSurface | None:
        """Surface through the points of the scene; None: there are none."""
        return PointSurface(self.scene_in_geo) if len(self.scene_in_geo) else None

    @cached_property
    def camera_sigma(self) -> CameraSigma:
        """Covariance of the cameras."""
        if not is_checked(self.solved.model.cautions):
            return CameraSigma(None, "nothing checks the σ of the positions")
        return CameraSigma(self.posterior.camera_cov, "")


def load_evaluated(workspace: Workspace, options: ReportOptions) -> EvaluatedSurvey:
    """Return the evaluated survey of a workspace.

    Raises:
        MissingProductError: a stage up to evaluate has not been run; names the command.
        InputError: a product is damaged, or the CRS cannot be used here.
    """
    report = read_report(workspace.path(REPORT))
    solved = load_solved(workspace, _evaluated_similarity(workspace))
    center_in_geo = solved.geo_from_model.apply(solved.poses.cam_center_in_model)
    crs = usable_crs(options, solved.survey.origin, center_in_geo, solved.survey.vertical)
    posterior = posterior_of(workspace, solved.model, solved.sfm)
    return EvaluatedSurvey(workspace, solved, report, posterior, crs)


def _evaluated_similarity(workspace: Workspace) -> Literal["trained", "initial"]:
    """Return the similarity that was evaluated; the trained one for a report put there by hand."""
    manifest = workspace.manifest(BY_NAME["evaluate"])
    return "initial" if manifest is not None and manifest.config.get("similarity") == "initial" else "trained"
