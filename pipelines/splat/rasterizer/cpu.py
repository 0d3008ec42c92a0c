"""The rasteriser on a CPU: numba kernels behind a `torch.autograd.Function`.

Gaussians are projected, sorted by depth, listed by tile, and blended tile by tile; the backward pass walks the
same lists. The kernels are in `cpu_project`, `cpu_tiles`, `cpu_blend` and `cpu_gradients`.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipelines.core.errors import InputError
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer import cpu_blend, cpu_gradients, cpu_project, cpu_tiles, cpu_view
from pipelines.splat.rasterizer.api import BackendName, Pinhole, RasterSettings, Render, ScreenStats

_Array = NDArray[Any]

# Kernels use all cores; and numba's fallback threading layer crashes when two threads launch at once.
_ONE_AT_A_TIME = threading.Lock()


class CpuRasterizer:
    """The CPU backend. Exact gradients; the same result on every run, whatever the number of threads.

    Works in the dtype of the Gaussians: float32 to train, float64 to check. The number of threads is numba's
    (`numba.set_num_threads`, `NUMBA_NUM_THREADS`).
    """

    name: BackendName = "cpu"

    def render(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Render:
        """See `Rasterizer.render`.

        Raises:
            InputError: shapes, dtypes, device or settings that do not fit together.
        """
        _validate(gaussians, cam_from_model, camera, settings)
        pose = cam_from_model[:3].to(torch.float64)
        center_in_model = -torch.linalg.solve(pose[:, :3], pose[:, 3])
        frame = _Frame(camera, settings)
        colour, alpha, depth_sum, square_sum, median = _Rasterize.apply(
            *gaussians.tensors().values(), pose, center_in_model, frame
        )
        if not settings.depth:
            return Render(colour, alpha, frame.stats)
        opaque = alpha > 0
        total = torch.where(opaque, alpha, 1.0)
        expected = torch.where(opaque, depth_sum / total, 0.0)
        variance = (square_sum / total - expected.square()).clamp_min(0.0)
        return Render(colour, alpha, frame.stats, expected, variance, median)


def predicted_bytes(
    count: int, camera: Pinhole, sh_degree: int, *, visible: int | None = None, hits_per_visible: float = 6.0
) -> int:
    """Peak memory in bytes of one render and its backward pass, gradients included, parameters excluded.

    Args:
        count: number of Gaussians.
        camera: the image.
        sh_degree: degree of the stored spherical harmonics.
        visible: how many of them are in the image; all, if None.
        hits_per_visible: tiles (16 × 32 px) that one of them touches on average: 3 to 6 in trained models, and as
            many as there are tiles if all are huge.
    """
    gradients = count * (11 + 3 * (sh_degree + 1) ** 2) * 4 + count * 5
    splats = cpu_project.SPLAT_WIDTH + cpu_project.ELLIPSE_WIDTH
    in_view = count if visible is None else visible
    hits = in_view * hits_per_visible * (16 + 4 * cpu_blend.HIT_GRADIENT_WIDTH)
    # Colour, alpha, mean, mean square and median depth, and the gradients of all but the last.
    images = camera.width * camera.height * 13 * 4
    return int(gradients + in_view * (4 * splats + 48) + hits + images)


@dataclass
class _Frame:
    """One render: what was asked, and what the forward pass leaves for the backward pass.

    Attributes:
        camera, settings: what was asked.
        workers: number of threads.
        stats: handed out with the render.
        visible: (M,) rows of the visible Gaussians, ascending.
        rank: (M,) their places in the order of depth.
        table: (M, SPLAT_WIDTH) splats in the order of depth.
        lists: their hits on tiles.
    """

    camera: Pinhole
    settings: RasterSettings
    workers: int = field(default_factory=numba.get_num_threads)
    stats: ScreenStats = field(init=False)
    visible: _Array = field(init=False)
    rank: _Array = field(init=False)
    table: _Array = field(init=False)
    lists: _TileLists = field(init=False)

    @property
    def background(self) -> _Array:
        """(3,) float64."""
        return np.array(self.settings.background, dtype=np.float64)

    def view(self, pose: _Array) -> cpu_view.View:
        """The camera as kernels want it."""
        return cpu_view.make_view(self.camera, self.settings, pose)


@dataclass
class _TileLists:
    """H hits of M splats in the tiles.

    Attributes:
        hits: (H,) packed, by tile, nearest first.
        tile_start: (tiles + 1,) into `hits`.
        tile_end: (tiles,) where blending stopped because all pixels were done.
        splat_start: (M + 1,) into `places`.
        places: (H,) into `hits`, by splat.
    """

    hits: _Array
    tile_start: _Array
    tile_end: _Array
    splat_start: _Array
    places: _Array


class _Rasterize(torch.autograd.Function):
    """Raw parameters, pose (3, 4) and centre (3,) in; colour, alpha, Σ w z, Σ w z² and median depth out."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, frame = inputs
        *parameters, pose, center = (_array(tensor) for tensor in tensors)
        with _ONE_AT_A_TIME:
            _project(frame, parameters, pose, center)
            images = _blend(frame)
        outputs = tuple(torch.from_numpy(image) for image in images)
        ctx.frame = frame
        ctx.save_for_backward(*tensors, *outputs)
        ctx.mark_non_differentiable(outputs[4])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        frame: _Frame = ctx.frame
        saved = [_array(tensor) for tensor in ctx.saved_tensors]
        *parameters, pose, center = saved[:7]
        grads = tuple(_array(grad) for grad in grad_outputs[:4])
        outputs = [np.empty_like(parameter) for parameter in parameters]
        with _ONE_AT_A_TIME:
            hit_gradient = _hit_gradient(frame, tuple(saved[7:]), grads)
            camera = _gaussian_gradients(frame, [*parameters, pose, center], hit_gradient, outputs)
        gradients = [*outputs, camera[:12].reshape(3, 4), camera[12:]]
        return (*(torch.from_numpy(gradient) for gradient in gradients), None)


