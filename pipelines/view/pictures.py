"""Pictures of the viewer: renders of the trained model, with a photograph blended over them where one was taken.

The machine that holds the model draws them, with the rasteriser that trained it: what is seen is what is measured,
colours that depend on the direction included, and a page without a graphics card shows millions of Gaussians.

The viewer's depth images end at 167 units. Its frame is therefore a small copy of the scene around its middle, with
the axes of `geo`: east, north, up. Each page has a loop, which draws small pictures
while its camera moves, and a full one when it stands.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipelines.core.errors import GeorefError, InputError
from pipelines.core.plan import photograph_folder
from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Camera, Pinhole, ViewPose, distort, undistort
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity
from pipelines.splat.surface import measured_depth
from pipelines.surface.picking import Sight
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.trained_survey import TrainedSurvey

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

_RADIUS = 10.0  # of the scene, in units of the viewer
_RIM = 0.02  # share of the SfM points outside the scene, on each side
_KEPT_PHOTOGRAPHS = 3  # at full size, in memory
_SAME_PLACE = 1e-4  # of the scene's radius: a camera this near to a photograph's sees what it saw
_EDGE_POINTS = 9  # on each side of a photograph
_FARTHEST = 150.0  # units of the viewer, for what has no surface
_MOVING_S = 0.12  # of drawing one picture while the camera moves
_STILL_S = 0.2  # without movement until the full picture is drawn
_LEAST_PX, _MOST_PX = 160, 1920  # of the longer side
_DEPTH_PX = 480  # of the longer side of the depth: it only decides which overlays are hidden
_QUALITY_MOVING, _QUALITY_STILL = 70, 95  # of the JPEG


@dataclass(frozen=True)
class ViewerCamera:
    """Camera of a page, in the frame of the viewer."""

    wxyz: FloatArray  # (4,) rotation view ← camera; the camera's axes are x right, y down, z forward
    position: FloatArray  # (3,)
    fov_rad: float  # vertical field of view
    width: int  # of the page in pixels
    height: int  # likewise

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
    """Frame of the viewer, and the radius of the scene."""

    view_from_model: Similarity
    radius_m: float

    def pose(self, camera: ViewerCamera, width: int, height: int) -> ViewPose:
        """Return a page's camera in `model`, with its own number of pixels."""
        cam_from_model = camera.rotation.T @ self.view_from_model.rotation
        center = self.view_from_model.inverse().apply(camera.position[None])[0]
        return ViewPose(camera.pinhole(width, height), cam_from_model, center)

    def sight(self, camera: ViewerCamera, start: FloatArray, direction: FloatArray) -> Sight:
        """Return a line of sight in `model` of one in the viewer's frame: start (3,) and direction (3,)."""
        model_from_view = self.view_from_model.inverse()
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


@dataclass(frozen=True)
class PageView:
    """Picture (H, W, 3) of a page, and depth (H, W) along the camera's z axis, in units of the viewer."""

    rgb: ByteArray
    depth: Float32Array


class Photographs:
    """Photographs of the survey at full size, decoded on demand."""

    def __init__(self, workspace: Workspace, trained: TrainedSurvey) -> None:
        self._folder = photograph_folder(workspace, trained.survey.image_dir)
        self._trained = trained
        self.full = lru_cache(_KEPT_PHOTOGRAPHS)(self._decoded)

    def _decoded(self, camera: int) -> ByteArray:
        """Return a photograph (H, W, 3) with its distortion; an InputError: unreadable, or not of the survey."""
        name = self._trained.sparse.image_name[camera]
        file = self._folder / name
        sha256 = {image.name: image.sha256 for image in self._trained.survey.images}
        pixels = decoded_photograph(file, sha256.get(name, ""))
        lens = self._trained.sparse.camera_of(camera)
        if pixels is None or pixels.shape[:2] != (lens.height, lens.width):
            raise InputError(
                "photograph-damaged",
                "cannot be decoded, or has another size than its camera. Restore the photograph.",
                path=file,
            )
        return np.ascontiguousarray(pixels[..., ::-1])


@dataclass(frozen=True)
class Blend:
    """Photograph over the picture: a camera of the trained model, and its share 0 … 1."""

    camera: int
    share: float


