"""Camera in the form of the kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.reference import FRUSTUM_MARGIN


class View(NamedTuple):
    """Camera of the kernels: lengths in pixels, slopes x/z and y/z, near plane in metres.

    A standard deviation of 1 m at a depth of 1 m is at most `stretch_x` px wide and `stretch_y` px high.
    """

    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    slope_x_min: float
    slope_x_max: float
    slope_y_min: float
    slope_y_max: float
    near: float
    dilation: float
    stretch_x: float
    stretch_y: float


def make_view(camera: Pinhole, settings: RasterSettings, pose: FloatArray) -> View:
    """Return the kernels' form of `camera`; the Jacobian is taken no further out than its slopes, as in gsplat."""
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    slope_x_min, slope_x_max = -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x
    slope_y_min, slope_y_max = -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y
    # The norm of a rotation is 1. Derivatives vary all entries of the pose, however, and leave the rotations.
    norm = float(np.linalg.norm(pose[:, :3], 2))
    image = settings.image_of(camera)
    return View(
        width=float(image.width),
        height=float(image.height),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(image.cx),
        cy=float(image.cy),
        slope_x_min=slope_x_min,
        slope_x_max=slope_x_max,
        slope_y_min=slope_y_min,
        slope_y_max=slope_y_max,
        near=float(settings.near_m),
        dilation=float(settings.dilation_px2),
        stretch_x=camera.fx * norm * math.hypot(1.0, max(-slope_x_min, slope_x_max)),
        stretch_y=camera.fy * norm * math.hypot(1.0, max(-slope_y_min, slope_y_max)),
    )
