"""Renders of the trained model, and its surface as its training cameras see it: depth maps to measure in.

The maps of thousands of photographs exceed the memory. They lie in files of a folder, mapped into memory. Maps are
written one after the other. The size of a file therefore tells how many are complete, and an interrupted stage goes
on after those. In the workspace's cache, the next deliverable of the same model finds them.
"""

import hashlib
import os
import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import GAUSSIANS
from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Pinhole, ViewPose, pose_matrix
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, read_gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, Render, Window
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.splat.spatial import SpatialBlocks
from pipelines.splat.surface import measured_depth
from pipelines.surface.visibility import DepthViews, Support, Viewpoints, support
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import photographs
from pipelines.survey.solution import TrainedModel
from pipelines.survey.survey import Survey

_WINDOW_PX = 15
_LEAST_SHARE = 0.5  # of the photograph's contrast, which the render must show
_LEAST_CONTRAST = 6.0  # grey levels of 255: a fainter pattern is noise, and confirms or rejects nothing


def photo_consistent(rendered: ByteArray, photograph: ByteArray) -> BoolArray:
    """Return where (H, W) a render (H, W, 3) has the contrast of its undistorted photograph (H, W, 3).

    Elsewhere, the model has no surface that the photograph confirms: a wall that is missing in the model, or a roof
    that was painted on the ground, appears blurred. The share of the photograph's contrast in the render is the
    slope of a straight line from grey levels of the photograph to those of the render, in a window around the
    pixel. Brightness and exposure have no influence on where it is low.
    """
    shown, given = (
        cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) for image in (rendered, photograph)
    )
    render, photo = shown.astype(np.float32), given.astype(np.float32)
    mean = partial(cv2.boxFilter, ddepth=-1, ksize=(_WINDOW_PX, _WINDOW_PX))
    mean_render, mean_photo = mean(render), mean(photo)
    variance = mean(photo * photo) - mean_photo**2
    covariance = mean(photo * render) - mean_photo * mean_render
    return np.asarray((covariance >= _LEAST_SHARE * variance) | (variance < _LEAST_CONTRAST**2))


class ModelRenderer:
    """Renderer of Gaussians from the cameras of their model, at the size of its undistorted photographs."""

    def __init__(
        self,
        model: TrainedModel,
        sfm: SparseModel,
        gaussians: Gaussians,
        images: ImageCache,
        backend: Rasterizer,
    ) -> None:
        self.model, self.gaussians, self.images, self.backend = model, gaussians, images, backend
        self.sfm, self.sparse = sfm, model.with_lenses(sfm)
        self.poses, self.geo_from_model = model.poses, model.similarity
        self._on_device = gaussians.to(backend.device)

    def showing(self, gaussians: Gaussians) -> "ModelRenderer":
        """Return the renderer of other Gaussians in the place of the model's."""
        if gaussians is self.gaussians:
            return self
        degree = min(self.model.sh_degree, gaussians.sh_degree)
        model = self.model.model_copy(update={"sh_degree": degree})
        return ModelRenderer(model, self.sfm, gaussians, self.images, self.backend)

    @cached_property
    def blocks(self) -> SpatialBlocks:
        """Gaussians sorted for windows: a second for a million, which the first window takes otherwise."""
        return SpatialBlocks(self.gaussians)

    @property
    def device(self) -> torch.device:
        return self.backend.device

    def pose(self, index: int) -> ViewPose:
        poses = self.poses
        return ViewPose(self.images.pinhole(index), poses.cam_from_model[index], poses.cam_center_in_model[index])

    def render(
        self, view: int | ViewPose, *, depth: bool = False, window: Window | None = None, plain: bool = False
    ) -> Render:
        """Return the render of a camera, by its index or from anywhere, or of a window of it, without gradients.

        In `plain` colours, the same from all sides, it takes less time.
        """
        model, pose = self.model, view if isinstance(view, ViewPose) else self.pose(view)
        matrix = pose_matrix(pose.cam_from_model, pose.center_in_model)
        degree = 0 if plain else model.sh_degree
        settings = RasterSettings(degree, model.background, depth=depth, window=window)
        gaussians = self._on_device
        if window is not None:  # A pass over millions of Gaussians takes longer than the window itself.
            gaussians = self.blocks.in_view(matrix, pose.pinhole, settings).to(gaussians.means.device)
        cam_from_model = torch.as_tensor(matrix, dtype=torch.float32, device=gaussians.means.device)
        with torch.no_grad():
            return self.backend.render(gaussians, cam_from_model, pose.pinhole, settings)

    def depth_m(self, view: int | ViewPose, window: Window | None = None) -> FloatArray:
        """Return the depth (H, W) in metres of the surface along the z axis of a camera; 0: no surface."""
        seen = self.render(view, depth=True, window=window, plain=True)
        return np.asarray(measured_depth(seen).cpu().numpy())

    def key(self) -> str:
        """Return a hash of all that the surface in the training views depends on; errors as of `ImageCache.key`."""
        model, poses, digest = self.model, self.poses, hashlib.sha256(self.backend.name.encode())
        digest.update(repr((model.sh_degree, model.background, model.mip_filter)).encode())
        for values in (*self.gaussians.tensors().values(), poses.cam_from_model, poses.cam_center_in_model):
            digest.update(np.ascontiguousarray(values).data)
        for index in self.model.indices("train"):
            masked = self.images.mask_key(index) if self.images.is_masked(index) else ""
            digest.update(f"{self.images.key(index)}|{masked}|{self.images.pinhole(index)}".encode())
        return digest.hexdigest()[:32]

    def surface(self, index: int) -> tuple[Float32Array, ByteArray]:
        """Return the depth (H, W) of camera `index`, 0 where masked, and the colours (H, W, 3) of its render."""
        view = self.render(index, depth=True)
        rgb = (255 * view.colour.clamp(0, 1)).round().to(torch.uint8)
        depth = measured_depth(view).cpu().numpy().astype(np.float32)
        if self.images.is_masked(index):
            depth[~self.images.mask(index)] = 0
        return depth, rgb.cpu().numpy()


