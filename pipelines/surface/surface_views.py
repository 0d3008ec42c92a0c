"""Surface of the trained model, as its training cameras see it: depth maps to measure in.

The maps of thousands of photographs exceed the memory. They lie in files of a scratch folder, mapped into memory.
Maps are written one after the other. The size of a file therefore tells how many are complete, and an interrupted
stage goes on after those.

Where a render shows its photograph: elsewhere, the model has no surface that the photograph confirms.

Rendering of the trained model from its own cameras.
"""

from __future__ import annotations

import os
import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.files import remove
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole, pose_matrix
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, Render, Window
from pipelines.splat.spatial import SpatialBlocks
from pipelines.splat.surface import measured_depth
from pipelines.surface.visibility import DepthViews, Support, support
from pipelines.survey.photographs import ImageCache, Pinholes
from pipelines.survey.trained_survey import TrainedSurvey

_WINDOW_PX = 15
_LEAST_SHARE = 0.5  # of the photograph's contrast, which the render must show
_LEAST_CONTRAST = 6.0  # grey levels of 255: a fainter pattern is noise, and confirms or refutes nothing


def shows_photograph(rendered: ByteArray, photograph: ByteArray) -> BoolArray:
    """Return where a render (H, W, 3) shows the contrast of its photograph (H, W, 3): (H, W).

    A wall that is missing in the model, or a roof that was painted on the ground, appears blurred. The share of the
    photograph's contrast in the render is the slope of a straight line from grey levels of the photograph to those
    of the render, in a window around the pixel. Brightness and exposure have no influence on where it is low.

    Args:
        rendered: RGB.
        photograph: RGB, undistorted, of the same camera and size.
    """
    shown, given = (
        cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) for image in (rendered, photograph)
    )
    render, photo = shown.astype(np.float32), given.astype(np.float32)
    mean_render, mean_photo = _mean(render), _mean(photo)
    variance = _mean(photo * photo) - mean_photo**2
    covariance = _mean(photo * render) - mean_photo * mean_render
    return np.asarray((covariance >= _LEAST_SHARE * variance) | (variance < _LEAST_CONTRAST**2))


def _mean(image: Float32Array) -> Float32Array:
    return np.asarray(cv2.boxFilter(image, -1, (_WINDOW_PX, _WINDOW_PX)))


@dataclass(frozen=True)
class ViewPose:
    """Camera somewhere in the scene.

    Attributes:
        pinhole: of its image.
        cam_from_model: (3, 3) rotation.
        center_in_model: (3,) metres.
    """

    pinhole: Pinhole
    cam_from_model: FloatArray
    center_in_model: FloatArray


