"""Load of a survey's parts, predicted from the SfM points before any photograph is read.

The Gaussians that a surface needs grow with the pixels in which photographs show it, and a block's memory and time
with the Gaussians that its views show (doi 10.48550/arXiv.2510.01767).

1. Each photograph is divided into a grid. The points observed in one of its cells share the pixels of the cell, so
   that a richly textured wall weighs no more than the meadow before it.
2. A point's surface is the mean of its pixels over the photographs that observe it: the size of the surface that it
   stands for, in pixels.
3. The Gaussians of the whole are shared out among the points by their surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.scene.block_plan import BlockCell
from pipelines.scene.scene import Scene

_COLUMNS, _ROWS = 16, 12
# Observations beyond this number add nothing to shares of a block, but gigabytes: points are left out evenly.
_MOST_OBSERVATIONS = 6_000_000


@dataclass(frozen=True)
class ObservedSurface:
    """P points of the surface, and their M observations in n training images.

    Attributes:
        point_in_model: (P, 3) metres.
        surface: (P,) share of the survey's surface that each point stands for; sum 1.
        obs_point: (M,) index of the point.
        obs_image: (M,) index of the image.
        obs_share: (M,) share of the image that the observation stands for; sum 1 in each image with observations.
    """

    point_in_model: FloatArray
    surface: FloatArray
    obs_point: IntArray
    obs_image: IntArray
    obs_share: FloatArray

    def share_in_views(self, inside: BoolArray, images: int) -> FloatArray:
        """Return the share (n,) of each image that shows the points of a mask (P,), 0 … 1."""
        rows = inside[self.obs_point]
        return np.bincount(self.obs_image[rows], self.obs_share[rows], minlength=images).astype(np.float64)

    def share_of(self, cell: BlockCell) -> float:
        """Return the share of the survey's surface in a cell, 0 … 1."""
        return float(self.surface[cell.contains(self.point_in_model)].sum())


def observed_surface(scene: Scene, most_observations: int = _MOST_OBSERVATIONS) -> ObservedSurface:
    """Return the surface that the training images of a scene observe.

    Args:
        scene: cameras and SfM points.
        most_observations: number of observations beyond which points are left out evenly.
    """
    sparse = scene.sparse
    step = -(-len(sparse.obs_point) // most_observations)
    is_train = np.zeros(len(sparse.image_name), dtype=bool)
    is_train[scene.train] = True
    rows = np.flatnonzero((sparse.obs_point % step == 0) & is_train[sparse.obs_image])
    image, xy = sparse.obs_image[rows], sparse.obs_xy_px[rows]
    sizes = np.array([(camera.width, camera.height) for camera in sparse.cameras.values()], dtype=np.float64)
    keys = {key: place for place, key in enumerate(sparse.cameras)}
    size = sizes[np.array([keys[int(key)] for key in sparse.image_camera_id])][image]
    column = np.clip((xy[:, 0] / size[:, 0] * _COLUMNS).astype(np.int64), 0, _COLUMNS - 1)
    row = np.clip((xy[:, 1] / size[:, 1] * _ROWS).astype(np.int64), 0, _ROWS - 1)
    grid_cell = (image * _ROWS + row) * _COLUMNS + column
    in_cell = np.bincount(grid_cell, minlength=len(sparse.image_name) * _ROWS * _COLUMNS)
    occupied = (in_cell.reshape(len(sparse.image_name), -1) > 0).sum(axis=1)
    pixels = 1.0 / in_cell[grid_cell]  # in cells of the grid
    kept, place = np.unique(sparse.obs_point[rows], return_inverse=True)
    surface = np.bincount(place, pixels) / np.bincount(place)
    return ObservedSurface(
        point_in_model=scene.point_in_model[kept],
        surface=surface / surface.sum(),
        obs_point=place,
        obs_image=image,
        obs_share=pixels / occupied[image],
    )
