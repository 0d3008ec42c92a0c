"""Interface of every rasteriser: Gaussians and a camera in; colour, alpha and depth out, all differentiable.

The blending is that of 3D Gaussian Splatting (doi 10.1145/3592433), with gsplat's conventions:

1. Pixel centres lie at (0.5, 0.5).
2. The screen covariance C is dilated by `dilation_px2`. With `mip_filter`, the opacity is multiplied by
   √(|C| / |C dilated|), so that a Gaussian of less than a pixel keeps its light (the 2-D filter of Mip-Splatting,
   doi 10.1109/CVPR52733.2024.01839).
3. Contributions below alpha 1/255 are left out, and alpha is at most 0.999.
4. A pixel is done when its transmittance would fall to 1e-4.
5. Gaussians are ordered by the depth of their centres.

The depth of a Gaussian is the depth of its plane at the pixel, not of its centre:

1. The depth is the conditional mean of z given the pixel, z + q · (p − µ) with q = C⁻¹ c. C is the screen
   covariance, and c the covariance of the screen position with z (RaDe-GS, doi 10.48550/arXiv.2406.01467, in the
   local affine approximation of the perspective).
2. C is dilated by `SLOPE_DILATION` of the image's dilation only. With all of it, a disc on a slanted wall that is
   narrower than a pixel would keep the depth of its centre. Nearer discs hide those behind them, so that the wall
   would seem too near.
3. If the depth departed from that of the centre by more than `DEPTH_REACH` of it, anywhere down to α = 1/255, q is
   shortened, so that z stays positive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
DEPTH_REACH = 0.75
SLOPE_DILATION = 0.1  # not 0: the slope of a disc seen from its edge is infinite

BackendName = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class Window:
    """Part of an image, in whole pixels: `left` columns and `top` rows of the image lie before it."""

    left: int
    top: int
    width: int
    height: int

    def of(self, camera: Pinhole) -> Pinhole:
        """Return the camera whose image is the window."""
        return Pinhole(self.width, self.height, camera.fx, camera.fy, camera.cx - self.left, camera.cy - self.top)

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)

    def cut(self, view: Render) -> Render:
        """Return the part of a render of the whole image; its statistics stay those of the whole."""
        depths = (view.expected_depth, view.depth_variance, view.median_depth)
        parts = (None if image is None else image[self.slices] for image in (*depths, view.normal))
        return Render(view.colour[self.slices], view.alpha[self.slices], view.stats, *parts)


@dataclass(frozen=True)
class RasterSettings:
    """Settings of a render."""

    sh_degree: int = 3  # of the spherical harmonics in use (≤ the stored degree)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near_m: float = 0.05  # Gaussians with a nearer centre are left out
    dilation_px2: float = 0.3  # added to the diagonal of the screen covariance, in px²
    mip_filter: bool = False  # whether the opacity makes up for the dilation
    depth: bool = False  # colour and alpha are always computed
    normal: bool = False
    median: bool = True  # depth; training needs none, and on a GPU it costs more than all the rest
    window: Window | None = None  # part of the camera's image that is rendered; None: all of it

    def image_of(self, camera: Pinhole) -> Pinhole:
        return camera if self.window is None else self.window.of(camera)


@dataclass
class ScreenStats:
    """Statistics of one render for density control."""

    visible: Tensor  # (M,) int64 rows of the Gaussians that touched the image
    mean_gradient: Tensor | None = None  # (M, 2) float32, ∂L/∂(projected centre) in 1/px; set by the backward pass
    counted: Tensor | None = None  # (M,) bool, False where other parts of the image count it; None: all True

    def of_first(self, count: int) -> ScreenStats:
        """Return the statistics of the first `count` Gaussians of a render."""
        rows = self.visible < count
        gradient = None if self.mean_gradient is None else self.mean_gradient[rows]
        counted = None if self.counted is None else self.counted[rows]
        return ScreenStats(self.visible[rows], gradient, counted)

    def among(self, rows: Tensor | None) -> ScreenStats:
        """Return the statistics of a render of some Gaussians with their `rows` among all; None: these are all."""
        return self if rows is None else replace(self, visible=rows[self.visible])

    def of_part(self, share: float, counted: Tensor | None = None) -> ScreenStats:
        """Return the statistics of a part of an image, as what it adds to those of the whole image.

        The share multiplies the gradients. For the whole, the part counts the `counted` (M,); None: all.
        """
        gradient = None if self.mean_gradient is None else share * self.mean_gradient
        return ScreenStats(self.visible, gradient, counted)


@dataclass
class Render:
    """Rendered view of H × W pixels."""

    colour: Tensor  # (H, W, 3), linear in the Gaussians' colours, background blended in
    alpha: Tensor  # (H, W), 1 − final transmittance
    stats: ScreenStats  # for densification
    # (H, W), Σ w z / Σ w along the camera's z axis in metres, with each Gaussian's z at the pixel; 0 where alpha is
    # 0; or None
    expected_depth: Tensor | None = None
    # (H, W), Σ w z² / Σ w − expected_depth² in m²: 0 if all Gaussians of a pixel lie on one surface; or None
    depth_variance: Tensor | None = None
    # (H, W), z at the pixel of the Gaussian at which the transmittance falls to one half, 0 if the transmittance
    # stays higher; not differentiable; or None
    median_depth: Tensor | None = None
    # (H, W, 3), Σ w n in `model`, with n the unit vector along the shortest principal axis, towards the camera; or
    # None
    normal: Tensor | None = None


class Rasterizer(Protocol):
    """Rasteriser backend."""

    name: BackendName
    device: torch.device  # of the tensors that it takes and gives

    def render(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Render:
        """Render `gaussians` from `cam_from_model` (4, 4), differentiable in both."""

    def candidates(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Tensor | None:
        """Return the rows (M,) int64, ascending, of all Gaussians that may touch the image; None: unknown.

        A training that copies these has gradients of them alone.
        """