def _array(tensor: Tensor) -> _Array:
    array: _Array = tensor.detach().contiguous().numpy()
    return array


def _project(frame: _Frame, parameters: list[_Array], pose: _Array, center: _Array) -> None:
    """Project what is visible, order it by depth and list it by tile."""
    view, dtype = frame.view(pose), parameters[0].dtype
    is_visible, depth = np.empty(len(parameters[0]), dtype=np.bool_), np.empty(len(parameters[0]), dtype=dtype)
    cpu_project.find_visible(*parameters[:4], pose, view, is_visible, depth, frame.workers)
    frame.visible = np.flatnonzero(is_visible)
    frame.rank = _depth_rank(depth[frame.visible])
    count = len(frame.visible)
    frame.table = np.empty((count, cpu_project.SPLAT_WIDTH), dtype=dtype)
    ellipses = np.empty((count, cpu_project.ELLIPSE_WIDTH), dtype=dtype)
    radius = np.empty(count, dtype=np.float32)
    cpu_project.project_visible(
        *(*parameters, pose, center, view, frame.settings.sh_degree),
        *(frame.visible, frame.rank, frame.table, ellipses, radius, frame.workers),
    )
    frame.lists = _list_tiles(ellipses, frame.camera)
    frame.stats = ScreenStats(visible=torch.from_numpy(frame.visible), radius_px=torch.from_numpy(radius))


def _depth_rank(depth: _Array) -> _Array:
    """Place of each Gaussian in the order of depth; equal depths keep their order."""
    if depth.dtype == np.float32:
        # Positive floats sort like their bits. One sort of whole keys is several times faster than an argsort.
        keys = depth.view(np.uint32).astype(np.uint64) << np.uint64(32) | np.arange(len(depth), dtype=np.uint64)
        keys.sort()
        order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
    else:
        order = np.argsort(depth, kind="stable")
    rank = np.empty(len(depth), dtype=np.int64)
    rank[order] = np.arange(len(depth))
    return rank


def _list_tiles(ellipses: _Array, camera: Pinhole) -> _TileLists:
    columns, rows = cpu_tiles.tile_grid(camera.width, camera.height)
    tiles = columns * rows
    per_tile = np.empty((cpu_tiles.RUNS, tiles), dtype=np.int64)
    splat_start = np.zeros(len(ellipses) + 1, dtype=np.int64)
    cpu_tiles.count_hits(ellipses, camera.width, camera.height, per_tile, splat_start[1:])
    np.cumsum(splat_start, out=splat_start)
    tile_start = np.empty(tiles + 1, dtype=np.int64)
    cpu_tiles.starts_from_counts(per_tile, tile_start)
    hits = np.empty(splat_start[-1], dtype=np.int64)
    places = np.empty(splat_start[-1], dtype=np.int64)
    cpu_tiles.list_hits(ellipses, camera.width, camera.height, per_tile, splat_start, hits, places)
    return _TileLists(hits, tile_start, np.empty(tiles, dtype=np.int64), splat_start, places)


