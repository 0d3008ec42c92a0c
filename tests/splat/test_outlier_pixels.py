"""Pixels that disagree with the model: an object in one photograph of six, and noise that is none."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
import torch
from torch import Tensor

from pipelines.splat.outlier_pixels import OutlierPixels, OutlierSettings
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.train.schedule import JointOptions
from tests import tiny_training as tiny

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")
SQUARE = (slice(16, 32), slice(24, 40))  # four cells, a twelfth of the photograph


def scene(noise: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A smooth render, and its photograph with leaves that have moved: other colours, pixel by pixel."""
    random = torch.Generator().manual_seed(seed)
    rendered = torch.linspace(0.2, 0.6, 64)[None, :, None].repeat(48, 1, 3)
    return rendered, rendered + noise * torch.randn(48, 64, 3, generator=random)


def test_an_object_is_left_out_and_leaves_in_wind_are_not() -> None:
    outliers = OutlierPixels(CPU, OutlierSettings(views=6, most=0.2))
    for seed in range(6):
        assert outliers.inliers(*scene(0.1, seed), None, 64) is None
    mask = outliers.inliers(*scene(0.1, 7), None, 64)
    assert mask is not None and mask.float().mean() > 0.98
    rendered, photograph = scene(0.1, 8)
    photograph[SQUARE] = torch.tensor([0.9, 0.1, 0.1])
    mask = outliers.inliers(rendered, photograph, None, 64)
    assert mask is not None and not mask[SQUARE].any()
    mask[8:40, 16:48] = True  # the object and the cells around it
    assert mask.float().mean() > 0.98


def ghost(folder: Path, outliers: OutlierPixels | None, *, moving: bool = True) -> float:
    """Mean error of the trained wall where the middle one of three photographs shows a red square, if one moves."""
    folder.mkdir()
    images = tiny.photographs(folder, tiny.true_gaussians(), (1.0, 1.0, 1.0))
    clean = torch.from_numpy(images.image(1).copy()).float() / 255
    file = folder / "1.png"
    pixels = cv2.imread(str(file))
    if moving:
        pixels[SQUARE] = (0, 0, 255)
    cv2.imwrite(str(file), pixels)
    trainer = tiny.trainer(images, JointOptions(300, sh_degree=1), outliers=outliers)
    for _ in range(200):
        trainer.step()
    settings = RasterSettings(sh_degree=1)
    colour = CpuRasterizer().render(trainer.optimizer.gaussians, torch.eye(4), tiny.PINHOLE, settings).colour
    return float((colour.detach() - clean)[SQUARE].abs().mean())


@pytest.mark.slow
def test_a_moving_object_does_not_remain_in_the_splat(tmp_path: Path) -> None:
    """Most of what the object adds to the error disappears; the rest was learned before outliers are looked for."""
    nothing = ghost(tmp_path / "nothing", None, moving=False)
    plain = ghost(tmp_path / "plain", None)
    robust = ghost(tmp_path / "robust", OutlierPixels(CPU, OutlierSettings(views=30, most=0.2)))
    assert plain > nothing + 0.02, "otherwise there is nothing to remove"
    assert robust - nothing < 0.4 * (plain - nothing), (nothing, robust, plain)


def test_state_goes_on_where_it_was() -> None:
    one, two = (OutlierPixels(CPU, OutlierSettings(most=0.2)) for _ in range(2))
    for seed in range(60):
        one.inliers(*scene(0.1, seed), None, 64)
    two.restore(one.state())
    rendered, photograph = scene(0.1, 99)
    photograph[SQUARE] = 1.0
    first, second = (each.inliers(rendered, photograph, None, 64) for each in (one, two))
    assert first is not None and second is not None and torch.equal(first, second) and not first.all()
