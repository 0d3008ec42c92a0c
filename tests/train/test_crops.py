"""Training in crops: each photograph is covered evenly, and the crops together are the photograph."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pipelines.splat.densify import DefaultStrategy
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import photometric_loss
from pipelines.splat.rasterizer.api import RasterSettings, Window
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.surface import ObservedPoints, SurfaceSettings
from pipelines.survey.photographs import ImageCache, Pinholes
from pipelines.train.losses import RenderedView, training_losses, weighted_sum
from pipelines.train.region import RegionMasks
from pipelines.train.schedule import JointOptions, TrainingSchedule
from pipelines.train.target_images import Crops, ImageLook, TargetImages
from tests import tiny_training as tiny

pytestmark = pytest.mark.usefixtures("one_thread")
CROPS = Crops(32)
ROUND = CROPS.count(64, 48)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageCache:
    return tiny.photographs(tmp_path_factory.mktemp("photos"), tiny.true_gaussians())


@pytest.mark.parametrize(
    ("size", "size_px"),
    [((64, 48), 32), ((640, 480), 100), ((5472, 3648), 1024), ((3000, 1), 32), ((1, 3000), 32), ((7, 900), 32)],
)
def test_crops_cover_each_pixel_once_and_are_small_enough(size: tuple[int, int], size_px: int) -> None:
    width, height = size
    crops = Crops(size_px, seed=3)
    whole = Window(5, 9, width, height)
    for turn in range(3):
        seen = np.zeros((height + 9, width + 5), dtype=np.uint8)
        cells = crops.of(7, whole, turn)
        assert len(cells) == crops.count(width, height)
        for window in cells:
            seen[window.slices] += 1
            # Cuts are shifted by an eighth of a cell.
            assert window.width * window.height <= 1.35 * size_px**2 or size_px**2 > width * height
        assert (seen[9:, 5:] == 1).all() and seen.sum() == width * height
    largest = crops.largest_of(tiny.PINHOLE)
    for turn in range(20):
        for window in crops.of(0, Window(0, 0, tiny.PINHOLE.width, tiny.PINHOLE.height), turn):
            assert window.width <= largest.width and window.height <= largest.height


def test_each_round_of_visits_shows_each_pixel_once(images: ImageCache) -> None:
    targets = TargetImages(images, Pinholes(images), torch.device("cpu"), crops=CROPS)
    whole = TargetImages(images, Pinholes(images), torch.device("cpu")).get(ImageLook(2))
    places = []
    for turn in range(2):
        shown = torch.full_like(whole.colour, torch.nan)
        for visit in range(ROUND):
            target = targets.get(ImageLook(2, visit=ROUND * turn + visit))
            assert target.part.window is not None and target.part.crops == ROUND
            assert torch.isnan(shown[target.part.window.slices]).all()
            shown[target.part.window.slices] = target.colour
            places.append(target.part.window)
        assert torch.equal(shown, whole.colour)
    assert len(set(places)) > ROUND, "cuts move from round to round"


def losses(targets: TargetImages, looks: list[ImageLook], gaussians: Gaussians, ssim: float) -> Iterator[tuple]:
    """Target, weighted loss and statistics of each look, with gradients added to the Gaussians."""
    for look in looks:
        target = targets.get(look)
        pose = torch.eye(4)
        pose[0, 3] = -float(tiny.poses().cam_center_in_model[look.index, 0])
        render = CpuRasterizer().render(
            gaussians, pose, target.whole, RasterSettings(sh_degree=0, window=target.part.window)
        )
        loss = photometric_loss(render.colour, target.colour, target.mask, ssim_weight=ssim)
        (target.part.weight * loss / target.part.crops).backward()
        yield target, float(target.part.weight * loss.detach() / target.part.crops), render.stats


def leaves() -> Gaussians:
    truth = tiny.true_gaussians()
    long = truth.log_scales + torch.tensor([0.3, 0.0, -0.3])
    moved = replace(truth, means=truth.means + 0.05, sh=0.5 * truth.sh, log_scales=long)
    return Gaussians(**{name: value.clone().requires_grad_() for name, value in moved.tensors().items()})


@pytest.mark.parametrize("region", [False, True])
def test_crops_add_up_to_the_loss_of_the_photograph(images: ImageCache, region: bool) -> None:
    """Without SSIM exactly; SSIM sees zeros beyond a cut, as beyond the photograph's edge.

    A third of these small crops lies within the five pixels from a cut that SSIM reaches.
    """
    mask = np.zeros((48, 64), dtype=bool)
    mask[4:44, 10:60] = True
    mask[30:, 40:] = False
    masks = RegionMasks({1: mask}) if region else None
    parts, whole = (
        TargetImages(images, Pinholes(images), torch.device("cpu"), masks, crops) for crops in (Crops(30), None)
    )
    count = parts.get(ImageLook(1, visit=0)).part.crops
    assert count > 2
    for ssim, tolerance in ((0.0, 1e-5), (0.2, 0.3)):
        one, many = leaves(), leaves()
        ((_, expected, _),) = losses(whole, [ImageLook(1)], one, ssim)
        values = [
            loss for _, loss, _ in losses(parts, [ImageLook(1, visit=visit) for visit in range(count)], many, ssim)
        ]
        assert sum(values) == pytest.approx(expected, rel=tolerance / 2)
        for name, tensor in one.tensors().items():
            gradient, other = tensor.grad, many.tensors()[name].grad
            assert gradient is not None and other is not None
            assert float((gradient - other).norm() / gradient.norm()) <= tolerance, name


def recorded(images: ImageCache, crops: Crops | None, iterations: int) -> tuple[Tensor, Tensor]:
    """Gradients and observations that density control has recorded in a training in which nothing moves."""
    options = JointOptions(10_000, sh_degree=0, crops=crops, solution_rate=0)
    trainer = tiny.trainer(images, options)
    trainer.optimizer.rate_factor = 0.0
    trainer.strategy = DefaultStrategy(
        replace(tiny.SETTINGS, stop=0), tiny.EXTENT_M, len(trainer.optimizer.gaussians)
    )
    for _ in range(iterations):
        trainer.step()
    state = trainer.strategy.state()
    return state["gradient_sum"], state["observations"]


def test_density_control_sees_what_it_sees_of_whole_photographs(
    images: ImageCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a round of all crops: as many observations, and gradients of the photographs' losses.

    The gradient of a Gaussian on a cut comes in parts, whose lengths add up to more than the length of their sum.
    """
    # A round of crops takes several iterations, which have several backgrounds.
    monkeypatch.setattr("pipelines.train.trainer.training_background", lambda iteration: (0.0, 0.0, 0.0))
    views = len(images)
    gradient, observations = recorded(images, None, views)
    in_parts, observed = recorded(images, CROPS, ROUND * views)
    assert torch.equal(observations, observed)
    ratio = (in_parts / gradient)[gradient > 0.1 * gradient.median()]
    low, middle, high = ratio.quantile(torch.tensor([0.05, 0.5, 0.95])).tolist()
    assert low > 0.95 and 0.99 < middle < 1.1 and high < 2.5, (low, middle, high)


