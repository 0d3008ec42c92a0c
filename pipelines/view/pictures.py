"""Pictures of the viewer: renders of the trained model, with a photograph blended over them where one was taken.

The machine that holds the model draws them, with the rasteriser that trained it: what is seen is what is measured,
colours that depend on the direction included, and a page without a graphics card shows millions of Gaussians.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.image_file import read_bytes, require_unchanged
from pipelines.geometry.cameras import Camera, distort, undistort
from pipelines.scene.renderer import ModelRenderer
from pipelines.splat.depth import measured_depth
from pipelines.view.view_frame import ViewerCamera, ViewFrame

_KEPT_PHOTOGRAPHS = 3  # at full size, in memory
_SAME_PLACE = 1e-4  # of the scene's radius: a camera this near to a photograph's sees what it saw
_EDGE_POINTS = 9  # on each side of a photograph
_FARTHEST = 150.0  # units of the viewer, for what has no surface


@dataclass(frozen=True)
class Picture:
    """Picture of a page.

    Attributes:
        rgb: (H, W, 3).
        depth: (H, W) along the camera's z axis, in units of the viewer.
    """

    rgb: ByteArray
    depth: Float32Array


class Photographs:
    """Photographs of the survey at full size, decoded on demand.

    Args:
        workspace: names their folder.
        renderer: of the trained model.
    """

    def __init__(self, workspace: Workspace, renderer: ModelRenderer) -> None:
        self._folder = photograph_folder(workspace, renderer.trained.survey.image_dir)
        self._trained = renderer.trained
        self._kept: OrderedDict[int, ByteArray] = OrderedDict()
        self._lock = threading.Lock()

    def full(self, camera: int) -> ByteArray:
        """Return a photograph (H, W, 3) with its distortion.

        Raises:
            InputError: it cannot be read, or is not that of the survey.
        """
        with self._lock:
            if camera not in self._kept:
                self._kept[camera] = self._decoded(camera)
                while len(self._kept) > _KEPT_PHOTOGRAPHS:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(camera)
            return self._kept[camera]

    def _decoded(self, camera: int) -> ByteArray:
        name = self._trained.sparse.image_name[camera]
        image, file = self._trained.survey.image(name), self._folder / name
        data = read_bytes(file)
        require_unchanged(data, "" if image is None else image.sha256, file)
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        lens = self._trained.sparse.camera_of(camera)
        if pixels is None or pixels.shape[:2] != (lens.height, lens.width):
            raise InputError("the photograph cannot be read, or has another size than its camera", path=file)
        return np.ascontiguousarray(pixels[..., ::-1])


@dataclass(frozen=True)
class Blend:
    """Photograph over the picture: a camera of the trained model, and its share 0 … 1."""

    camera: int
    share: float


class Painter:
    """Painter of the pictures of pages.

    Args:
        renderer: of the trained model.
        photographs: of the survey.
        frame: of the viewer.
    """

    def __init__(self, renderer: ModelRenderer, photographs: Photographs, frame: ViewFrame) -> None:
        self._renderer, self._photographs, self._frame = renderer, photographs, frame

    def paint(self, camera: ViewerCamera, width: int, height: int, blend: Blend | None = None) -> Picture:
        """Return the picture of a page's camera.

        Args:
            camera: of the page.
            width, height: of the picture in pixels.
            blend: photograph to blend over it, which shows only from its own place.

        Raises:
            InputError: the photograph cannot be read.
        """
        pose = self._frame.pose(camera, width, height)
        render = self._renderer.render_from(pose, depth=True)
        assert render.median_depth is not None and render.expected_depth is not None  # of every render with depth
        assert render.depth_variance is not None
        depth = measured_depth(render.median_depth, render.expected_depth, render.depth_variance).cpu().numpy()
        rgb = (255 * render.colour.clamp(0, 1)).round().byte().cpu().numpy()
        scaled = depth * self._frame.view_from_model.scale
        if blend is not None and blend.share > 0 and self._is_at(blend.camera, pose.center_in_model):
            rgb = self._blended(rgb, blend, pose.pinhole.rays(_pixels(width, height)), pose.cam_from_model)
        return Picture(rgb, np.where(scaled > 0, np.minimum(scaled, _FARTHEST), _FARTHEST).astype(np.float32))

    def _is_at(self, camera: int, center_in_model: FloatArray) -> bool:
        own = self._renderer.trained.poses.cam_center_in_model[camera]
        return float(np.linalg.norm(own - center_in_model)) < _SAME_PLACE * self._frame.radius_m

    def _blended(self, rgb: ByteArray, blend: Blend, rays: FloatArray, cam_from_model: FloatArray) -> ByteArray:
        """Return a picture with the photograph over it, as the photograph's lens shows the rays (H, W, 3)."""
        trained = self._renderer.trained
        own = rays @ (trained.poses.cam_from_model[blend.camera] @ cam_from_model.T).T
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


def _pixels(width: int, height: int) -> FloatArray:
    """Return the centres (H, W, 2) of the pixels of a picture."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
