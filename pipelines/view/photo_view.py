"""A photograph in the page: the page's camera stands where it was taken, and a click on it is a pixel of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import rotation_towards
from pipelines.survey.trained_survey import TrainedSurvey
from pipelines.view.overlays import Overlays, wxyz_of
from pipelines.view.pictures import Blend, ViewFrame

if TYPE_CHECKING:
    import viser

_CLOSER = 0.2  # of the field of view, after a click that comes closer
_NEAR = 0.5  # units of the viewer before the camera, where crosses stand: nothing hides them there
_CROSS = 0.012  # of the field of view
_MARK_RGB, _EXPECTED_RGB, _LINE_RGB = (230, 60, 0), (0, 160, 255), (255, 210, 0)
_SAME = 1e-4  # units of the viewer


class PhotoView:
    """Photograph that the pages show.

    Args:
        overlays: of the scene, hidden while a photograph is shown.
        changed: called when the pictures of the pages must be drawn anew.

    Attributes:
        camera: whose photograph is shown; None: none.
        share: of the photograph in the picture, 0 … 1.
        reach_m: length of the lines of sight that are drawn.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        trained: TrainedSurvey,
        frame: ViewFrame,
        overlays: Overlays,
        changed: Callable[[], None],
    ) -> None:
        self._server, self._trained, self._frame, self._overlays = server, trained, frame, overlays
        self._changed = changed
        self.reach_m = 20 * frame.radius_m
        self.camera: int | None = None
        self.share = 1.0
        self._is_close = False

    @property
    def blend(self) -> Blend | None:
        """Photograph to blend over the pictures."""
        return None if self.camera is None else Blend(self.camera, self.share)

    def show(self, camera: int) -> None:
        """Show a photograph whole: all pages fly there."""
        self.camera, self._is_close = camera, False
        self._overlays.hide_all(hidden=True)  # they would cover what is to be marked
        for client in self._server.get_clients().values():
            self._stand(client, None, self._whole_fov(client, camera))
        self._changed()

    def whole(self) -> None:
        """Show the photograph whole again."""
        if self.camera is not None:
            self.show(self.camera)

    def leave(self) -> None:
        """Show no photograph any more."""
        self.camera = None
        self._overlays.hide_all(hidden=False)
        self._clear()
        self._changed()

    def is_at(self, client: viser.ClientHandle) -> bool:
        """Return whether a page still stands where the photograph was taken."""
        return self.camera is not None and bool(
            np.linalg.norm(np.array(client.camera.position) - self._center(self.camera)) < _SAME
        )

    def in_cam(self, direction_in_view: FloatArray) -> FloatArray:
        """Return a direction (3,) of the viewer's frame in the camera of the photograph."""
        assert self.camera is not None
        turn = self._trained.poses.cam_from_model[self.camera] @ self._frame.view_from_model.rotation.T
        return np.asarray(turn @ direction_in_view)

    def come_closer(self, client: viser.ClientHandle, direction_in_view: FloatArray) -> bool:
        """Look closely at a place of the photograph; False: the page already does."""
        if self._is_close or self.camera is None:
            return False
        self._is_close = True
        self._stand(client, direction_in_view, self._whole_fov(client, self.camera) * _CLOSER)
        self._changed()
        return True

    def draw(self, mark: FloatArray | None, expected: FloatArray | None, lines: list[FloatArray]) -> None:
        """Draw the mark and the expected place, directions (3,) or None, and epipolar lines (2, 3) in `model`."""
        self._clear()
        if self.camera is None:
            return
        for name, direction, rgb in (("mark", mark, _MARK_RGB), ("expected", expected, _EXPECTED_RGB)):
            if direction is not None:
                self._cross(f"/photo/{name}", direction, rgb, diagonal=name == "mark")
        if lines:
            segments = self._frame.view_from_model.apply(np.array(lines))
            self._server.scene.add_line_segments(
                "/photo/lines", segments, _LINE_RGB, thickness=1.5, thickness_units="screen"
            )

    def _cross(self, name: str, direction: FloatArray, rgb: tuple[int, int, int], *, diagonal: bool) -> None:
        assert self.camera is not None
        middle = _NEAR * direction / np.linalg.norm(direction)
        lens = self._trained.sparse.camera_of(self.camera)
        arm = _NEAR * _CROSS * (_CLOSER if self._is_close else 1.0) * lens.height / lens.mean_focal_px
        upright = ((arm * 1.4, 0.0, 0.0), (0.0, arm * 1.4, 0.0))
        arms = np.array(((arm, arm, 0.0), (arm, -arm, 0.0)) if diagonal else upright)
        in_cam = np.stack([middle - arms, middle + arms], axis=1)
        turn = self._frame.view_from_model.rotation @ self._trained.poses.cam_from_model[self.camera].T
        segments = in_cam @ turn.T + self._center(self.camera)
        self._server.scene.add_line_segments(name, segments, rgb, thickness=2.0, thickness_units="screen")

    def _clear(self) -> None:
        for name in ("mark", "expected", "lines"):
            self._server.scene.remove_by_name(f"/photo/{name}")

    def _center(self, camera: int) -> FloatArray:
        center = self._trained.poses.cam_center_in_model[camera]
        return np.asarray(self._frame.view_from_model.apply(center[None])[0])

    def _whole_fov(self, client: viser.ClientHandle, camera: int) -> float:
        """Return the vertical field of view in which a page shows a whole photograph."""
        lens = self._trained.sparse.camera_of(camera)
        aspect = max(client.camera.aspect, 0.1)
        upright = max(lens.height, lens.width / aspect)
        return 2 * float(np.arctan(upright / 2 / lens.mean_focal_px)) * 1.04

    def _stand(self, client: viser.ClientHandle, direction_in_view: FloatArray | None, fov_rad: float) -> None:
        """Put a page's camera where the photograph was taken, looking along a direction, or as the camera did."""
        assert self.camera is not None
        cam_from_view = self._trained.poses.cam_from_model[self.camera] @ self._frame.view_from_model.rotation.T
        if direction_in_view is not None:
            toward = cam_from_view @ (direction_in_view / np.linalg.norm(direction_in_view))
            cam_from_view = _nearest_turn(toward) @ cam_from_view
        with client.atomic():
            client.camera.position = self._center(self.camera)
            client.camera.wxyz = wxyz_of(cam_from_view.T)
            client.camera.fov = fov_rad


def _nearest_turn(toward: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that brings a unit vector onto the z axis by the shortest way."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(toward, z), float(toward @ z)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else rotation_towards(toward)
    x, y, w = axis / sine
    cross = np.array([[0, -w, y], [w, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * cross @ cross)
