"""Photographs with known cameras, as stereo compares them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import Float32Array, FloatArray
from pipelines.geometry.cameras import Pinhole


@dataclass(frozen=True)
class StereoCamera:
    """Undistorted camera in a metric frame `world`.

    Attributes:
        pinhole: of H × W pixels.
        cam_from_world: (3, 3) rotation.
        center_in_world: (3,).
    """

    pinhole: Pinhole
    cam_from_world: FloatArray
    center_in_world: FloatArray

    def rays(self) -> FloatArray:
        """Return viewing rays (H, W, 3) in `world`, of length one along the optical axis."""
        x, y = np.meshgrid(np.arange(self.pinhole.width) + 0.5, np.arange(self.pinhole.height) + 0.5)
        return np.asarray(self.pinhole.rays(np.stack([x, y], axis=-1)) @ self.cam_from_world)


@dataclass(frozen=True)
class StereoView:
    """Photograph with its camera.

    Attributes:
        camera: of H × W pixels.
        grey: (H, W), 1 … 256; 0 outside the photograph's valid part.
    """

    camera: StereoCamera
    grey: Float32Array


def opencv_camera_matrix(camera: Pinhole) -> FloatArray:
    """Return the camera matrix (3, 3) with pixels counted from the centre of the first, as OpenCV does."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