def _blend(frame: _Frame) -> tuple[_Array, ...]:
    """Colour, alpha, Σ w z, Σ w z² and median depth, the last three of size (0, 0) if they are not wanted."""
    size = (frame.camera.height, frame.camera.width)
    depth_size = size if frame.settings.depth else (0, 0)
    shapes: tuple[tuple[int, ...], ...] = ((*size, 3), size, *3 * (depth_size,))
    images = tuple(np.empty(shape, dtype=frame.table.dtype) for shape in shapes)
    lists = frame.lists
    cpu_blend.blend(
        *(frame.table, lists.hits, lists.tile_start),
        *(frame.background, images, lists.tile_end, frame.workers),
    )
    return images


def _hit_gradient(frame: _Frame, images: tuple[_Array, ...], grads: tuple[_Array, ...]) -> _Array:
    lists = frame.lists
    gradient = np.empty(len(lists.hits) * cpu_blend.HIT_GRADIENT_WIDTH, dtype=frame.table.dtype)
    cpu_blend.blend_gradient(
        *(frame.table, lists.hits, lists.tile_start, lists.tile_end),
        *(frame.background, images, grads, gradient, frame.workers),
    )
    return gradient


def _gaussian_gradients(frame: _Frame, inputs: list[_Array], hit_gradient: _Array, outputs: list[_Array]) -> _Array:
    """Fill `outputs`; returns the gradient (15,) of pose and centre."""
    *parameters, pose, center = inputs
    blocks = -(-len(parameters[0]) // cpu_project.BLOCK)
    block_start = np.searchsorted(frame.visible, np.arange(blocks + 1) * cpu_project.BLOCK)
    camera = np.empty((blocks, cpu_gradients.CAMERA_WIDTH), dtype=np.float64)
    g_screen = np.empty((len(frame.visible), 2), dtype=np.float32)
    cpu_gradients.gaussian_gradients(
        *(*parameters, pose, center, frame.view(pose), frame.settings.sh_degree, frame.visible, frame.rank),
        *(hit_gradient, frame.lists.splat_start, frame.lists.places, block_start),
        *(*outputs, camera, g_screen, frame.workers),
    )
    frame.stats.mean_gradient = torch.from_numpy(g_screen)
    total: _Array = camera.sum(axis=0)
    return total


def _validate(gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings) -> None:
    count, dtype = len(gaussians), gaussians.means.dtype
    shapes = {"means": (count, 3), "quats_wxyz": (count, 4), "log_scales": (count, 3), "logit_opacities": (count,)}
    for name, tensor in gaussians.tensors().items():
        expected = shapes.get(name, (count, (gaussians.sh_degree + 1) ** 2, 3))
        if tuple(tensor.shape) != expected:
            raise InputError(f"has shape {tuple(tensor.shape)}, must be {expected}", field=name)
        if tensor.dtype != dtype or dtype not in (torch.float32, torch.float64):
            raise InputError(f"is {tensor.dtype}: all must be float32 (or all float64)", field=name)
        if tensor.device.type != "cpu":
            raise InputError(f"is on {tensor.device}: the cpu backend needs it on the cpu", field=name)
    if tuple(cam_from_model.shape) != (4, 4):
        raise InputError(f"has shape {tuple(cam_from_model.shape)}, must be (4, 4)", field="cam_from_model")
    highest = min(gaussians.sh_degree, 3)
    if not 0 <= settings.sh_degree <= highest:
        raise InputError(f"must be 0 to {highest}, is {settings.sh_degree}", field="sh_degree")
    if settings.near_m <= 0:
        raise InputError(f"must be positive, is {settings.near_m}", field="near_m")
    if camera.width < 1 or camera.height < 1:
        raise InputError(f"image of {camera.width} × {camera.height} pixels", field="camera")
