"""Surface losses of a view: settings, schedule and data of the losses in `splat.surface`."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, Render
from pipelines.splat.surface import (
    ObservedPoints,
    SurfaceSettings,
    compactness_loss,
    depth_loss,
    flatness_loss,
    normal_loss,
)
from pipelines.train.surface import GaussianLoss
from pipelines.train.target_images import TargetImage


@dataclass(frozen=True)
class RenderedView:
    """Render of a training view, beside its photograph.

    Attributes:
        render: with depths.
        target: the photograph, or a window of it.
        pose: (4, 4) cam ← model.
        visible: (M,) rows of the visible Gaussians in training.
        points: that the photograph shows; None: unknown.
    """

    render: Render
    target: TargetImage
    pose: Tensor
    visible: Tensor
    points: ObservedPoints | None


@dataclass(frozen=True)
class SurfaceLosses:
    """Weighted sum of the surface losses.

    Attributes:
        settings: weights.
        extent_m: size of the scene.
        rasterizer: backend, for the render of the normals.
        gaussian_loss: further loss of the visible Gaussians; None: none.
        confined: whether only pixels of the mask show what is trained.
    """

    settings: SurfaceSettings
    extent_m: float
    rasterizer: Rasterizer
    gaussian_loss: GaussianLoss | None = None
    confined: bool = False

    def of(self, gaussians: Gaussians, view: RenderedView, iteration: int, iterations: int) -> Tensor:
        """Return the loss of a view, a scalar.

        The loss of a window is weighted such that the mean over all windows of a photograph is the loss of the
        photograph: by its pixels, or by its points.

        Args:
            gaussians: in training.
            view: their render.
            iteration: of the training, from 1.
            iterations: length of the training.
        """
        render, target, settings = view.render, view.target, self.settings
        loss = settings.flatness * flatness_loss(gaussians, view.visible, self.extent_m)
        if render.expected_depth is not None and render.depth_variance is not None:
            alpha = render.alpha if not self.confined or target.mask is None else render.alpha * target.mask
            spread = compactness_loss(render.expected_depth, render.depth_variance, alpha)
            loss = loss + target.part.weight * settings.compactness * spread
        if view.points is not None and render.expected_depth is not None:
            depth = depth_loss(render.expected_depth, render.alpha, view.points, view.pose, target.camera)
            loss = loss + _weight_by_points(view.points, view.pose, target) * settings.depth * depth
        if self.gaussian_loss is not None:
            loss = loss + self.gaussian_loss(gaussians, view.visible)
        if iteration > settings.normals_from * iterations and iteration % settings.normals_every == 0:
            normals = normal_loss(gaussians, view.pose, target.camera, self.rasterizer, settings.edge)
            loss = loss + target.part.weight * settings.normals_every * settings.normals * normals
        return loss


def _weight_by_points(points: ObservedPoints, pose: Tensor, target: TargetImage) -> Tensor | float:
    """Return the number of windows, times the share of the photograph's points that lie in this window."""
    if target.part.windows == 1:
        return 1.0
    in_cam = points.point_in_model @ pose[:3, :3].detach().T.to(points.point_in_model) + pose[:3, 3].detach()
    here, anywhere = (_inside(in_cam, camera).sum() for camera in (target.camera, target.whole))
    return target.part.windows * here / anywhere.clamp_min(1)


def _inside(in_cam: Tensor, camera: Pinhole) -> Tensor:
    """Return which of points (K, 3) in the camera frame lie in the image, as a mask (K,)."""
    z = in_cam[:, 2].clamp_min(1e-3)
    x, y = camera.fx * in_cam[:, 0] / z + camera.cx, camera.fy * in_cam[:, 1] / z + camera.cy
    return (in_cam[:, 2] > 1e-3) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
