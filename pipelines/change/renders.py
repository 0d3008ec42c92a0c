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
from pipelines.geodesy.enu import Origin, ecef_from_enu_rotation, ecef_from_lla, lla_of
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.geometry.similarity import Similarity
from pipelines.surface.surface_views import ModelRenderer, model_renderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained

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


def moved_pose(pose: ViewPose, to_from_from: Similarity) -> ViewPose:
    """Return a camera in another frame, by the similarity to that frame."""
    rotation = pose.cam_from_model @ to_from_from.rotation.T
    return ViewPose(pose.pinhole, rotation, to_from_from.apply(pose.center_in_model))


def render_pair(
    workspaces: tuple[Workspace, Workspace], grid: CommonGrid, plan: tuple[float, float], progress: Progress
) -> RenderPair | str:
    """Return renders from the camera that looks at a place (east, north) in the CRS; or why there are none.

    Raises as `read_trained`, `read_sfm` and `model_renderer`.
    """
    for workspace in workspaces:
        if not (workspace.has(MODEL) and workspace.has(GAUSSIANS)):
            return f"{workspace.root.name} has no trained model."
    renderer, ecef_from_before = _renderer(workspaces[0], progress)
    cameras = renderer.model.indices("train")
    poses = [renderer.pose(index) for index in cameras]
    best = nearest_to_middle(poses, ecef_from_before.inverse().apply(_in_ecef(grid, plan))[0])
    if best is None:
        return "No photograph of the earlier epoch shows the middle of the change."
    pose = ViewPose(_small(poses[best].pinhole), poses[best].cam_from_model, poses[best].center_in_model)
    first = _pixels(renderer, pose)
    later, ecef_from_after = _renderer(workspaces[1], progress)
    second = _pixels(later, moved_pose(pose, ecef_from_after.inverse() @ ecef_from_before))
    return RenderPair(renderer.model.cameras[cameras[best]].name, first, second)


def nearest_to_middle(poses: list[ViewPose], point_in_model: FloatArray) -> int | None:
    """Return the index of the camera that shows a point (3,) nearest to the middle of its picture; None: no one."""
    distances = []
    for index, pose in enumerate(poses):
        in_cam = pose.cam_from_model @ (point_in_model - pose.center_in_model)
        if in_cam[2] <= 0:
            continue
        size = np.array([pose.pinhole.width, pose.pinhole.height])
        off = np.abs(pose.pinhole.project(in_cam[None])[0] / size - 0.5)
        if (off < 0.5).all():
            distances.append((float(np.linalg.norm(off)), index))
    return min(distances)[1] if distances else None


def _in_ecef(grid: CommonGrid, plan: tuple[float, float]) -> FloatArray:
    """Return a place (1, 3) in EPSG:4978 of a place in the CRS, on the earlier surface."""
    one = grid.rasters[0]
    height = sampled_raster(one.folder / one.names[0], np.array([plan]))
    if not np.isfinite(height[0]):
        height = np.array([one.sidecar.bounds[0][2]])
    return ecef_from_lla(grid.crs.lla_from_xyz(np.column_stack([[plan], height])))


def _renderer(workspace: Workspace, progress: Progress) -> tuple[ModelRenderer, Similarity]:
    """Return the renderer of an epoch's model, and the similarity from its frame `model` to EPSG:4978."""
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey, progress=progress)
    return renderer, ecef_from_geo(survey.origin_on_earth) @ model.similarity


def _small(pinhole: Pinhole) -> Pinhole:
    return pinhole.limited(_RENDER_PX)


def _pixels(renderer: ModelRenderer, pose: ViewPose) -> ByteArray:
    colour = renderer.render(pose).colour.clamp(0, 1).cpu().numpy()
    return np.asarray(np.round(255 * colour), dtype=np.uint8)
