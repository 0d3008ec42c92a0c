"""Frame of the viewer, and cameras in it.

The viewer's depth images end at 167 units. Its frame is therefore a small copy of the scene around its middle, with
the axes of `geo`: east, north, up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity
from pipelines.scene.renderer import ViewPose
from pipelines.scene.trained_survey import TrainedSurvey
from pipelines.view.surface_points import Sight

_RADIUS = 10.0  # of the scene, in units of the viewer
_RIM = 0.02  # share of the SfM points outside the scene, on each side


@dataclass(frozen=True)
class ViewerCamera:
    """Camera of a page, in the frame of the viewer.

    Attributes:
        wxyz: (4,) rotation view ← camera; the camera's axes are x right, y down, z forward.
        position: (3,).
        fov_rad: vertical field of view.
        width, height: of the page in pixels.
    """

    wxyz: FloatArray
    position: FloatArray
    fov_rad: float
    width: int
    height: int

    @property
    def rotation(self) -> FloatArray:
        """Rotation (3, 3) view ← camera."""
        w, x, y, z = self.wxyz
        return matrix_from_quat_xyzw([x, y, z, w])

    def pinhole(self, width: int, height: int) -> Pinhole:
        """Return the camera with another number of pixels."""
        focal = height / 2 / np.tan(self.fov_rad / 2)
        return Pinhole(width, height, focal, focal, width / 2, height / 2)


@dataclass(frozen=True)
class ViewFrame:
    """Frame of the viewer.

    Attributes:
        view_from_model: similarity.
        radius_m: of the scene.
    """

    view_from_model: Similarity
    radius_m: float

    @property
    def model_from_view(self) -> Similarity:
        """Similarity back."""
        return self.view_from_model.inverse()

    def pose(self, camera: ViewerCamera, width: int, height: int) -> ViewPose:
        """Return a page's camera in `model`, with its own number of pixels."""
        cam_from_model = camera.rotation.T @ self.view_from_model.rotation
        center = self.model_from_view.apply(camera.position[None])[0]
        return ViewPose(camera.pinhole(width, height), cam_from_model, center)

    def sight(self, camera: ViewerCamera, start: FloatArray, direction: FloatArray) -> Sight:
        """Return a line of sight in `model` of one in the viewer's frame: start (3,) and direction (3,)."""
        model_from_view = self.model_from_view
        turned = model_from_view.rotation @ direction
        pixel_rad = 1.0 / camera.pinhole(camera.width, camera.height).fx
        return Sight(model_from_view.apply(start[None])[0], turned / np.linalg.norm(turned), pixel_rad)


def frame_of(trained: TrainedSurvey) -> ViewFrame:
    """Return the frame of a trained survey's scene: its SfM points without the rim, or its cameras without any."""
    points = trained.point_in_model if len(trained.point_in_model) else trained.poses.cam_center_in_model
    in_geo = trained.geo_from_model.apply(points)
    low, high = np.quantile(in_geo, [_RIM, 1 - _RIM], axis=0)
    radius_m = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    view_from_geo = Similarity(_RADIUS / radius_m, np.eye(3), -(low + high) / 2 * _RADIUS / radius_m)
    return ViewFrame(view_from_geo @ trained.geo_from_model, radius_m)
