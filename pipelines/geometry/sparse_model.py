"""An SfM model as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import ByteArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, Lenses


@dataclass(frozen=True)
class SparseModel:
    """SfM model in its own frame `local`: n registered images, N points, M observations.

    Observations are sorted by point, then by image, so that the track of a point is one contiguous run.
    """

    cameras: dict[int, Camera]  # intrinsics by COLMAP's camera id
    image_id: IntArray  # (n,) COLMAP's ids, ascending
    image_name: tuple[str, ...]  # n names, relative to the image folder
    image_camera_id: IntArray  # (n,) keys of `cameras`
    rotation_cam_from_local: FloatArray  # (n, 3, 3)
    translation_cam_from_local: FloatArray  # (n, 3), in units of `local`
    point_id: IntArray  # (N,) COLMAP's ids, ascending
    point_in_local: FloatArray  # (N, 3)
    point_rgb: ByteArray  # (N, 3) uint8
    point_error_px: FloatArray  # (N,) mean reprojection error; NaN where the model does not state it
    obs_point: IntArray  # (M,) index into the points, ascending
    obs_image: IntArray  # (M,) index into the images
    obs_xy_px: FloatArray  # (M, 2) pixels, the centre of the top-left pixel being (0.5, 0.5)
    # (n, 3) motion of the cameras while their rows were read (`rolling_shutter.py`), by which the observations are
    # already corrected; None: none
    travel_in_cam: FloatArray | None = None

    @property
    def cam_center_in_local(self) -> FloatArray:
        """Projection centres (n, 3): −Rᵀ t."""
        return np.asarray(-np.einsum("nji,nj->ni", self.rotation_cam_from_local, self.translation_cam_from_local))

    @property
    def focal_px(self) -> FloatArray:
        """Focal length (n,) of each image, the mean of both axes."""
        return np.array([self.camera_of(image).mean_focal_px for image in range(len(self.image_name))])

    def image_index(self) -> dict[str, int]:
        return {name: index for index, name in enumerate(self.image_name)}

    def camera_of(self, image: int) -> Camera:
        return self.cameras[int(self.image_camera_id[image])]

    @property
    def lenses(self) -> Lenses:
        return Lenses(self.cameras, self.image_camera_id)

    def of_images(self, images: IntArray) -> SparseModel:
        """Return the model of some images (K,), in ascending order, with the points that two of them observe."""
        rows = np.unique(images)
        row_of = np.full(len(self.image_name), -1)
        row_of[rows] = np.arange(len(rows))
        in_image = row_of[self.obs_image] >= 0
        # Observations are sorted by point, then by image: an image may observe a point more than once.
        pairs = np.unique(np.column_stack([self.obs_point, self.obs_image])[in_image], axis=0)
        seen = np.bincount(pairs[:, 0], minlength=len(self.point_id)) >= 2
        kept = np.flatnonzero(in_image & seen[self.obs_point])
        points = np.flatnonzero(seen)
        return replace(
            self,
            image_id=self.image_id[rows],
            image_name=tuple(self.image_name[row] for row in rows),
            image_camera_id=self.image_camera_id[rows],
            rotation_cam_from_local=self.rotation_cam_from_local[rows],
            translation_cam_from_local=self.translation_cam_from_local[rows],
            point_id=self.point_id[points],
            point_in_local=self.point_in_local[points],
            point_rgb=self.point_rgb[points],
            point_error_px=self.point_error_px[points],
            obs_point=np.searchsorted(points, self.obs_point[kept]),
            obs_image=row_of[self.obs_image[kept]],
            obs_xy_px=self.obs_xy_px[kept],
            travel_in_cam=None if self.travel_in_cam is None else self.travel_in_cam[rows],
        )
