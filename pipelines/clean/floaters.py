"""Floaters: Gaussians where no surface is, by their place, and by what photographs say against them.

1. A Gaussian lies before the surface if views measure the surface clearly behind it, and hardly any beside it. The
   surface is that of depth maps of the photographs themselves: an opaque floater does not hide it, as it would in
   a render of the model.
2. A Gaussian is isolated if its neighbours are far away, for its own size and for the scene.

Neither alone tells a floater: stereo misses wires, and the sky is far from everything. Photographs contradict a
Gaussian if their error grows with its opacity. A pixel's colour is linear in the opacity of each Gaussian, so that
the derivative of the squared error by the opacity tells which part of the error grows with it. Training brings that
to zero where a Gaussian is in its place.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import KDTree
from torch import Tensor

from pipelines.core.machine import thread_count
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray, Float32Array, FloatArray
from pipelines.geometry.cameras import ViewPose, pose_matrix
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.statistics import NORMAL_MAD
from pipelines.splat.densify import view_contributions
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.surface.photometry import photograph_and_mask, through_lens
from pipelines.surface.surface_views import ModelRenderer

# σ of a measured depth, as a part of it: views of one surface agree within 2 % (`agreement.FREE`), which is 4 σ.
SIGMA_DEPTH = 0.005
LEAST_VIEWS = 3  # that look through a Gaussian: two do not check each other
_MOST_BESIDE = 0.25  # views whose surface is beside it, as a part of those that look through it
_WINDOW_PX = 3  # in which the surface is looked for: edges of depth maps are a pixel wide
NEIGHBOURS = 8  # a floater may be made of so many Gaussians
# Largest σ of a Gaussian to the distance of its farthest neighbour: at 6, none of them touches it.
_OWN_SIZES = 6.0
_ISOLATED_SIGMAS = 4.0  # of the logarithm of those distances, above their median


@dataclass(frozen=True)
class MeasuredView:
    """Depth map (H, W) along the optical axis of a view, metres in `model`; 0: nothing was measured."""

    pose: ViewPose
    depth_m: Float32Array


def before_surface(gaussians: Gaussians, views: Iterable[MeasuredView], sigmas: float) -> BoolArray:
    """Return which Gaussians (N,), on the CPU, lie before the measured surface by more than a number of σ.

    σ is that of the surface's depth and that of the Gaussian along the ray: a large one touches what is behind.
    """
    center = gaussians.means.double().numpy()
    principal = matrix_from_quat_xyzw(np.roll(gaussians.quats_wxyz.numpy(), -1, axis=1)).astype(np.float32)
    axes = principal * np.exp(gaussians.log_scales.numpy())[:, None, :]
    through, beside = np.zeros((2, len(center)), dtype=np.int32)
    for view in views:
        pinhole = view.pose.pinhole
        in_cam = (center - view.pose.center_in_model) @ view.pose.cam_from_model.T
        ahead = np.flatnonzero(in_cam[:, 2] > 0)
        xy_px = pinhole.project(in_cam[ahead])
        rows = ahead[pinhole.contains(xy_px)]
        if not len(rows):
            continue
        column, row = pinhole.project(in_cam[rows]).astype(np.int64).T
        known = view.depth_m > 0
        nearest = minimum_filter(np.where(known, view.depth_m, np.inf), _WINDOW_PX)[row, column]
        farthest = maximum_filter(np.where(known, view.depth_m, 0.0), _WINDOW_PX)[row, column]
        depth = in_cam[rows, 2]
        ray = (center[rows] - view.pose.center_in_model) / np.linalg.norm(in_cam[rows], axis=1)[:, None]
        along = np.linalg.norm(np.einsum("nij,ni->nj", axes[rows], ray), axis=1)
        along *= depth / np.linalg.norm(in_cam[rows], axis=1)  # along the optical axis, as the depths are
        reach = sigmas * np.hypot(SIGMA_DEPTH * depth, along)
        measured = known[row, column]
        behind = measured & (nearest - depth > reach)
        through[rows] += behind
        beside[rows] += measured & ~behind & (depth - farthest <= reach)
    return np.asarray((through >= LEAST_VIEWS) & (beside <= _MOST_BESIDE * through))


def isolated(center_in_model: FloatArray | Float32Array, sigma_m: FloatArray | Float32Array) -> BoolArray:
    """Return which Gaussians (N,) are far from their neighbours, given their centres (N, 3) and largest σ (N,)."""
    if len(center_in_model) <= NEIGHBOURS:
        return np.zeros(len(center_in_model), dtype=bool)
    tree = KDTree(center_in_model)
    distance, _ = tree.query(center_in_model, k=[NEIGHBOURS + 1], workers=thread_count())
    away = np.log(np.maximum(distance[:, 0], 1e-9))
    middle = np.median(away)
    usual = middle + _ISOLATED_SIGMAS * NORMAL_MAD * np.median(np.abs(away - middle))
    return np.asarray((away > usual) & (distance[:, 0] > _OWN_SIZES * sigma_m))


@dataclass(frozen=True)
class Evidence:
    """Sums over views and their pixels, for N Gaussians.

    Attributes:
        weight_px: (N,) of the blending weights.
        error: (N,) of the opacity times the derivative of the squared error of the three colours by it.
    """

    weight_px: Float32Array
    error: Float32Array

    @property
    def mean_error(self) -> Float32Array:
        """Return the error (N,) of a pixel that a Gaussian fills; 0: no view shows it."""
        return np.asarray(self.error / np.maximum(self.weight_px, 1e-3), dtype=np.float32)


def evidence_of(renderer: ModelRenderer, backend: Rasterizer, views: list[int], progress: Progress) -> Evidence:
    """Return the evidence of views, by their indices; an InputError: a photograph cannot be read."""
    gaussians = renderer.gaussians.to(backend.device)
    weight, error = torch.zeros(2, len(gaussians), device=backend.device)
    with progress.task("evidence of the views", len(views)) as task:
        for index in views:
            pose, camera = _pose(renderer, index).to(backend.device), renderer.images.pinhole(index)
            none = torch.zeros(camera.height, camera.width, device=backend.device)
            weight += view_contributions(gaussians, pose, camera, none, backend).weight_px
            error += _error_by_opacity(renderer, backend, index, pose)
            task.advance()
    return Evidence(weight.cpu().numpy(), error.cpu().numpy())


def _pose(renderer: ModelRenderer, index: int) -> Tensor:
    pose = renderer.pose(index)
    return torch.from_numpy(pose_matrix(pose.cam_from_model, pose.center_in_model)).float()


def _error_by_opacity(renderer: ModelRenderer, backend: Rasterizer, index: int, pose: Tensor) -> Tensor:
    """Return opacity times the derivative of the squared error by it (N,), of one view."""
    model = renderer.model
    gaussians = renderer.gaussians.to(backend.device).detached()
    gaussians.logit_opacities = gaussians.logit_opacities.clone().requires_grad_()
    photo, mask = (values.to(backend.device) for values in photograph_and_mask(renderer, index))
    settings = RasterSettings(model.sh_degree, model.background)
    with torch.enable_grad():
        render = backend.render(gaussians, pose, renderer.images.pinhole(index), settings)
        difference = through_lens(renderer, index, render.colour) - photo
        error = (difference.square().sum(dim=2) * mask).sum()
        (by_logit,) = torch.autograd.grad(error, gaussians.logit_opacities)
    # ∂o/∂logit = o (1 − o)
    return by_logit / (1 - torch.sigmoid(gaussians.logit_opacities.detach())).clamp_min(1e-3)