def model_renderer(
    workspace: Workspace,
    model: TrainedModel,
    sfm: SparseModel,
    survey: Survey,
    *,
    backend: Literal["auto", "cpu", "cuda"] = "auto",
    progress: Progress = SILENT,
) -> ModelRenderer:
    """Return the renderer of a workspace's Gaussians, by a backend; errors as of `rasterizer`, `read_gaussians`.

    The undistorted photographs are built by whoever needs them all.
    """
    gaussians = read_gaussians(workspace.path(GAUSSIANS))
    images = photographs(model.with_lenses(sfm), survey, workspace, model.max_image_size)
    return ModelRenderer(model, sfm, gaussians, images, rasterizer(backend, progress, mip_filter=model.mip_filter))


# The trained surface of a simulated flight departs from the true one by less than 0.5 % of the depth at nine of ten
# pixels; so two views of one surface differ by less than 1 %. Steps between two surfaces are mostly larger.
SAME_SURFACE = 0.01
_DEPTHS, _COLOURS = "depths.f32", "colours.u8"
_SPARE_BYTES = 1 << 28  # of the disk, to be left free


@dataclass(frozen=True)
class SurfaceView:
    """Surface as one training camera sees it."""

    camera: int  # index among the cameras of the trained model
    pinhole: Pinhole  # at the size of the maps
    cam_from_model: FloatArray
    cam_center_in_model: FloatArray
    depth_m: Float32Array  # (H, W) along the camera's z axis, read-only; 0: no surface
    # (H, W, 3) colours of the render, read-only; None if they are not kept. They have no exposure of a photograph,
    # so that views meet without a seam
    rgb: ByteArray | None

    def points(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Return the places (P, 3) in `model` of the surface at pixels, in metres."""
        ray = self.pinhole.rays(np.stack([columns, rows], axis=-1) + 0.5)
        depth = self.depth_m[rows, columns].astype(np.float64)
        return (depth[..., None] * ray) @ self.cam_from_model + self.cam_center_in_model


class SurfaceViews:
    """Depth maps of all training cameras, at the photographs' training size; an InputError: the disk is too small.

    Args:
        folder: made if missing. It belongs to these maps alone: those that are there are continued.
        colours: keep the colours of the renders too.
        confirmed: keep only depths where render and photograph agree (`photo_consistent`).
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
        self._model, self._poses, self._images = renderer.model, renderer.poses, renderer.images
        self.cameras = renderer.model.indices("train")
        self.pinholes = tuple(renderer.images.pinhole(index) for index in self.cameras)
        pixels = [pinhole.width * pinhole.height for pinhole in self.pinholes]
        self._start = np.concatenate([[0], np.cumsum(pixels)]).astype(np.int64)
        folder.mkdir(parents=True, exist_ok=True)
        self._confirmed = confirmed
        self._render(renderer, colours, progress)
        self._depth = np.memmap(folder / _DEPTHS, np.float32, "r", shape=(int(self._start[-1]),)).view(np.ndarray)
        self._rgb: ByteArray | None = None
        if colours:
            shape = (int(self._start[-1]), 3)
            self._rgb = np.memmap(folder / _COLOURS, np.uint8, "r", shape=shape).view(np.ndarray)

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, number: int) -> SurfaceView:
        """Return view `number` of 0 … len − 1."""
        camera, pinhole, poses = self.cameras[number], self.pinholes[number], self._poses
        part, size = slice(*self._start[number : number + 2]), (pinhole.height, pinhole.width)
        rgb = None if self._rgb is None else self._rgb[part].reshape(*size, 3)
        return SurfaceView(
            camera,
            pinhole,
            poses.cam_from_model[camera],
            poses.cam_center_in_model[camera],
            self._depth[part].reshape(size),
            rgb,
        )

    def support(
        self, point_in_model: FloatArray, normal_in_model: FloatArray | None = None, tolerance: float = SAME_SURFACE
    ) -> Support:
        """Return how far the training views agree on points (N, 3); lengths in metres of `geo`.

        Unit normals (N, 3) have an arbitrary sign; NaN: unknown. Depths of one surface agree within the tolerance,
        a part of the depth.
        """
        geo_from_model = self._model.similarity
        up_in_model = geo_from_model.rotation.T @ [0.0, 0.0, 1.0]
        seen = support(point_in_model, self.depth_views(), up_in_model, tolerance, normal_in_model)
        return seen.scaled(geo_from_model.scale)

    def depth_views(self) -> DepthViews:
        """Return the maps with their cameras in `model`, for kernels."""
        poses = self._poses
        rotation, center = poses.cam_from_model[self.cameras], poses.cam_center_in_model[self.cameras]
        return DepthViews.of(Viewpoints(rotation, center, self.pinholes), self._depth)

    def photograph(self, number: int) -> tuple[ByteArray, FloatArray]:
        """Return the undistorted photograph (H, W, 3) of a view, and the matrix (3, 4) that undoes its exposure.

        The matrix applies to homogeneous colours of 0 … 255; it changes nothing where the exposure is not known.
        """
        return self._images.image(self.cameras[number]), self.light(number)

    def light(self, number: int) -> FloatArray:
        """Return the matrix (3, 4) that undoes the exposure of a view's photograph, as `photograph` does."""
        exposure = self._model.cameras[self.cameras[number]].exposure
        gain, offset = np.split(np.eye(3, 4) if exposure is None else np.array(exposure), [3], axis=1)
        return np.asarray(np.linalg.solve(gain, np.column_stack([np.eye(3), -255 * offset])))

    def close(self) -> None:
        """Release the files."""
        del self._depth, self._rgb

    def _render(self, renderer: ModelRenderer, colours: bool, progress: Progress) -> None:
        """Append the maps that are missing to the files."""
        sizes = {_DEPTHS: 4, _COLOURS: 3} if colours else {_DEPTHS: 4}
        paths = {self.folder / name: size for name, size in sizes.items()}
        there = [path.stat().st_size if path.exists() else 0 for path in paths]
        whole = min(held // size for held, size in zip(there, paths.values(), strict=True))  # pixels in all files
        done = int(np.searchsorted(self._start, whole, side="right")) - 1
        needed = sum(paths.values()) * int(self._start[-1] - self._start[done])
        free = shutil.disk_usage(self.folder).free - _SPARE_BYTES
        if needed > free:
            raise InputError(
                "disk-full",
                f"The depth maps of the training views need {needed / 2**30:.1f} GiB, and "
                f"{max(free, 0) / 2**30:.1f} GiB are free: make room on this disk.",
                path=self.folder,
            )
        with ExitStack() as files, progress.task("depth maps", len(self)) as task:
            handles = [files.enter_context(path.open("ab")) for path in paths]
            for handle, size in zip(handles, paths.values(), strict=True):
                handle.truncate(size * int(self._start[done]))
            task.advance(done)
            for index in self.cameras[done:]:
                depth, rgb = renderer.surface(index)
                if self._confirmed:
                    depth[~photo_consistent(rgb, renderer.images.image(index))] = 0
                maps: tuple[NDArray[Any], ...] = depth, rgb
                for handle, values in zip(handles, maps, strict=False):
                    handle.write(values.tobytes())
                    handle.flush()
                    os.fsync(handle.fileno())  # The size counts after a power failure too.
                task.advance()
