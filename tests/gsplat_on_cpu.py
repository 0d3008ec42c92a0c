"""gsplat's own Python code over kernels that a CPU runs, for the cuda backend without a GPU.

Only what gsplat compiles is replaced (`gsplat.csrc`): all that it checks of shapes, of packed and unpacked calls
and of arguments happens as on a GPU. The kernels follow csrc/*.cu of gsplat 1.5.3 in plain torch: projection and
harmonics by gsplat's own `_torch_impl`, with the radii that depend on the opacity; the blending tile by tile,
through the lists of intersections. They refuse what the real ones refuse: other types, and tensors with gaps.
Derivatives are autograd's of the same formulas.

What this cannot show: how CUDA rounds, what a real kernel writes beyond an array, and speed.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterator
from types import ModuleType

import pytest
import torch
from torch import Tensor

TILE_PX = 16
_ALPHA_LEAST, _ALPHA_MOST, _TRANSMITTANCE_LEAST, _REACH = 1 / 255, 0.999, 1e-4, 3.33


class CameraModelType:
    PINHOLE, ORTHO, FISHEYE = "pinhole", "ortho", "fisheye"


PINHOLE = CameraModelType.PINHOLE  # gsplat asks the module for it, too


def gsplat_on_cpu(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return gsplat with these kernels in place of the compiled ones, for one test."""
    kernels = sys.modules[__name__]
    monkeypatch.setitem(sys.modules, "gsplat.csrc", kernels)
    gsplat = importlib.import_module("gsplat")
    monkeypatch.setattr(importlib.import_module("gsplat.cuda._backend"), "_C", kernels)
    return gsplat


# ------------------------------------------------------------------ projection


