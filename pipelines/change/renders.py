"""The trained models of both epochs, rendered from one camera of the earlier one.

The camera goes from `model` of the earlier epoch to that of the later one on Earth: `geo` of each epoch has an
origin of its own, and both meet in the Earth-centred frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.change.grid import CommonGrid
from pipelines.core.progress import Progress
from pipelines.core.stages import GAUSSIANS, MODEL
from pipelines.core.types import ByteArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.geotiff import sampled_raster
from pipelines.geodesy.enu import Origin, ecef_from_enu_rotation, ecef_from_lla, enu_from_ecef, lla_of
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.geometry.similarity import Similarity
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.scene import photographs
from pipelines.survey.trained_survey import TrainedSurvey, load_trained

_RENDER_PX = 960


@dataclass(frozen=True)
class RenderPair:
    """Renders (H, W, 3) of both models from the camera of a photograph of the earlier epoch."""

    camera: str
    before: ByteArray
    after: ByteArray


def ecef_from_geo(origin: Origin) -> Similarity:
    """Return the rigid motion from the frame `geo` of a survey to the Earth-centred frame EPSG:4978."""
    lla = lla_of(origin)
    return Similarity(1.0, ecef_from_enu_rotation(lla), ecef_from_lla(lla))


def later_from_earlier(before: TrainedSurvey, after: TrainedSurvey) -> Similarity:
    """Return the similarity from `model` of the earlier epoch to `model` of the later one."""
    ecef_from_before = ecef_from_geo(before.survey.origin_on_earth) @ before.geo_from_model
    ecef_from_after = ecef_from_geo(after.survey.origin_on_earth) @ after.geo_from_model
    return ecef_from_after.inverse() @ ecef_from_before


def moved_pose(pose: ViewPose, to_from_from: Similarity) -> ViewPose:
    """Return a camera in another frame, by the similarity to that frame."""
    rotation = pose.cam_from_model @ to_from_from.rotation.T
    return ViewPose(pose.pinhole, rotation, to_from_from.apply(pose.center_in_model))


def render_pair(
    workspaces: tuple[Workspace, Workspace], grid: CommonGrid, plan: tuple[float, float], progress: Progress
) -> RenderPair | str:
    """Return renders from the camera that looks at a place (east, north) in the CRS; or why there are none."""
    for workspace in workspaces:
        if not (workspace.has(MODEL) and workspace.has(GAUSSIANS)):
            return f"{workspace.root.name} has no trained model."
    before = load_trained(workspaces[0])
    renderer = _renderer(before, workspaces[0], progress)
    poses = [renderer.pose(index) for index in before.indices("train")]
    best = nearest_to_middle(poses, _in_model(before, grid, plan))
    if best is None:
        return "No photograph of the earlier epoch shows the middle of the change."
    pose = ViewPose(_small(poses[best].pinhole), poses[best].cam_from_model, poses[best].center_in_model)
    first = _pixels(renderer, pose)
    after = load_trained(workspaces[1])
    second = _pixels(_renderer(after, workspaces[1], progress), moved_pose(pose, later_from_earlier(before, after)))
    return RenderPair(before.model.cameras[before.indices("train")[best]].name, first, second)


def nearest_to_middle(poses: list[ViewPose], point_in_model: FloatArray) -> int | None:
    """Return the index of the camera that shows a point (3,) nearest to the middle of its picture; None: no one."""
    found = []
    for index, pose in enumerate(poses):
        in_cam = pose.cam_from_model @ (point_in_model - pose.center_in_model)
        if in_cam[2] <= 0:
            continue
        size = np.array([pose.pinhole.width, pose.pinhole.height])
        off = np.abs(pose.pinhole.project(in_cam[None])[0] / size - 0.5)
        if (off < 0.5).all():
            found.append((float(np.linalg.norm(off)), index))
    return min(found)[1] if found else None


def _in_model(before: TrainedSurvey, grid: CommonGrid, plan: tuple[float, float]) -> FloatArray:
    """Return a place (3,) in `model` of the earlier epoch of a place in the CRS, on the earlier surface."""
    one = grid.rasters[0]
    height = sampled_raster(one.folder / one.names[0], np.array([plan]))
    if not np.isfinite(height[0]):
        height = np.array([one.sidecar.bounds[0][2]])
    lla = grid.crs.lla_from_xyz(np.column_stack([[plan], height]))
    in_geo = enu_from_ecef(ecef_from_lla(lla), before.survey.origin_on_earth)
    return np.asarray(before.geo_from_model.inverse().apply(in_geo)[0])


def _renderer(trained: TrainedSurvey, workspace: Workspace, progress: Progress) -> ModelRenderer:
    images = photographs(trained.sfm, trained.survey, workspace, trained.model.max_image_size)
    backend = rasterizer("auto", progress, mip_filter=trained.model.mip_filter)
    return ModelRenderer(trained, images, backend)


def _small(pinhole: Pinhole) -> Pinhole:
    return pinhole.limited(_RENDER_PX)


def _pixels(renderer: ModelRenderer, pose: ViewPose) -> ByteArray:
    colour = renderer.render(pose).colour.clamp(0, 1).cpu().numpy()
    return np.asarray(np.round(255 * colour), dtype=np.uint8)