class ModelRenderer:
    """Renderer of the trained model from its own cameras, at the size of the training photographs.

    Args:
        trained: the trained model.
        images: undistorted photographs of the same cameras.
        backend: the rasteriser.
    """

    def __init__(self, trained: TrainedSurvey, images: ImageCache, backend: Rasterizer) -> None:
        self.trained, self.images = trained, images
        self._backend = backend
        self._pinholes = Pinholes(images, trained.sfm.lenses, trained.sparse.lenses)
        device = torch.device("cuda" if backend.name == "cuda" else "cpu")
        self._gaussians = trained.gaussians.to(device)

    def prepare_windows(self) -> None:
        """Sort the Gaussians for windows: a second for a million, which the first window would take otherwise."""
        _ = self._blocks

    @cached_property
    def _blocks(self) -> SpatialBlocks:
        return SpatialBlocks(self.trained.gaussians)

    def pinhole(self, index: int) -> Pinhole:
        """Return the pinhole of camera `index`, at the size of its render."""
        return self._pinholes.of(index)

    def render(self, index: int, *, depth: bool = False) -> Render:
        """Return the render of camera `index`, without gradients.

        Args:
            index: of the camera.
            depth: render depths as well.
        """
        return self.render_from(self.pose(index), depth=depth)

    def pose(self, index: int) -> ViewPose:
        """Return the pose of camera `index`."""
        poses = self.trained.poses
        return ViewPose(self.pinhole(index), poses.cam_from_model[index], poses.cam_center_in_model[index])

    def render_from(self, pose: ViewPose, *, depth: bool = False, window: Window | None = None) -> Render:
        """Return the render of any camera, without gradients.

        Args:
            pose: of the camera.
            depth: render depths as well.
            window: part of the image to render; None: all of it.
        """
        model = self.trained.model
        matrix = pose_matrix(pose.cam_from_model, pose.center_in_model)
        settings = RasterSettings(model.sh_degree, model.background, depth=depth, window=window)
        gaussians = self._gaussians
        if window is not None:  # A pass over millions of Gaussians takes longer than the window itself.
            gaussians = self._blocks.shown(matrix, pose.pinhole, settings).to(gaussians.means.device)
        cam_from_model = torch.as_tensor(matrix, dtype=torch.float32, device=gaussians.means.device)
        with torch.no_grad():
            return self._backend.render(gaussians, cam_from_model, pose.pinhole, settings)

    def depth_m(self, index: int) -> FloatArray:
        """Return the depth (H, W) in metres of the surface along the z axis of camera `index`; 0: no surface."""
        return self.depth_from(self.pose(index))

    def depth_from(self, pose: ViewPose, window: Window | None = None) -> FloatArray:
        """Return the depth (H, W) in metres of the surface along the z axis of any camera; 0: no surface.

        Args:
            pose: of the camera.
            window: part of the image to render; None: all of it.
        """
        return np.asarray(_measured(self.render_from(pose, depth=True, window=window)).cpu().numpy())

    def surface(self, index: int) -> tuple[Float32Array, ByteArray]:
        """Return the depth (H, W) as `depth_m` does, and the colours (H, W, 3) of the same render."""
        view = self.render(index, depth=True)
        rgb = (255 * view.colour.clamp(0, 1)).round().to(torch.uint8)
        return _measured(view).cpu().numpy().astype(np.float32), rgb.cpu().numpy()


def _measured(view: Render) -> torch.Tensor:
    assert view.median_depth is not None and view.expected_depth is not None
    assert view.depth_variance is not None  # of every render with depth
    return measured_depth(view.median_depth, view.expected_depth, view.depth_variance)


# The trained surface of a simulated flight departs from the true one by less than 0.5 % of the depth at nine of ten
# pixels; so two views of one surface differ by less than 1 %. Steps between two surfaces are mostly larger.
SAME_SURFACE = 0.01
_DEPTHS, _COLOURS = "depths.f32", "colours.u8"
_SPARE_BYTES = 1 << 28  # of the disk, to be left free