def projection_ewa_3dgs_packed_fwd(
    means: Tensor, covars: Tensor | None, quats: Tensor, scales: Tensor, opacities: Tensor | None, viewmats: Tensor,
    Ks: Tensor, width: int, height: int, eps2d: float, near: float, far: float, clip: float, compensate: bool,
    camera_model: str,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Return pointer, batch, camera and Gaussian ids, radii, centres, depths, conics and compensations."""
    _require(means, quats, scales, opacities, viewmats, Ks)
    assert covars is None and means.ndim == 2 and len(viewmats) == len(Ks) == 1, "one camera, no batch"
    with torch.no_grad():
        radii, means2d, depths, conics, factor = _projected(
            means, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far, clip, compensate,
            camera_model,
        )  # fmt: skip
    rows = torch.nonzero((radii > 0).all(dim=-1))[:, 0]
    zeros = torch.zeros_like(rows)
    pointer = torch.tensor([0, len(rows)], dtype=torch.int32)
    seen = (radii[rows], means2d[rows], depths[rows], conics[rows], factor[rows] if compensate else None)
    return pointer, zeros, zeros.clone(), rows, *seen


def projection_ewa_3dgs_packed_bwd(
    means: Tensor, covars: Tensor | None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int,
    height: int, eps2d: float, camera_model: str, batch_ids: Tensor, camera_ids: Tensor, rows: Tensor,
    conics: Tensor, compensations: Tensor | None, v_means2d: Tensor, v_depths: Tensor, v_conics: Tensor,
    v_compensations: Tensor | None, of_pose: bool, sparse: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    _require(
        means, quats, scales, viewmats, Ks, conics, compensations, v_means2d, v_depths, v_conics, v_compensations
    )
    assert not sparse
    with torch.enable_grad():
        leaves = [tensor.detach().requires_grad_() for tensor in (means, quats, scales, viewmats)]
        _, *outputs, factor = _projected(
            leaves[0], leaves[1], leaves[2], None, leaves[3], Ks, width, height, eps2d, 0.0, math.inf, 0.0,
            compensations is not None, camera_model,
        )  # fmt: skip
        outputs += [] if compensations is None else [factor]
        incoming = [v_means2d, v_depths, v_conics, *([] if compensations is None else [v_compensations])]
        of_means, of_quats, of_scales, of_view = torch.autograd.grad(
            [output[rows] for output in outputs], leaves, incoming, allow_unused=True
        )
    return of_means, None, of_quats, of_scales, of_view if of_pose else None


def projection_ewa_3dgs_fused_fwd(
    means: Tensor, covars: Tensor | None, quats: Tensor, scales: Tensor, opacities: Tensor | None, viewmats: Tensor,
    Ks: Tensor, width: int, height: int, eps2d: float, near: float, far: float, clip: float, compensate: bool,
    camera_model: str,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Return radii, centres, depths, conics and compensations of all Gaussians; a radius of 0: not seen."""
    _require(means, quats, scales, opacities, viewmats, Ks)
    with torch.no_grad():
        *seen, factor = _projected(
            means, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far, clip, compensate,
            camera_model,
        )  # fmt: skip
    return *(tensor[None] for tensor in seen), factor[None] if compensate else None


def projection_ewa_3dgs_fused_bwd(
    means: Tensor, covars: Tensor | None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int,
    height: int, eps2d: float, camera_model: str, radii: Tensor, conics: Tensor, compensations: Tensor | None,
    v_means2d: Tensor, v_depths: Tensor, v_conics: Tensor, v_compensations: Tensor | None, of_pose: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    rows = torch.nonzero((radii[0] > 0).all(dim=-1))[:, 0]
    factors = [None if tensor is None else tensor[0, rows] for tensor in (compensations, v_compensations)]
    return projection_ewa_3dgs_packed_bwd(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, camera_model, rows, rows, rows,
        conics[0, rows], factors[0], v_means2d[0, rows], v_depths[0, rows], v_conics[0, rows], factors[1], of_pose,
        False,
    )  # fmt: skip


def _projected(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor | None, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, eps2d: float, near: float, far: float, clip: float, compensate: bool,
    camera_model: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Return radii (N, 2) int32, centres (N, 2), depths, conics (N, 3) and compensations (N,) of all Gaussians."""
    torch_impl = importlib.import_module("gsplat.cuda._torch_impl")
    covars, _ = torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    _, means2d, depths, conics, factor = torch_impl._fully_fused_projection(
        means, covars, viewmats, Ks, width, height, eps2d, near, far, compensate, camera_model
    )
    means2d, depths, conics = means2d[0], depths[0], conics[0]
    factor = factor[0] if compensate else torch.ones_like(depths)
    with torch.no_grad():  # `_torch_impl` knows no opacities: the kernels take a narrower box for faint Gaussians.
        a, b, c = conics.unbind(-1)
        determinant = a * c - b * b
        reach = torch.full_like(depths, _REACH)
        seen = (depths >= near) & (depths <= far) & (determinant > 0)
        if opacities is not None:
            opacity = opacities * factor
            seen &= opacity >= _ALPHA_LEAST
            reach = reach.minimum(torch.sqrt(2 * torch.log(opacity.clamp_min(_ALPHA_LEAST) / _ALPHA_LEAST)))
        radii = torch.ceil(reach[:, None] * torch.stack([c, a], dim=-1).div(determinant[:, None]).sqrt())
        seen &= ~(radii <= clip).all(dim=-1)
        size = torch.tensor([width, height])
        seen &= ((means2d + radii > 0) & (means2d - radii < size)).all(dim=-1)
    return torch.where(seen[:, None], radii, 0).int(), means2d, depths, conics, factor


def spherical_harmonics_fwd(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None) -> Tensor:
    _require(dirs, coeffs)
    colours: Tensor = importlib.import_module("gsplat.cuda._torch_impl")._spherical_harmonics(degree, dirs, coeffs)
    return colours if masks is None else torch.where(masks[..., None], colours, 0.0)


def spherical_harmonics_bwd(
    bases: int, degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None, gradient: Tensor, of_dirs: bool
) -> tuple[Tensor, Tensor | None]:
    _require(dirs, coeffs, gradient)
    assert bases == coeffs.shape[-2]
    with torch.enable_grad():
        leaves = [coeffs.detach().requires_grad_(), dirs.detach().requires_grad_()]
        colours = spherical_harmonics_fwd(degree, leaves[1], leaves[0], masks)
        of_coeffs, of_directions = torch.autograd.grad(colours, leaves, gradient, allow_unused=True)
    return of_coeffs, (torch.zeros_like(dirs) if of_directions is None else of_directions) if of_dirs else None


# ------------------------------------------------------------------ intersections


def intersect_tile(
    means2d: Tensor, radii: Tensor, depths: Tensor, image_ids: Tensor | None, gaussian_ids: Tensor | None,
    images: int, tile_size: int, columns: int, rows: int, sort: bool, segmented: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Return the tiles of each Gaussian, and keys and places of the pairs, sorted by tile and depth."""
    _require(means2d, depths)
    assert radii.dtype == torch.int32 and sort and images == 1
    centre, reach, depth = means2d.reshape(-1, 2), radii.reshape(-1, 2), depths.reshape(-1)
    most = torch.tensor([columns, rows])
    low = torch.floor((centre - reach) / tile_size).clamp_min(0).minimum(most).long()
    high = torch.ceil((centre + reach) / tile_size).clamp_min(0).minimum(most).long()
    width = torch.where((reach > 0).all(dim=-1), high[:, 0] - low[:, 0], 0)
    count = width * (high[:, 1] - low[:, 1])
    place = torch.arange(len(count)).repeat_interleave(count)
    within = torch.arange(int(count.sum())) - (torch.cumsum(count, 0) - count)[place]
    tile = (low[place, 1] + within // width[place]) * columns + low[place, 0] + within % width[place]
    bits = depth[place].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    keys, order = torch.sort((tile << 32) | bits, stable=True)
    return count.int().reshape(depths.shape), keys, place[order].int()


def intersect_offset(keys: Tensor, images: int, columns: int, rows: int) -> Tensor:
    assert keys.dtype == torch.int64 and keys.is_contiguous()
    count = torch.bincount(keys >> 32, minlength=columns * rows)
    return (torch.cumsum(count, 0) - count).int().reshape(images, rows, columns)


# ------------------------------------------------------------------ blending


def rasterize_to_pixels_3dgs_fwd(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None,
    masks: Tensor | None, width: int, height: int, tile_size: int, offsets: Tensor, ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Return the image (…, H, W, C), alpha (…, H, W, 1), and the index of each pixel's last intersection."""
    _require(means2d, conics, colors, opacities)
    assert masks is None and tile_size == TILE_PX and offsets.dtype == ids.dtype == torch.int32
    with torch.no_grad():
        image, alpha = _blended(means2d, conics, colors, opacities, width, height, offsets, ids)
    shape = offsets.shape[:-2]
    image = image if backgrounds is None else image + (1 - alpha) * backgrounds.reshape(-1)
    last = torch.zeros(height, width, dtype=torch.int32)
    return tuple(tensor.expand(*shape, *tensor.shape) for tensor in (image, alpha, last))  # type: ignore[return-value]


def rasterize_to_pixels_3dgs_bwd(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None,
    masks: Tensor | None, width: int, height: int, tile_size: int, offsets: Tensor, ids: Tensor, alphas: Tensor,
    last_ids: Tensor, v_colors: Tensor, v_alphas: Tensor, absolute: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    _require(means2d, conics, colors, opacities, v_colors, v_alphas)
    assert backgrounds is None and not absolute
    with torch.enable_grad():
        leaves = [tensor.detach().requires_grad_() for tensor in (means2d, conics, colors, opacities)]
        images = _blended(leaves[0], leaves[1], leaves[2], leaves[3], width, height, offsets, ids)
        incoming = [
            gradient.reshape(image.shape) for gradient, image in zip((v_colors, v_alphas), images, strict=True)
        ]
        if not any(image.requires_grad for image in images):  # nothing is seen
            return None, *(torch.zeros_like(leaf) for leaf in leaves)
        gradients = torch.autograd.grad(images, leaves, incoming)
    return None, *gradients


def rasterize_to_indices_3dgs(
    start: int, end: int, transmittances: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, width: int,
    height: int, tile_size: int, offsets: Tensor, ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return Gaussian and pixel of each contribution, grouped by pixel, nearest first."""
    _require(transmittances, means2d, conics, opacities)
    assert start == 0 and 0 < end < 2**32, "unsigned 32 bits, and all batches"
    assert bool((transmittances == 1).all())
    found = []
    for rows, pixel, weight in _tiles(means2d, conics, opacities, width, height, offsets, ids):
        at, which = torch.nonzero((weight > 0).T, as_tuple=True)
        found.append(torch.stack([rows[which], pixel[at]]))
    gaussian, pixels = torch.cat(found, dim=1) if found else torch.zeros(2, 0, dtype=torch.int64)
    order = torch.sort(pixels, stable=True).indices
    return gaussian[order], pixels[order]


def _blended(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int, offsets: Tensor,
    ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    channels = colors.shape[-1]
    image, alpha = torch.zeros(height * width, channels), torch.zeros(height * width)
    values = colors.reshape(-1, channels)
    parts = list(_tiles(means2d, conics, opacities, width, height, offsets, ids))
    if parts:
        pixels = torch.cat([pixel for _, pixel, _ in parts])
        image = image.index_put((pixels,), torch.cat([weight.T @ values[rows] for rows, _, weight in parts]))
        alpha = alpha.index_put((pixels,), torch.cat([weight.sum(dim=0) for *_, weight in parts]))
    return image.reshape(height, width, channels), alpha.reshape(height, width, 1)


def _tiles(
    means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int, offsets: Tensor, ids: Tensor
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield of each tile its Gaussians (g,), its pixels (p,), and their weights (g, p)."""
    centre, conic, opacity = means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1)
    rows, columns = offsets.shape[-2:]
    assert rows == math.ceil(height / TILE_PX) and columns == math.ceil(width / TILE_PX)
    starts = [*offsets.reshape(-1).tolist(), len(ids)]
    for tile in range(rows * columns):
        chosen = ids[starts[tile] : starts[tile + 1]].long()
        if len(chosen) == 0:
            continue
        top, left = tile // columns * TILE_PX, tile % columns * TILE_PX
        v, u = torch.meshgrid(
            torch.arange(top, min(top + TILE_PX, height)), torch.arange(left, min(left + TILE_PX, width)),
            indexing="ij",
        )  # fmt: skip
        u, v = u.reshape(-1), v.reshape(-1)
        dx, dy = centre[chosen, 0, None] - (u + 0.5), centre[chosen, 1, None] - (v + 0.5)
        a, b, c = (conic[chosen, index, None] for index in range(3))
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacity[chosen, None] * torch.exp(-sigma)).clamp(max=_ALPHA_MOST)
        alpha = torch.where((sigma >= 0) & (alpha >= _ALPHA_LEAST), alpha, 0.0)
        after = torch.cumprod(1 - alpha, dim=0)
        before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
        counted = after > _TRANSMITTANCE_LEAST
        yield chosen, v * width + u, torch.where(counted, alpha * before, 0.0)


def _require(*tensors: Tensor | None) -> None:
    """Refuse what CHECK_INPUT and the kernels' pointers refuse: gaps, and other types than float32."""
    for tensor in tensors:
        if tensor is not None:
            assert tensor.is_contiguous(), f"a tensor {tuple(tensor.shape)} is not contiguous"
            assert tensor.dtype == torch.float32, f"a tensor {tuple(tensor.shape)} is {tensor.dtype}"
