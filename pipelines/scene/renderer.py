"""Rendering of the trained model from its own cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.geometry.cameras import Pinhole, pose_matrix
from pipelines.scene.photographs import ImageCache
from pipelines.scene.trained_survey import TrainedSurvey, trained_pinholes
from pipelines.splat.depth import measured_depth
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, Render, Window
from pipelines.splat.spatial_blocks import SpatialBlocks


@dataclass(frozen=True)
class ViewPose:
    """Camera somewhere in the scene.

    Attributes:
        pinhole: of its image.
        cam_from_model: (3, 3) rotation.
        center_in_model: (3,) metres.
    """

    pinhole: Pinhole
    cam_from_model: FloatArray
    center_in_model: FloatArray


class ModelRenderer:
    """Renderer of the trained model from its own cameras, at the size of the training photographs.

    Args:
        trained: the trained model.
        images: undistorted photographs of the same cameras.
        backend: the rasteriser.
    """

    def __init__(self, trained: TrainedSurvey, images: ImageCache, backend: Rasterizer) -> None:
        self.trained, self.images = trained, images
        self._backend = backend
        self._pinholes = trained_pinholes(trained, images)
        device = torch.device("cuda" if backend.name == "cuda" else "cpu")
        self._gaussians = trained.gaussians.to(device)

    def prepare_windows(self) -> None:
        """Sort the Gaussians for windows: a second for a million, which the first window would take otherwise."""
        _ = self._blocks

    @cached_property
    def _blocks(self) -> SpatialBlocks:
        return SpatialBlocks(self.trained.gaussians)

    def pinhole(self, index: int) -> Pinhole:
        """Return the pinhole of camera `index`, at the size of its render."""
        return self._pinholes.of(index)

    def render(self, index: int, *, depth: bool = False) -> Render:
        """Return the render of camera `index`, without gradients.

        Args:
            index: of the camera.
            depth: render depths as well.
        """
        return self.render_from(self.pose(index), depth=depth)

    def pose(self, index: int) -> ViewPose:
        """Return the pose of camera `index`."""
        poses = self.trained.poses
        return ViewPose(self.pinhole(index), poses.cam_from_model[index], poses.cam_center_in_model[index])

    def render_from(self, pose: ViewPose, *, depth: bool = False, window: Window | None = None) -> Render:
        """Return the render of any camera, without gradients.

        Args:
            pose: of the camera.
            depth: render depths as well.
            window: part of the image to render; None: all of it.
        """
        model = self.trained.model
        matrix = pose_matrix(pose.cam_from_model, pose.center_in_model)
        settings = RasterSettings(model.sh_degree, model.background, depth=depth, window=window)
        gaussians = self._gaussians
        if window is not None:  # A pass over millions of Gaussians takes longer than the window itself.
            gaussians = self._blocks.shown(matrix, pose.pinhole, settings).to(gaussians.means.device)
        cam_from_model = torch.as_tensor(matrix, dtype=torch.float32, device=gaussians.means.device)
        with torch.no_grad():
            return self._backend.render(gaussians, cam_from_model, pose.pinhole, settings)

    def depth_m(self, index: int) -> FloatArray:
        """Return the depth (H, W) in metres of the surface along the z axis of camera `index`; 0: no surface."""
        return self.depth_from(self.pose(index))

    def depth_from(self, pose: ViewPose, window: Window | None = None) -> FloatArray:
        """Return the depth (H, W) in metres of the surface along the z axis of any camera; 0: no surface.

        Args:
            pose: of the camera.
            window: part of the image to render; None: all of it.
        """
        return np.asarray(_measured(self.render_from(pose, depth=True, window=window)).cpu().numpy())

    def surface(self, index: int) -> tuple[Float32Array, ByteArray]:
        """Return the depth (H, W) as `depth_m` does, and the colours (H, W, 3) of the same render."""
        view = self.render(index, depth=True)
        rgb = (255 * view.colour.clamp(0, 1)).round().to(torch.uint8)
        return _measured(view).cpu().numpy().astype(np.float32), rgb.cpu().numpy()


def _measured(view: Render) -> torch.Tensor:
    assert view.median_depth is not None and view.expected_depth is not None
    assert view.depth_variance is not None  # of every render with depth
    return measured_depth(view.median_depth, view.expected_depth, view.depth_variance)
