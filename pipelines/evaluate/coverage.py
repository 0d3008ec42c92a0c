"""Part of a test view that training views show as well: elsewhere the photograph tests nothing but the guess.

The ground of a pixel is where its ray meets the surface through the SfM points. What stands before it is not asked
for. The splat itself decides nothing here: no hole or floater in it excuses a pixel, and all configurations of a
comparison are tested on the same pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.footprints import PointSurface, ground_points
from pipelines.scene.renderer import ModelRenderer

ENOUGH_VIEWS = 2  # one ray alone gives no depth
_COLUMNS = 48  # across a view: neighbouring rays meet neighbouring ground


class TrainingCoverage:
    """Coverage of views by the training views.

    Args:
        renderer: knows cameras and poses of all views.
    """

    def __init__(self, renderer: ModelRenderer) -> None:
        self._renderer = renderer
        points = renderer.trained.point_in_model
        self._surface = PointSurface(points) if len(points) else None
        self._train = renderer.trained.indices("train")

    def covered(self, index: int) -> Tensor | None:
        """Return the mask (H, W) of the pixels of a view whose ground at least two training views show.

        None without SfM points. Pixels without ground, such as sky, are not covered.

        Args:
            index: of the view.
        """
        if self._surface is None:
            return None
        pose = self._renderer.pose(index)
        width, height = pose.pinhole.width, pose.pinhole.height
        columns = min(_COLUMNS, width)
        rows = max(1, round(columns * height / width))
        grid = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1).reshape(-1, 2)
        rays = pose.pinhole.rays(grid * [width / columns, height / rows]) @ pose.cam_from_model
        ground = ground_points(rays, pose.center_in_model, self._surface)
        enough = (self._views_of(ground, apart_from=index) >= ENOUGH_VIEWS).reshape(rows, columns)
        share = cv2.resize(enough.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        return torch.from_numpy(share >= 0.5)

    def _views_of(self, points: FloatArray, *, apart_from: int) -> IntArray:
        """Return the number (K,) of training views whose image holds each of the points (K, 3) in `model`."""
        count = np.zeros(len(points), dtype=np.int64)
        for index in self._train:
            if index == apart_from:
                continue
            pose = self._renderer.pose(index)
            in_cam = (points - pose.center_in_model) @ pose.cam_from_model.T
            count += pose.pinhole.holds(pose.pinhole.project(in_cam))
        return count
