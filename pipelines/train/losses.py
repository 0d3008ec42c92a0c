"""Losses of a training: a list of records, of which each iteration differentiates the weighted sum.

A loss is a function of one rendered view. `training_losses` is the list; the functions themselves are in
`splat.losses`, `splat.surface` and `train.georeference`. The order of the list is the order in which gradients are
added up: another order gives other last digits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.densify import Strategy
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import TRANSPARENCY_WEIGHT, photometric_loss, transparency_loss
from pipelines.splat.rasterizer.api import Render, ScreenStats
from pipelines.splat.surface import ObservedPoints, compactness_loss, depth_loss, flatness_loss, normal_loss
from pipelines.train.georeference.problem import GeoProblem
from pipelines.train.schedule import TrainingSchedule
from pipelines.train.target_images import TargetImage


@dataclass(frozen=True)
class RenderedView:
    """Render of a training view, beside its photograph."""

    index: int
    pose: Tensor  # (4, 4) cam ← model
    target: TargetImage  # the photograph, or a crop of it
    gaussians: Gaussians  # in training that may be in view
    rows: Tensor | None  # (M,) int64 of these among all in training; None: all
    count: int  # of all Gaussians in training
    render: Render  # of these and of those around a region; with depths if a loss needs them
    stats: ScreenStats  # of the render, for `gaussians` alone
    colour: Tensor  # (H, W, 3) render with the exposure of the photograph
    counting: Tensor | None = None  # (H, W) bool; None: all pixels count
    points: ObservedPoints | None = None  # that the photograph shows; None: unknown


@dataclass(frozen=True)
class Loss:
    """One loss of a training."""

    name: str  # in reports
    of: Callable[[RenderedView], Tensor | None]  # scalar; None: the view has no such loss
    weight: Callable[[int], float] = lambda _iteration: 1.0  # at an iteration, from 1; 0: none
    # factor of a crop, such that the mean over all crops of a photograph is its loss
    share: Callable[[RenderedView], Tensor | float] = lambda _view: 1.0


def weighted_sum(losses: Sequence[Loss], view: RenderedView, iteration: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted sum of the losses of a view, and the value of each that it has, by name; scalars."""
    terms, values = [], {}
    for loss in losses:
        weight = loss.weight(iteration)
        value = loss.of(view) if weight else None
        if value is not None:
            values[loss.name] = value
            terms.append(loss.share(view) * weight * value)
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total, values


def training_losses(
    problem: GeoProblem,
    strategy: Strategy,
    schedule: TrainingSchedule,
    *,
    extent_m: float,
    confined: bool = False,
    measured: Sequence[Loss] = (),
) -> list[Loss]:
    """Return the losses of a training, with those of its problem and strategy.

    Only pixels of the mask show what is trained if it is `confined`. The losses of a `measured` surface are used if
    the options have surface losses.
    """

    def control_by_depth(view: RenderedView) -> Tensor | None:
        render, camera = view.render, view.target.camera
        if render.expected_depth is None:
            return None
        loss = problem.depth_loss(view.index, render.expected_depth, render.alpha, camera)
        # Marks outside the crop do not count: each is seen in one of the crops.
        return None if loss is None else view.target.part.crops * loss

    def compactness(view: RenderedView) -> Tensor | None:
        render, mask = view.render, view.target.mask
        if render.expected_depth is None or render.depth_variance is None:
            return None
        alpha = render.alpha if not confined or mask is None else render.alpha * mask
        return compactness_loss(render.expected_depth, render.depth_variance, alpha)

    def depth(view: RenderedView) -> Tensor | None:
        render = view.render
        if view.points is None or render.expected_depth is None:
            return None
        return depth_loss(render.expected_depth, render.alpha, view.points, view.pose, view.target.camera)

    losses = [
        Loss(
            "photometric",
            lambda view: photometric_loss(view.colour, view.target.colour, view.counting),
            share=_by_pixels,
        ),
        Loss(
            "transparency",
            lambda view: transparency_loss(view.render.alpha, view.counting),
            lambda _: TRANSPARENCY_WEIGHT,
            _by_pixels,
        ),
        Loss("control_by_depth", control_by_depth, schedule.geographic_weight),
        Loss("geographic", lambda _view: problem.loss(), schedule.geographic_weight),
        Loss("density control", lambda view: strategy.penalty(view.gaussians, view.stats, view.count)),
    ]
    settings = schedule.options.surface
    if settings is None:
        return losses

    return [
        *losses,
        Loss(
            "flatness",
            lambda view: flatness_loss(view.gaussians, view.stats.visible, extent_m),
            lambda _: settings.flatness,
        ),
        Loss("compactness", compactness, lambda _: settings.compactness, _by_pixels),
        Loss("depth", depth, lambda _: settings.depth, _by_points),
        *measured,
        Loss(
            "normals",
            lambda view: normal_loss(view.render, view.pose, view.target.camera, settings.edge),
            schedule.weight_of_normals,
            _by_pixels,
        ),
    ]


def _by_pixels(view: RenderedView) -> float:
    return view.target.part.weight


def _by_points(view: RenderedView) -> Tensor | float:
    """Return the number of crops, times the share of the photograph's points that lie in this crop."""
    target, points, pose = view.target, view.points, view.pose
    if target.part.crops == 1 or points is None:
        return 1.0
    in_cam = points.point_in_model @ pose[:3, :3].detach().T.to(points.point_in_model) + pose[:3, 3].detach()
    here, anywhere = (_inside(in_cam, camera).sum() for camera in (target.camera, target.whole))
    return target.part.crops * here / anywhere.clamp_min(1)


def _inside(in_cam: Tensor, camera: Pinhole) -> Tensor:
    """Return which of points (K, 3) in the camera frame lie in the image, as a mask (K,)."""
    z = in_cam[:, 2].clamp_min(1e-3)
    x, y = camera.fx * in_cam[:, 0] / z + camera.cx, camera.fy * in_cam[:, 1] / z + camera.cy
    return (in_cam[:, 2] > 1e-3) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