def test_each_place_belongs_to_one_crop_of_a_round(images: ImageCache) -> None:
    targets = TargetImages(images, Pinholes(images), torch.device("cpu"), crops=CROPS)
    for turn in range(3):
        seen = 0
        for visit in range(ROUND):
            target = targets.get(ImageLook(0, visit=ROUND * turn + visit))
            place = torch.tensor([[20.3, 31.8], [50.1, 7.2], [-9.0, 60.0]])  # the last beyond a corner
            low, high = torch.tensor(target.part.low), torch.tensor(target.part.high)
            seen += int(((place >= low) & (place < high)).all(dim=1).sum())
        assert seen == len(place)


def test_crops_add_up_to_the_surface_losses_of_the_photograph(images: ImageCache) -> None:
    """By its points and its pixels; depths are interpolated among fewer pixels beside a cut."""
    parts, whole = (TargetImages(images, Pinholes(images), torch.device("cpu"), crops=c) for c in (CROPS, None))
    random = torch.Generator().manual_seed(1)
    near = torch.rand(400, 3, generator=random) * torch.tensor([2.0, 3.0, 0.4]) + torch.tensor([-1.9, -1.5, 4.1])
    points = ObservedPoints(near)  # most of them in the left half
    gaussians, pose = tiny.true_gaussians(), torch.eye(4)
    for settings in (SurfaceSettings(1.0, 0, 0, 0), SurfaceSettings(0, 1.0, 0, 0)):
        schedule = TrainingSchedule(JointOptions(10, surface=settings), np.arange(len(images)))
        trainer = tiny.trainer(images, schedule.options)
        every = training_losses(trainer.problem, trainer.strategy, schedule, extent_m=tiny.EXTENT_M)
        losses = [loss for loss in every if loss.name in ("flatness", "compactness", "depth", "normals")]
        values = []
        for targets, looks in (
            (whole, [ImageLook(1)]),
            (parts, [ImageLook(1, visit=visit) for visit in range(ROUND)]),
        ):
            for target in map(targets.get, looks):
                raster = RasterSettings(sh_degree=0, depth=True, median=False, window=target.part.window)
                render = CpuRasterizer().render(gaussians, pose, target.whole, raster)
                view = RenderedView(
                    1,
                    pose,
                    target,
                    gaussians,
                    None,
                    len(gaussians),
                    render,
                    render.stats,
                    render.colour,
                    points=points,
                )
                values.append(float(weighted_sum(losses, view, 1)[0]))
        assert np.mean(values[1:]) == pytest.approx(values[0], rel=0.02)
        assert max(values[1:]) > 1.1 * min(values[1:]), "crops differ"
