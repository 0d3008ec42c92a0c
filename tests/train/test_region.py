"""A training that is confined to a region: its pixels, its window, and what stands in for the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipelines.geometry.cameras import pose_matrix
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.survey.block_plan import BlockCell
from pipelines.train.region import RegionMasks, SceneBox, TrainingRegion, region_mask, stand_in_depth
from pipelines.train.schedule import JointOptions
from pipelines.train.trainer import JointTrainer
from tests import tiny_training as tiny

WEST = BlockCell(high=(0.0, None))
WALL_M = 4.0

pytestmark = pytest.mark.usefixtures("one_thread")


def pose_of(index: int) -> np.ndarray:
    poses = tiny.poses()
    return pose_matrix(poses.cam_from_model[index], poses.cam_center_in_model[index])


def wall_depth() -> np.ndarray:
    """Depth of the wall of `tiny_training`, which the cameras look at straight."""
    return np.full((tiny.PINHOLE.height, tiny.PINHOLE.width), WALL_M, dtype=np.float32)


@pytest.mark.parametrize("index", [0, 2, 5])
def test_mask_ends_where_the_cell_does(index: int) -> None:
    pose = pose_of(index)
    x = tiny.poses().cam_center_in_model[index, 0]
    mask = region_mask(pose, tiny.PINHOLE, WEST, None, wall_depth())
    column = tiny.PINHOLE.cx - tiny.PINHOLE.fx * x / WALL_M  # of the plane x = 0 on the wall
    expected = np.arange(tiny.PINHOLE.width) + 0.5 < column
    np.testing.assert_array_equal(mask, np.tile(expected, (tiny.PINHOLE.height, 1)))


def test_known_depth_comes_before_the_stand_in() -> None:
    """The camera at x = −1 sees the plane x = 0 further to the right, the nearer the surface is."""
    pose, known = pose_of(0), np.zeros((24, 32), dtype=np.float32)
    known[12:] = 1.0  # half the size of the image; the upper half is unknown
    mask = region_mask(pose, tiny.PINHOLE, WEST, known, wall_depth())
    assert mask[:24].sum(axis=1).tolist() == [47] * 24
    assert mask[24:].all()


def test_bands_of_rows_give_the_same_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, depth = pose_of(1), wall_depth() + np.arange(48, dtype=np.float32)[:, None] / 50
    expected = region_mask(pose, tiny.PINHOLE, WEST, None, depth)
    monkeypatch.setattr("pipelines.train.region._BAND_PX", 5 * tiny.PINHOLE.width)
    np.testing.assert_array_equal(region_mask(pose, tiny.PINHOLE, WEST, None, depth), expected)
    assert expected.any() and not expected.all()


def test_sky_belongs_to_the_cell_in_its_direction() -> None:
    empty = Gaussians.concatenate([tiny.true_gaussians(1)])
    empty.logit_opacities[:] = -9.0
    pose = pose_of(3)
    depth = stand_in_depth(empty, pose, tiny.PINHOLE, CpuRasterizer())
    mask = region_mask(pose, tiny.PINHOLE, WEST, None, depth)
    np.testing.assert_array_equal(mask, np.tile(np.arange(64) < 32, (48, 1)))


@pytest.mark.parametrize("shrink", [1, 2])
def test_window_is_the_smallest_with_the_whole_mask(shrink: int) -> None:
    mask = np.zeros((48, 64), dtype=bool)
    mask[8:20, 30:44] = True
    masks = RegionMasks({3: mask, 4: np.zeros((48, 64), dtype=bool)})
    view = masks.view(3, shrink)
    window = view.window
    assert (window.top, window.left, window.height, window.width) == tuple(v // shrink for v in (8, 30, 12, 14))
    assert view.mask.all()
    assert masks.seeing.tolist() == [3]
    assert masks.view(3).mask.sum() == 12 * 14


def confined(folder: Path, *, spoiled: bool) -> JointTrainer:
    """A trainer of the western half of the wall, whose photographs may be white in the east."""
    folder.mkdir()
    truth = tiny.true_gaussians()
    images = tiny.photographs(folder, truth)
    masks = {}
    for index in range(6):
        masks[index] = region_mask(pose_of(index), tiny.PINHOLE, WEST, None, wall_depth())
        if spoiled:
            file = folder / f"{index}.png"
            pixels = cv2.imread(str(file))
            pixels[~masks[index]] = 255
            cv2.imwrite(str(file), pixels)
    east = truth.select(truth.means[:, 0] >= 0)
    nothing = truth.select(torch.zeros(0, dtype=torch.int64))
    region = TrainingRegion(WEST, SceneBox.around(truth.means.double().numpy()), east, nothing, RegionMasks(masks))
    made = tiny.trainer(images, JointOptions(40, sh_degree=1))
    own = made.optimizer.gaussians.detached().select(truth.means[:, 0] < 0)
    return replace_region(made, own, region)


def replace_region(made: JointTrainer, own: Gaussians, region: TrainingRegion) -> JointTrainer:
    """The same trainer for other Gaussians, in a region."""
    from pipelines.splat.densify import DefaultStrategy
    from pipelines.splat.optimizer import GaussianAdam

    return JointTrainer(
        GaussianAdam(own, tiny.EXTENT_M, made.options.iterations),
        DefaultStrategy(replace(tiny.SETTINGS, stop=0), tiny.EXTENT_M, len(own)),
        made.problem,
        made.views,
        rasterizer=made.rasterizer,
        options=made.options,
        region=region,
    )


def test_photographs_beyond_the_region_change_nothing(tmp_path: Path) -> None:
    ends = []
    for spoiled in (False, True):
        trainer = confined(tmp_path / str(spoiled), spoiled=spoiled)
        reports = [trainer.step() for _ in range(40)]
        ends.append(trainer.optimizer.gaussians.detached())
        assert reports[-1].losses["photometric"] < 0.7 * reports[0].losses["photometric"]
        # Cut to the part of the photograph that shows the region.
        assert max(report.pixels for report in reports) < 0.9 * 64 * 48
    for name, values in ends[0].tensors().items():
        torch.testing.assert_close(ends[1].tensors()[name], values, rtol=0, atol=0)


def test_what_stands_in_stays_as_it_is(tmp_path: Path) -> None:
    trainer = confined(tmp_path / "one", spoiled=False)
    assert trainer.region is not None
    before = {name: values.clone() for name, values in trainer.region.surroundings.tensors().items()}
    count = len(trainer.optimizer.gaussians)
    for _ in range(10):
        trainer.step()
    assert len(trainer.optimizer.gaussians) == count
    for name, values in trainer.region.surroundings.tensors().items():
        torch.testing.assert_close(values, before[name], rtol=0, atol=0)
