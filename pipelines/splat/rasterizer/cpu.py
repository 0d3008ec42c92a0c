"""Rasteriser on a CPU: numba kernels behind a `torch.autograd.Function`.

Forward: `cpu_project` projects the Gaussians and lists them by tile in order of depth, `cpu_blend` blends tile by
tile. Backward: `cpu_blend` walks the same lists, `cpu_gradients` sums up by Gaussian.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipelines.core.errors import InputError
from pipelines.core.types import AutogradContext
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer import cpu_blend, cpu_gaussian, cpu_gradients, cpu_project
from pipelines.splat.rasterizer.api import BackendName, RasterSettings, Render, ScreenStats

_Array = NDArray[Any]

# Kernels use all cores, and numba's fallback threading layer crashes if two threads launch kernels at once.
KERNEL_LOCK = threading.Lock()
# Pixels up to which one thread is faster than several, which must be woken and waited for in each kernel.
_SMALL_PX = 64 * 64


class CpuRasterizer:
    """CPU backend, with exact gradients, and the same result on every run for any number of threads.

    Its dtype is that of the Gaussians: float32 to train, float64 to check. The number of threads is numba's
    (`numba.set_num_threads`, `NUMBA_NUM_THREADS`).
    """

    name: BackendName = "cpu"
    device = torch.device("cpu")

    def render(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Render:
        """See `Rasterizer.render`; an InputError: shapes, dtypes, device or settings that do not fit together."""
        _validate(gaussians, cam_from_model, camera, settings)
        pose = cam_from_model[:3].to(torch.float64)
        center_in_model = -torch.linalg.solve(pose[:, :3], pose[:, 3])
        with _threads_for(settings.image_of(camera)):
            context = _RenderContext(camera, settings)
            colour, alpha, depth_sum, square_sum, median, normal = _Rasterize.apply(
                *gaussians.tensors().values(), pose, center_in_model, context
            )
        normal = normal if settings.normal else None
        if not settings.depth:
            return Render(colour, alpha, context.stats, normal=normal)
        opaque = alpha > 0
        total = torch.where(opaque, alpha, 1.0)
        expected = torch.where(opaque, depth_sum / total, 0.0)
        variance = (square_sum / total - expected.square()).clamp_min(0.0)
        median = median if settings.median else None
        return Render(colour, alpha, context.stats, expected, variance, median, normal)

    def candidates(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Tensor:
        """See `Rasterizer.candidates`."""
        pose = _array(cam_from_model[:3].to(torch.float64))
        parameters = [_array(tensor) for tensor in gaussians.tensors().values()]
        with KERNEL_LOCK, _threads_for(settings.image_of(camera)):
            view = cpu_gaussian.make_view(camera, settings, pose)
            visible, _ = _find_visible(parameters, pose, view, numba.get_num_threads(), roughly=True)
        return torch.from_numpy(visible)


# Tiles (16 × 32 px) that a visible Gaussian touches on average: 3 to 6 in trained models.
_HITS_PER_VISIBLE = 6.0


def predicted_bytes(count: int, camera: Pinhole, sh_degree: int, *, visible: int | None = None) -> int:
    """Return the peak memory in bytes of one render and its backward pass, with gradients, without parameters.

    Of the Gaussians, whose stored harmonics have a degree, `visible` are in the image; None: all.
    """
    gradients = count * (11 + 3 * (sh_degree + 1) ** 2) * 4 + count * 5
    splats = cpu_project.SPLAT_WIDTH + cpu_project.ELLIPSE_WIDTH
    in_view = count if visible is None else visible
    hits = in_view * _HITS_PER_VISIBLE * (16 + 4 * cpu_blend.HIT_GRADIENT_WIDTH)
    # Colour, alpha, Σ w z, Σ w z², median depth and normal, and the gradients of all but the median.
    images = camera.width * camera.height * 19 * 4
    return int(gradients + in_view * (4 * splats + 48) + hits + images)


@dataclass
class _RenderContext:
    """State of one render that the forward pass leaves for the backward pass."""

    camera: Pinhole
    settings: RasterSettings
    workers: int = field(default_factory=numba.get_num_threads)
    background: _Array = field(init=False)  # (3,) float64
    view: cpu_gaussian.View = field(init=False)
    stats: ScreenStats = field(init=False)
    visible: _Array = field(init=False)  # (M,) rows of the visible Gaussians, ascending
    table: _Array = field(init=False)  # (M, SPLAT_WIDTH) their splats
    normals: _Array = field(init=False)  # (M, 3) their normals, at least one row; (0, 3): not wanted
    lists: TileLists = field(init=False)


@dataclass
class TileLists:
    """H hits of M splats in the tiles of an image."""

    hits: _Array  # (H,) packed, by tile, nearest first
    tile_start: _Array  # (tiles + 1,) into `hits`
    tile_end: _Array  # (tiles,) hit at which blending stopped because all pixels were done
    splat_start: _Array  # (M + 1,) into `places`
    places: _Array  # (H,) into `hits`, by splat


class _Rasterize(torch.autograd.Function):
    """Raw parameters, pose (3, 4) and centre (3,) in; colour, alpha, Σ w z, Σ w z², median depth and normal out."""

    @staticmethod
    def forward(
        ctx: AutogradContext,
        *inputs: Any,  # tensors, and as the last the `_RenderContext`
    ) -> tuple[Tensor, ...]:
        *tensors, context = inputs
        *parameters, pose, center = (_array(tensor) for tensor in tensors)
        with KERNEL_LOCK:
            _project(context, parameters, pose, center)
            image, depth = context.settings.image_of(context.camera), context.settings.depth
            size, workers = (image.height, image.width), context.workers
            images = blend_tiles(
                context.table,
                context.normals,
                context.lists,
                size,
                context.background,
                depth=depth,
                workers=workers,
            )
        outputs = tuple(torch.from_numpy(image) for image in images)
        ctx.context = context
        ctx.save_for_backward(*tensors, *outputs)
        ctx.mark_non_differentiable(outputs[4])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        context: _RenderContext = ctx.context
        saved = [_array(tensor) for tensor in ctx.saved_tensors]
        *parameters, pose, center = saved[:7]
        grads = tuple(_array(grad) for grad in (*grad_outputs[:4], grad_outputs[5]))
        outputs = [np.empty_like(parameter) for parameter in parameters]
        table, normals, lists = context.table, context.normals, context.lists
        hit_gradient = np.empty(len(lists.hits) * cpu_blend.HIT_GRADIENT_WIDTH, dtype=table.dtype)
        of_normals = np.empty(len(lists.hits) * cpu_blend.NORMAL_WIDTH * bool(len(normals)), dtype=table.dtype)
        with KERNEL_LOCK:
            cpu_blend.blend_gradient(
                *(table, normals, lists.hits, lists.tile_start, lists.tile_end, context.background),
                *(tuple(saved[7:]), grads, hit_gradient, of_normals, context.workers),
            )
            camera = _gaussian_gradients(context, [*parameters, pose, center], (hit_gradient, of_normals), outputs)
        gradients = [*outputs, camera[:12].reshape(3, 4), camera[12:]]
        return (*(torch.from_numpy(gradient) for gradient in gradients), None)


@contextlib.contextmanager
def _threads_for(image: Pinhole) -> Iterator[None]:
    threads = numba.get_num_threads()
    numba.set_num_threads(1 if image.width * image.height <= _SMALL_PX else threads)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


def _array(tensor: Tensor) -> _Array:
    array: _Array = tensor.detach().contiguous().numpy()
    return array


def _project(context: _RenderContext, parameters: list[_Array], pose: _Array, center: _Array) -> None:
    """Project the visible Gaussians, order them by depth and list them by tile."""
    view = context.view = cpu_gaussian.make_view(context.camera, context.settings, pose)
    context.background = np.array(context.settings.background, dtype=np.float64)
    dtype = parameters[0].dtype
    context.visible, depth = _find_visible(parameters, pose, view, context.workers, roughly=False)
    count = len(context.visible)
    context.table = np.empty((count, cpu_project.SPLAT_WIDTH), dtype=dtype)
    ellipses = np.empty((count, cpu_project.ELLIPSE_WIDTH), dtype=dtype)
    context.normals = np.empty((max(count, 1) if context.settings.normal else 0, 3), dtype=dtype)
    cpu_project.project_visible(
        *(*parameters, pose, center, view, context.settings.sh_degree),
        *(context.visible, context.table, ellipses, context.normals, context.workers),
    )
    image = context.settings.image_of(context.camera)
    context.lists = list_tiles(ellipses, _depth_order(depth), image.width, image.height)
    context.stats = ScreenStats(torch.from_numpy(context.visible))


def _find_visible(
    parameters: list[_Array], pose: _Array, view: cpu_gaussian.View, workers: int, *, roughly: bool
) -> tuple[_Array, _Array]:
    """Return the rows (M,) of the visible Gaussians, ascending, and their depths (M,)."""
    every, dtype = len(parameters[0]), parameters[0].dtype
    is_visible, depth = np.empty(every, dtype=np.bool_), np.empty(every, dtype=dtype)
    cpu_project.find_visible(*parameters[:4], pose, view, roughly, is_visible, depth, workers)
    visible = np.flatnonzero(is_visible)
    return visible, depth[visible]


def _depth_order(depth: _Array) -> _Array:
    """Return the permutation (M,) int64 that sorts depths, nearest first; equal depths keep their order."""
    if depth.dtype != np.float32:
        return np.argsort(depth, kind="stable")
    # Positive floats sort like their bits. One sort of whole keys is several times faster than an argsort.
    keys = depth.view(np.uint32).astype(np.uint64) << np.uint64(32) | np.arange(len(depth), dtype=np.uint64)
    keys.sort()
    order: _Array = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
    return order


def list_tiles(ellipses: _Array, order: _Array, width: int, height: int) -> TileLists:
    """Return the hits of ellipses (M, ELLIPSE_WIDTH), nearest first in `order` (M,), on the tiles of an image."""
    columns, rows = cpu_project.tile_grid(width, height)
    tiles = columns * rows
    per_tile = np.empty((cpu_project.RUNS, tiles), dtype=np.int64)
    splat_start = np.zeros(len(ellipses) + 1, dtype=np.int64)
    cpu_project.count_hits(ellipses, order, width, height, per_tile, splat_start[1:])
    np.cumsum(splat_start, out=splat_start)
    tile_start = np.empty(tiles + 1, dtype=np.int64)
    cpu_project.starts_from_counts(per_tile, tile_start)
    hits = np.empty(splat_start[-1], dtype=np.int64)
    places = np.empty(splat_start[-1], dtype=np.int64)
    cpu_project.list_hits(ellipses, order, width, height, per_tile, splat_start, hits, places)
    return TileLists(hits, tile_start, np.empty(tiles, dtype=np.int64), splat_start, places)


def blend_tiles(
    table: _Array, normals: _Array, lists: TileLists, size: tuple[int, int], background: _Array, *, depth: bool,
    workers: int,
) -> tuple[_Array, ...]:  # fmt: skip
    """Return colour, alpha, Σ w z, Σ w z², median depth and normal; without pixels what is not wanted.

    Args:
        table: (M, SPLAT_WIDTH) splats.
        normals: (M, 3) of the splats; (0, 3): not wanted.
        lists: their hits; `tile_end` is written.
        size: height and width of the image.
        background: (3,) float64.
        workers: number of threads.
    """
    depth_size, normal_size = size if depth else (0, 0), size if len(normals) else (0, 0)
    shapes: tuple[tuple[int, ...], ...] = ((*size, 3), size, *3 * (depth_size,), (*normal_size, 3))
    images = tuple(np.empty(shape, dtype=table.dtype) for shape in shapes)
    cpu_blend.blend(table, normals, lists.hits, lists.tile_start, background, images, lists.tile_end, workers)
    return images


def _gaussian_gradients(
    context: _RenderContext, inputs: list[_Array], of_hits: tuple[_Array, _Array], outputs: list[_Array]
) -> _Array:
    """Fill `outputs`, and return the gradient (15,) of pose and centre."""
    *parameters, pose, center = inputs
    blocks = -(-len(parameters[0]) // cpu_project.BLOCK)
    block_start = np.searchsorted(context.visible, np.arange(blocks + 1) * cpu_project.BLOCK)
    camera = np.empty((blocks, cpu_gradients.CAMERA_WIDTH), dtype=np.float64)
    g_screen = np.empty((len(context.visible), 2), dtype=np.float32)
    cpu_gradients.gaussian_gradients(
        *(*parameters, pose, center, context.view, context.settings.sh_degree, context.visible),
        *(*of_hits, context.lists.splat_start, context.lists.places, block_start),
        *(*outputs, camera, g_screen, context.workers),
    )
    context.stats.mean_gradient = torch.from_numpy(g_screen)
    total: _Array = camera.sum(axis=0)
    return total


def _validate(gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings) -> None:
    count, dtype = len(gaussians), gaussians.means.dtype
    shapes = {"means": (count, 3), "quats_wxyz": (count, 4), "log_scales": (count, 3), "logit_opacities": (count,)}
    for name, tensor in gaussians.tensors().items():
        expected = shapes.get(name, (count, (gaussians.sh_degree + 1) ** 2, 3))
        _require_shape(tensor, expected, name)
        if tensor.dtype != dtype or dtype not in (torch.float32, torch.float64):
            message = f"The tensor is {tensor.dtype}: all must be float32, or all float64."
            raise InputError("tensor-type", message, field=name)
        if tensor.device.type != "cpu":
            message = f"The tensor is on {tensor.device}: the cpu backend needs it on the cpu."
            raise InputError("tensor-device", message, field=name)
    _require_shape(cam_from_model, (4, 4), "cam_from_model")
    highest = min(gaussians.sh_degree, 3)
    if not 0 <= settings.sh_degree <= highest:
        message = f"The degree must be 0 to {highest}, it is {settings.sh_degree}."
        raise InputError("sh-degree", message, field="sh_degree")
    if settings.near_m <= 0:
        raise InputError("near-plane", f"The distance of {settings.near_m} m is not positive.", field="near_m")
    image = settings.image_of(camera)
    if image.width < 1 or image.height < 1:
        message = f"The image of {image.width} × {image.height} pixels is empty."
        raise InputError("image-empty", message, field="camera")


def _require_shape(tensor: Tensor, expected: tuple[int, ...], name: str) -> None:
    if tuple(tensor.shape) != expected:
        message = f"The shape is {tuple(tensor.shape)}, it must be {expected}."
        raise InputError("tensor-shape", message, field=name)