@dataclass(frozen=True)
class SurfaceView:
    """Surface as one training camera sees it.

    Attributes:
        camera: index among the cameras of the trained model.
        pinhole: at the size of the maps.
        cam_from_model: (3, 3) rotation.
        cam_center_in_model: (3,) metres.
        depth_m: (H, W) along the camera's z axis, read-only; 0: no surface.
        rgb: (H, W, 3) colours of the render, read-only; None if they are not kept. They have no
            exposure of a photograph, so that views meet without a seam.
    """

    camera: int
    pinhole: Pinhole
    cam_from_model: FloatArray
    cam_center_in_model: FloatArray
    depth_m: Float32Array
    rgb: ByteArray | None

    def points(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Return the places (P, 3) in `model` of the surface at pixels, in metres."""
        ray = self.pinhole.rays(np.stack([columns, rows], axis=-1) + 0.5)
        depth = self.depth_m[rows, columns].astype(np.float64)
        return np.asarray((depth[..., None] * ray) @ self.cam_from_model + self.cam_center_in_model)


class SurfaceViews:
    """Depth maps of all training cameras, at the size of the training photographs.

    Args:
        renderer: of the trained model.
        folder: scratch folder, made if missing. It belongs to the maps alone: maps that are there are continued.
        colours: keep the colours of the renders too.
        confirmed: keep only depths where the render shows its photograph (`surface.surface_views`).
        progress: shows the renders.

    Raises:
        InputError: the maps do not fit on the disk.
    """

    def __init__(
        self,
        renderer: ModelRenderer,
        folder: Path,
        *,
        colours: bool = False,
        confirmed: bool = False,
        progress: Progress = SILENT,
    ) -> None:
        self.folder = folder
        self._trained = renderer.trained
        self.cameras = renderer.trained.indices("train")
        self.pinholes = [renderer.pinhole(index) for index in self.cameras]
        pixels = [pinhole.width * pinhole.height for pinhole in self.pinholes]
        self._start = np.concatenate([[0], np.cumsum(pixels)]).astype(np.int64)
        folder.mkdir(parents=True, exist_ok=True)
        self._confirmed = confirmed
        self._render(renderer, colours, progress)
        self._depth = _mapped(folder / _DEPTHS, np.dtype(np.float32), int(self._start[-1]))
        self._rgb = _mapped(folder / _COLOURS, np.dtype(np.uint8), 3 * int(self._start[-1])) if colours else None

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.cameras)

    def view(self, number: int) -> SurfaceView:
        """Return view `number` of 0 … len − 1."""
        camera, pinhole, poses = self.cameras[number], self.pinholes[number], self._trained.poses
        part, size = slice(*self._start[number : number + 2]), (pinhole.height, pinhole.width)
        rgb = None if self._rgb is None else self._rgb.reshape(-1, 3)[part].reshape(*size, 3)
        return SurfaceView(
            camera,
            pinhole,
            poses.cam_from_model[camera],
            poses.cam_center_in_model[camera],
            self._depth[part].reshape(size),
            rgb,
        )

    def support(
        self,
        point_in_model: FloatArray,
        normal_in_model: FloatArray | None = None,
        *,
        tolerance: float = SAME_SURFACE,
    ) -> Support:
        """Return how far the training views agree on points; lengths in metres of `geo`.

        Args:
            point_in_model: (N, 3) metres.
            normal_in_model: (N, 3) unit normals with an arbitrary sign; NaN where unknown.
            tolerance: largest difference of depths on one surface, as a part of the depth.
        """
        geo_from_model, poses = self._trained.geo_from_model, self._trained.poses
        views = DepthViews(
            poses.cam_from_model[self.cameras],
            poses.cam_center_in_model[self.cameras],
            np.array([[pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy] for pinhole in self.pinholes]),
            np.array([[pinhole.width, pinhole.height] for pinhole in self.pinholes]),
            self._start[:-1],
            self._depth,
        )
        up_in_model = geo_from_model.rotation.T @ [0.0, 0.0, 1.0]
        return support(point_in_model, views, up_in_model, tolerance, normal_in_model).scaled(geo_from_model.scale)

    def close(self) -> None:
        """Delete the maps."""
        del self._depth, self._rgb
        remove(self.folder)

    def _render(self, renderer: ModelRenderer, colours: bool, progress: Progress) -> None:
        """Append the maps that are missing to the files."""
        sizes = {_DEPTHS: 4, _COLOURS: 3} if colours else {_DEPTHS: 4}
        paths = {self.folder / name: size for name, size in sizes.items()}
        done = min(_complete(path, size * self._start) for path, size in paths.items())
        _require_space(self.folder, sum(paths.values()) * int(self._start[-1] - self._start[done]))
        with ExitStack() as files, progress.task("depth maps", len(self)) as task:
            handles = [files.enter_context(path.open("ab")) for path in paths]
            for handle, size in zip(handles, paths.values(), strict=True):
                handle.truncate(size * int(self._start[done]))
            task.advance(done)
            for index in self.cameras[done:]:
                depth, rgb = renderer.surface(index)
                if self._confirmed:
                    depth[~shows_photograph(rgb, renderer.images.image(index))] = 0
                maps: tuple[NDArray[Any], ...] = depth, rgb
                for handle, values in zip(handles, maps, strict=False):
                    handle.write(values.tobytes())
                    handle.flush()
                    os.fsync(handle.fileno())  # The size counts after a power failure too.
                task.advance()


def _complete(path: Path, end: IntArray) -> int:
    """Return the number of maps that a file holds whole; `end` (V + 1,) are their ends in bytes, from 0."""
    size = path.stat().st_size if path.exists() else 0
    return int(np.searchsorted(end, size, side="right")) - 1


def _require_space(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free - _SPARE_BYTES
    if needed > free:
        raise InputError(
            f"the depth maps of the training views need {needed / 2**30:.1f} GiB, and "
            f"{max(free, 0) / 2**30:.1f} GiB are free: make room on this disk",
            path=folder,
        )


def _mapped(path: Path, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    return np.memmap(path, dtype=dtype, mode="r", shape=(count,)).view(np.ndarray)
