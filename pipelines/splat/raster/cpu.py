"""The rasteriser on a CPU: numba kernels behind a `torch.autograd.Function`.

Gaussians are projected, sorted by depth, listed by tile, and blended tile by tile; the backward pass walks the
same lists. The kernels are in `cpu_project`, `cpu_tiles`, `cpu_blend` and `cpu_gradients`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipelines.errors import InputError
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.raster import cpu_blend, cpu_gradients, cpu_project, cpu_tiles
from pipelines.splat.raster.api import (
    BackendName,
    Pinhole,
    RasterSettings,
    Render,
    ScreenStats,
)

_Array = NDArray[Any]


class CpuRasterizer:
    """The CPU backend. Exact gradients; the same result on every run, whatever the number of threads.

    Works in the dtype of the Gaussians: float32 to train, float64 to check.
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
        frame = _Frame(camera, settings, numba.get_num_threads())
        colour, alpha, depth_sum, median = _Rasterize.apply(
            *gaussians.tensors().values(), pose, center_in_model, frame
        )
        expected = None
        if settings.depth:
            opaque = alpha > 0
            expected = torch.where(opaque, depth_sum / torch.where(opaque, alpha, 1.0), 0.0)
        assert frame.stats is not None
        return Render(colour, alpha, expected, median if settings.depth else None, frame.stats)


@dataclass
class _Frame:
    """One render: what was asked, and what the forward pass leaves for the backward pass."""

    camera: Pinhole
    settings: RasterSettings
    workers: int
    stats: ScreenStats | None = None
    visible: _Array | None = None
    rank: _Array | None = None
    table: _Array | None = None
    lists: _TileLists | None = None

    def constants(self) -> tuple[cpu_project.View, int, _Array]:
        """What kernels take: the view, the degree of the harmonics, the background."""
        return (
            cpu_project.make_view(self.camera, self.settings),
            self.settings.sh_degree,
            np.array(self.settings.background, dtype=np.float64),
        )


@dataclass
class _TileLists:
    """H hits of M splats in the tiles; see `cpu_tiles.list_hits`."""

    hits: _Array
    tile_start: _Array
    tile_end: _Array
    splat_start: _Array
    places: _Array