class Painter:
    """Painter of the pictures of pages."""

    def __init__(self, renderer: ModelRenderer, photographs: Photographs, frame: ViewFrame) -> None:
        self._renderer, self._photographs, self._frame = renderer, photographs, frame

    def paint(self, camera: ViewerCamera, width: int, height: int, blend: Blend | None = None) -> PageView:
        """Return the picture of a page's camera; a photograph blended over it shows only from its own place.

        Raises:
            InputError: the photograph cannot be read.
        """
        pose = self._frame.pose(camera, width, height)
        render = self._renderer.render(pose, depth=True)
        depth = measured_depth(render).cpu().numpy()
        rgb = (255 * render.colour.clamp(0, 1)).round().byte().cpu().numpy()
        scaled = depth * self._frame.view_from_model.scale
        if blend is not None and blend.share > 0:
            apart = self._renderer.trained.poses.cam_center_in_model[blend.camera] - pose.center_in_model
            if float(np.linalg.norm(apart)) < _SAME_PLACE * self._frame.radius_m:
                rgb = self._blended(rgb, blend, pose)
        return PageView(rgb, np.where(scaled > 0, np.minimum(scaled, _FARTHEST), _FARTHEST).astype(np.float32))

    def _blended(self, rgb: ByteArray, blend: Blend, pose: ViewPose) -> ByteArray:
        """Return a picture with the photograph over it, as the photograph's lens shows the picture's rays."""
        trained = self._renderer.trained
        height, width = rgb.shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        turn = trained.poses.cam_from_model[blend.camera] @ pose.cam_from_model.T
        own = pose.pinhole.rays(pixels) @ turn.T
        ahead = own[..., 2] > 0
        slope = own[..., :2] / np.where(ahead, own[..., 2], 1.0)[..., None]
        lens = trained.sparse.camera_of(blend.camera)
        place = np.asarray(distort(lens, slope)) - 0.5
        # Beyond its fold a lens polynomial leads back into the picture, to the pixel of another ray.
        ahead &= np.linalg.norm(slope, axis=-1) < _widest_slope(lens)
        inside = ahead & ((place > -0.5) & (place < np.array([lens.width, lens.height]) - 0.5)).all(axis=-1)
        source = np.where(inside[..., None], place, -1.0).astype(np.float32)
        full = self._photographs.full(blend.camera)
        photograph = cv2.remap(full, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
        share = np.where(inside, blend.share, 0.0)[..., None]
        return np.asarray(np.round(share * photograph + (1 - share) * rgb), dtype=np.uint8)


def _widest_slope(lens: Camera) -> float:
    """Return the largest tangent of the angle between the axis and a ray to the edge of the photograph."""
    across, down = np.linspace(0, lens.width, _EDGE_POINTS), np.linspace(0, lens.height, _EDGE_POINTS)
    edge = [(x, y) for x in across for y in (0, lens.height)] + [(x, y) for x in (0, lens.width) for y in down]
    return float(np.nanmax(np.linalg.norm(undistort(lens, edge), axis=-1))) * (1 + 1e-3)


class PictureLoop:
    """Loop of one page, on a thread of its own.

    Args:
        blend: returns the photograph to blend over the picture, or None.
        drawn: called after each picture at full size.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        painter: Painter,
        blend: Callable[[], Blend | None],
        drawn: Callable[[], None],
    ) -> None:
        self._client, self._painter, self._blend, self._told = client, painter, blend, drawn
        self.changed, self._ended = threading.Event(), threading.Event()
        self._moving_px = 480.0
        self.drawn = 0  # pictures at full size
        self._thread = threading.Thread(target=self._run, daemon=True)
        client.camera.on_update(lambda _: self.changed.set())
        self._thread.start()
        self.changed.set()

    def end(self) -> None:
        self._ended.set()
        self.changed.set()

    def _run(self) -> None:
        while True:
            self.changed.wait()
            if self._ended.is_set():
                return
            self.changed.clear()
            try:
                began = time.monotonic()
                self._draw(int(self._moving_px), _QUALITY_MOVING)
                factor = np.clip(np.sqrt(_MOVING_S / max(time.monotonic() - began, 1e-3)), 0.5, 1.3)
                self._moving_px = float(np.clip(self._moving_px * factor, _LEAST_PX, _MOST_PX))
                if not self.changed.wait(_STILL_S):
                    self._draw(_MOST_PX, _QUALITY_STILL)
                    self.drawn += 1
                    self._told()
            except GeorefError as error:
                self._client.add_notification("No picture", str(error), color="red")
            except Exception:  # the page is gone, or the picture cannot be drawn: the next one may
                if self._ended.is_set():
                    return
                log.exception("the picture could not be drawn")

    def _draw(self, longer_px: int, quality: int) -> None:
        camera = camera_of(self._client)
        if camera is None:
            return
        width, height = _shrunk(camera.width, camera.height, longer_px)
        picture = self._painter.paint(camera, width, height, self._blend())
        depth = cv2.resize(picture.depth, _shrunk(width, height, _DEPTH_PX), interpolation=cv2.INTER_NEAREST)
        self._client.scene.set_background_image(picture.rgb, format="jpeg", jpeg_quality=quality, depth=depth)
        self._client.flush()


def camera_of(client: viser.ClientHandle) -> ViewerCamera | None:
    """Return the camera of a page; None before the page has told it."""
    handle = client.camera
    if handle._state.update_timestamp == 0.0 or not handle.image_width or not handle.image_height:
        return None
    return ViewerCamera(
        np.array(handle.wxyz), np.array(handle.position), float(handle.fov), handle.image_width, handle.image_height
    )


def _shrunk(width: int, height: int, longer_px: int) -> tuple[int, int]:
    """Return the size of a picture whose longer side is at most `longer_px`."""
    scale = min(1.0, longer_px / max(width, height))
    return max(round(width * scale), 1), max(round(height * scale), 1)
