"""Photometric figures of the test views: training fits neither Gaussians nor cameras to their photographs.

Where no training views show the ground as well, a photograph tests nothing but the guess. The ground of a pixel is
where its ray meets the surface through the SfM points. What stands before it is not asked for. The splat itself
decides nothing here: no hole or floater in it excuses a pixel, and all configurations of a comparison are tested on
the same pixels.
"""

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from pipelines.core.progress import Progress
from pipelines.core.types import ByteArray
from pipelines.geometry.footprints import PointSurface, ground_points
from pipelines.report.plots.charts import labelled
from pipelines.splat.exposure import fitted_affine, with_affine
from pipelines.splat.metrics import Lpips, psnr, ssim
from pipelines.surface.photometry import photograph_and_mask, through_lens
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.photographs import DIFFERENCE_GAIN
from pipelines.survey.report import PhotometricFigures, ViewFigures

ENOUGH_VIEWS = 2  # one ray alone gives no depth
_COLUMNS = 48  # across a view: neighbouring rays meet neighbouring ground


class TrainingCoverage:
    """Coverage of views by the training views."""

    def __init__(self, renderer: ModelRenderer) -> None:
        self._renderer = renderer
        points = renderer.model.point_in_model(renderer.sfm)
        self._surface = PointSurface(points) if len(points) else None
        self._train = renderer.model.indices("train")

    def covered(self, index: int) -> Tensor | None:
        """Return the mask (H, W) of the pixels of a view whose ground at least two training views show.

        None without SfM points. Pixels without ground, such as sky, are not covered.
        """
        if self._surface is None:
            return None
        pose = self._renderer.pose(index)
        width, height = pose.pinhole.width, pose.pinhole.height
        columns = min(_COLUMNS, width)
        rows = max(1, round(columns * height / width))
        grid = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1).reshape(-1, 2)
        rays = pose.pinhole.rays(grid * [width / columns, height / rows]) @ pose.cam_from_model
        ground = ground_points(rays, pose.center_in_model, self._surface)
        count = np.zeros(len(ground), dtype=np.int64)  # of the training views whose image contains the ground
        for other in map(self._renderer.pose, (train for train in self._train if train != index)):
            in_cam = (ground - other.center_in_model) @ other.cam_from_model.T
            count += other.pinhole.contains(other.pinhole.project(in_cam))
        enough = (count >= ENOUGH_VIEWS).reshape(rows, columns)
        share = cv2.resize(enough.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        return torch.from_numpy(share >= 0.5)


# Saves, for a test view, RGB: the photograph, its render, their difference, side by side with labels.
SaveRender = Callable[[str, ByteArray], None]

_NO_WEIGHTS = "no weights were given: they are not part of the package"


def compare_test_views(
    renderer: ModelRenderer,
    lpips_weights: Path | None,
    save_render: SaveRender,
    progress: Progress,
    *,
    saved: int,
) -> PhotometricFigures:
    """Return PSNR, SSIM and LPIPS of the test views.

    `psnr` compares the render as the lens shows it, with its vignetting, at the exposure of the photograph's tie
    points, as its pose is that of its tie points: neither is fitted to the render. `psnr_compensated` has an affine
    change of colour that is. The remaining difference is not one of exposure.
    `psnr_covered` leaves out ground that fewer than two training views show: at the rim of a flight, a render is a
    guess.

    Raises:
        InputError: a photograph or the weights cannot be read.
    """
    indices, views = renderer.model.indices("test"), []
    coverage = TrainingCoverage(renderer)
    distance = None if lpips_weights is None else Lpips(lpips_weights)
    with progress.task("test views", len(indices)) as task:
        for rank, index in enumerate(indices):
            name = renderer.sparse.image_name[index]
            seen = renderer.render(index)
            render = through_lens(renderer, index, seen.colour.cpu()).clamp(0, 1)
            over_white = seen.colour + (1 - seen.alpha)[..., None] * _to_white(renderer)
            photo, mask = photograph_and_mask(renderer, index)
            covered = coverage.covered(index)
            covered = None if covered is None else covered & mask
            affine = fitted_affine(render, photo, mask)
            figures = ViewFigures(
                image=name,
                psnr=psnr(render, photo, mask),
                psnr_compensated=psnr(with_affine(render, affine), photo, mask),
                ssim=ssim(render, photo, mask),
                lpips=None if distance is None else distance(render, photo, mask),
                covered_share=None if covered is None else float(covered.sum() / mask.sum()),
                psnr_over_white=psnr(through_lens(renderer, index, over_white.cpu()).clamp(0, 1), photo, mask),
                psnr_covered=None if covered is None or not covered.any() else psnr(render, photo, covered),
            )
            views.append(figures)
            if rank < saved:
                save_render(name, _side_by_side(photo, render, figures))
            task.advance()
    means = ("psnr", "psnr_over_white", "psnr_compensated", "ssim", "psnr_covered", "covered_share", "lpips")
    return PhotometricFigures(
        views=len(views),
        **{name: _mean(getattr(view, name) for view in views) for name in means},
        lpips_reason=_NO_WEIGHTS if distance is None else None,
        per_view=tuple(views),
    )


def _to_white(renderer: ModelRenderer) -> Tensor:
    """Return what a render (…, 3) over the model's background lacks where nothing lies, to be one over white."""
    background = torch.tensor(renderer.model.background, dtype=torch.float32)
    return (1 - background).to(renderer.device)


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
