"""Photometric figures of the test views: training fits neither Gaussians nor cameras to their photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipelines.core.progress import Progress
from pipelines.core.types import ByteArray
from pipelines.evaluate.coverage import TrainingCoverage
from pipelines.plots.strips import labelled
from pipelines.scene.render_files import DIFFERENCE_GAIN
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.report import PhotometricFigures, ViewFigures
from pipelines.splat.exposure import fitted_affine, with_affine
from pipelines.splat.lpips import Lpips
from pipelines.splat.metrics import psnr, ssim

# Saves, for a test view, RGB: the photograph, its render, their difference, side by side with labels.
SaveRender = Callable[[str, ByteArray], None]

_NO_WEIGHTS = "no weights were given: they are not part of the package (--lpips-weights FILE.npz)"


def compare_test_views(
    renderer: ModelRenderer,
    lpips_weights: Path | None,
    save_render: SaveRender,
    progress: Progress,
    *,
    saved: int,
) -> PhotometricFigures:
    """Return PSNR, SSIM and LPIPS of the test views.

    `psnr` compares the render as it is. `psnr_compensated` first gives the render the exposure of the photograph,
    by an affine change of colour fitted to that photograph. The remaining difference is not one of exposure.
    `psnr_covered` leaves out ground that fewer than two training views show: at the rim of a flight, a render is a
    guess.

    Args:
        renderer: of the trained model.
        lpips_weights: NPZ file; None: no LPIPS.
        save_render: saves the first views side by side with their photographs.
        progress: shows the views.
        saved: number of views for `save_render`.

    Raises:
        InputError: a photograph or the weights cannot be read.
    """
    indices, views = renderer.trained.indices("test"), []
    coverage = TrainingCoverage(renderer)
    distance = None if lpips_weights is None else Lpips(lpips_weights)
    with progress.task("test views", len(indices)) as task:
        for place, index in enumerate(indices):
            name = renderer.trained.sparse.image_name[index]
            render = renderer.render(index).colour.clamp(0, 1).cpu()
            photo = torch.from_numpy(np.array(renderer.images.image(index))).float() / 255.0
            mask = torch.from_numpy(np.array(renderer.images.mask(index)))
            pair = _Pair(render, photo, mask, coverage.covered(index))
            views.append(_figures(name, pair, distance))
            if place < saved:
                save_render(name, _side_by_side(photo, render, views[-1]))
            task.advance()
    return PhotometricFigures(
        views=len(views),
        psnr=_mean(view.psnr for view in views),
        psnr_compensated=_mean(view.psnr_compensated for view in views),
        ssim=_mean(view.ssim for view in views),
        psnr_covered=_mean(view.psnr_covered for view in views),
        covered_share=_mean(view.covered_share for view in views),
        lpips=_mean(view.lpips for view in views),
        lpips_reason=_NO_WEIGHTS if distance is None else None,
        per_view=tuple(views),
    )


@dataclass(frozen=True)
class _Pair:
    """Render (H, W, 3) and photograph, colours 0 … 1; the pixels that count (H, W), and those that are covered."""

    render: Tensor
    photo: Tensor
    mask: Tensor
    covered: Tensor | None


def _figures(name: str, pair: _Pair, distance: Lpips | None) -> ViewFigures:
    """Return the figures of a render against its photograph."""
    render, photo, mask = pair.render, pair.photo, pair.mask
    covered = None if pair.covered is None else pair.covered & mask
    return ViewFigures(
        image=name,
        psnr=psnr(render, photo, mask),
        psnr_compensated=psnr(with_affine(render, fitted_affine(render, photo, mask)), photo, mask),
        ssim=ssim(render, photo, mask),
        lpips=None if distance is None else distance(render, photo, mask),
        covered_share=None if covered is None else float(covered.sum() / mask.sum()),
        psnr_covered=None if covered is None or not covered.any() else psnr(render, photo, covered),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(np.array(known, dtype=np.float64))) if known else None


def _side_by_side(photo: Tensor, render: Tensor, view: ViewFigures) -> ByteArray:
    """Return photograph, render, and their difference (× 3), (H, W, 3) each, side by side with labels above."""
    difference = (DIFFERENCE_GAIN * (photo - render).abs()).clamp(0, 1)
    pictures = [np.asarray(image.mul(255).round().byte().numpy()) for image in (photo, render, difference)]
    labels = (
        f"photograph {view.image}",
        f"render, PSNR {view.psnr:.2f} dB, SSIM {view.ssim:.3f}",
        f"difference × {DIFFERENCE_GAIN}",
    )
    return labelled(pictures, labels)