class _Rasterize(torch.autograd.Function):
    """Raw parameters, pose (3, 4) and centre (3,) in; colour, alpha, Σ w z and median depth out."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, frame = inputs
        *parameters, pose, center = (tensor.detach().contiguous().numpy() for tensor in tensors)
        background = frame.constants()[2]
        _project(frame, tuple(parameters), pose, center)
        images = _empty_images(frame, parameters[0].dtype)
        cpu_blend.blend(
            frame.table,
            frame.lists.hits,
            frame.lists.tile_start,
            background,
            images,
            frame.lists.tile_end,
            frame.workers,
        )
        outputs = tuple(torch.from_numpy(image) for image in images)
        ctx.frame = frame
        ctx.save_for_backward(*tensors, *outputs)
        ctx.mark_non_differentiable(outputs[3])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        frame: _Frame = ctx.frame
        saved = [tensor.detach().contiguous().numpy() for tensor in ctx.saved_tensors]
        *parameters, pose, center = saved[:7]
        grads = tuple(grad.contiguous().numpy() for grad in grad_outputs[:3])
        hit_gradient = _hit_gradient(frame, tuple(saved[7:]), grads)
        outputs = tuple(np.empty_like(parameter) for parameter in parameters)
        camera = _gaussian_gradients(frame, (tuple(parameters), pose, center), hit_gradient, outputs)
        return (
            *(torch.from_numpy(output) for output in outputs),
            torch.from_numpy(camera[:12].reshape(3, 4)),
            torch.from_numpy(camera[12:]),
            None,
        )


def _project(frame: _Frame, parameters: tuple[_Array, ...], pose: _Array, center: _Array) -> None:
    """Project what is visible, order it by depth and list it by tile."""
    view, degree, _ = frame.constants()
    count, dtype = len(parameters[0]), parameters[0].dtype
    is_visible, depth = np.empty(count, dtype=np.bool_), np.empty(count, dtype=dtype)
    cpu_project.find_visible(*parameters[:4], pose, view, is_visible, depth, frame.workers)
    visible = np.flatnonzero(is_visible)
    rank = _depth_rank(depth[visible])
    table = np.empty((len(visible), cpu_project.SPLAT_WIDTH), dtype=dtype)
    ellipses = np.empty((len(visible), cpu_project.ELLIPSE_WIDTH), dtype=dtype)
    radius = np.empty(len(visible), dtype=np.float32)
    cpu_project.project_visible(
        parameters, pose, center, view, degree, visible, rank, table, ellipses, radius, frame.workers
    )
    frame.visible, frame.rank, frame.table = visible, rank, table
    frame.lists = _list_tiles(ellipses, frame.camera)
    frame.stats = ScreenStats(visible=torch.from_numpy(visible), radius_px=torch.from_numpy(radius))


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
    per_splat = np.empty(len(ellipses), dtype=np.int64)
    cpu_tiles.count_hits(ellipses, camera.width, camera.height, per_tile, per_splat)
    splat_start = np.concatenate([[0], np.cumsum(per_splat)])
    tile_start = np.empty(tiles + 1, dtype=np.int64)
    cpu_tiles.starts_from_counts(per_tile, tile_start)
    hits = np.empty(tile_start[-1], dtype=np.int64)
    places = np.empty(tile_start[-1], dtype=np.int64)
    cpu_tiles.list_hits(ellipses, camera.width, camera.height, per_tile, splat_start, hits, places)
    return _TileLists(hits, tile_start, np.empty(tiles, dtype=np.int64), splat_start, places)


def _empty_images(frame: _Frame, dtype: Any) -> tuple[_Array, ...]:
    """Colour, alpha, Σ w z and median depth, the last two of size (0, 0) if they are not wanted."""
    size = (frame.camera.height, frame.camera.width)
    depth_size = size if frame.settings.depth else (0, 0)
    shapes: tuple[tuple[int, ...], ...] = ((*size, 3), size, depth_size, depth_size)
    return tuple(np.empty(shape, dtype=dtype) for shape in shapes)


def _hit_gradient(frame: _Frame, images: tuple[_Array, ...], grads: tuple[_Array, ...]) -> _Array:
    lists = frame.lists
    assert lists is not None and frame.table is not None
    gradient = np.empty((len(lists.hits), cpu_blend.HIT_GRADIENT_WIDTH), dtype=frame.table.dtype)
    cpu_blend.blend_gradient(
        frame.table,
        lists.hits,
        lists.tile_start,
        lists.tile_end,
        frame.constants()[2],
        images,
        grads,
        gradient,
        frame.workers,
    )
    return gradient


def _gaussian_gradients(frame: _Frame, inputs: tuple[Any, ...], hit_gradient: _Array, outputs: Any) -> _Array:
    """Fill `outputs`; returns the gradient (15,) of pose and centre."""
    parameters, pose, center = inputs
    lists = frame.lists
    assert lists is not None and frame.visible is not None and frame.stats is not None
    view, degree, _ = frame.constants()
    blocks = -(-len(parameters[0]) // cpu_project.BLOCK)
    block_start = np.searchsorted(frame.visible, np.arange(blocks + 1) * cpu_project.BLOCK)
    camera = np.empty((blocks, cpu_gradients.CAMERA_WIDTH), dtype=np.float64)
    g_screen = np.empty((len(frame.visible), 2), dtype=np.float32)
    cpu_gradients.gaussian_gradients(
        *(parameters, pose, center, view, degree, frame.visible, frame.rank, hit_gradient),
        *(lists.splat_start, lists.places, block_start, outputs, camera, g_screen, frame.workers),
    )
    frame.stats.mean_gradient = torch.from_numpy(g_screen)
    total: _Array = camera.sum(axis=0)
    return total


def _validate(gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings) -> None:
    count = len(gaussians)
    shapes = {"means": (count, 3), "quats_wxyz": (count, 4), "log_scales": (count, 3), "logit_opacities": (count,)}
    dtype = gaussians.means.dtype
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
    if not 0 <= settings.sh_degree <= min(gaussians.sh_degree, 3):
        raise InputError(f"must be 0 to {min(gaussians.sh_degree, 3)}, is {settings.sh_degree}", field="sh_degree")
    if settings.near_m <= 0:
        raise InputError(f"must be positive, is {settings.near_m}", field="near_m")
    if camera.width < 1 or camera.height < 1:
        raise InputError(f"image of {camera.width} × {camera.height} pixels", field="camera")
