"""An SfM model as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import ByteArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera
from pipelines.geometry.lens import Lenses


@dataclass(frozen=True)
class SparseModel:
    """SfM model in its own frame `local`: n registered images, N points, M observations.

    Observations are sorted by point, then by image, so that the track of a point is one contiguous run.

    Attributes:
        cameras: intrinsics by COLMAP's camera id.
        image_id: (n,) COLMAP's ids, ascending.
        image_name: n names, relative to the image folder.
        image_camera_id: (n,) keys of `cameras`.
        rotation_cam_from_local: (n, 3, 3).
        translation_cam_from_local: (n, 3), in units of `local`.
        point_id: (N,) COLMAP's ids, ascending.
        point_in_local: (N, 3).
        point_rgb: (N, 3) uint8.
        point_error_px: (N,) mean reprojection error; NaN where the model does not state it.
        obs_point: (M,) index into the points, ascending.
        obs_image: (M,) index into the images.
        obs_xy_px: (M, 2) pixels, the centre of the top-left pixel being (0.5, 0.5).
    """

    cameras: dict[int, Camera]
    image_id: IntArray
    image_name: tuple[str, ...]
    image_camera_id: IntArray
    rotation_cam_from_local: FloatArray
    translation_cam_from_local: FloatArray
    point_id: IntArray
    point_in_local: FloatArray
    point_rgb: ByteArray
    point_error_px: FloatArray
    obs_point: IntArray
    obs_image: IntArray
    obs_xy_px: FloatArray

    @property
    def cam_center_in_local(self) -> FloatArray:
        """Projection centres (n, 3): −Rᵀ t."""
        return np.asarray(-np.einsum("nji,nj->ni", self.rotation_cam_from_local, self.translation_cam_from_local))

    def image_index(self) -> dict[str, int]:
        """Return the index of each image by its name."""
        return {name: index for index, name in enumerate(self.image_name)}

    def camera_of(self, image: int) -> Camera:
        """Return the intrinsics of the image with that index."""
        return self.cameras[int(self.image_camera_id[image])]

    @property
    def lenses(self) -> Lenses:
        """Cameras of the images, whose parameters may change."""
        return Lenses(self.cameras, self.image_camera_id)

    def points_in(self, image: int) -> IntArray:
        """Return ascending indices (K,) of the points that are observed in the image with that index."""
        return np.unique(self.obs_point[self.obs_image == image])
