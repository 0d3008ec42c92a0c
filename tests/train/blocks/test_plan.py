"""Plan of a survey whose surface and cameras are known."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.core.errors import ResourceError
from pipelines.survey.scene import SparseScene, initial_scene
from pipelines.train.blocks.plan import observed_surface, plan_blocks
from pipelines.train.options import PlanOptions
from tests.refusals import refused
from tests.scenes import Measured, Noise, initial, make_scene, sparse_model, survey_of

OPTIONS = PlanOptions(max_gaussians=100_000, max_image_size=320, sh_degree=3, blocks=4)


def flat_scene() -> SparseScene:
    """Sixty-four cameras in a grid that look straight down on 120 m of ground, 80 m below."""
    scene, rng = make_scene("grid", images=64, points=3000), np.random.default_rng(0)
    return initial_scene(sparse_model(scene, Noise(), rng), survey_of(scene, Noise(), Measured(), rng), initial())


@pytest.fixture(scope="module")
def scene() -> SparseScene:
    return flat_scene()


def test_shares_of_blocks_and_views(scene: SparseScene) -> None:
    plan = plan_blocks(scene, OPTIONS)
    assert len(plan.blocks) == 4
    np.testing.assert_allclose([block.share for block in plan.blocks], 0.25, atol=0.01)
    assert sum(block.share for block in plan.blocks) == pytest.approx(1.0)
    surface = observed_surface(scene)
    shares = [surface.share_in_views(block.cell.contains(surface.point_in_model), 64) for block in plan.blocks]
    np.testing.assert_allclose(np.sum(shares, axis=0), 1.0)  # what an image shows lies in one of the cells


def test_cameras_of_a_block_are_those_that_see_it(scene: SparseScene) -> None:
    """On flat ground below level cameras, an image shows a block if its footprint reaches into it."""
    half = 80.0 * np.array([600 / 1020.0, 450 / 1018.0])  # of a footprint, metres
    for block in plan_blocks(scene, OPTIONS).blocks:
        index = scene.sparse.image_index()
        chosen = {index[name] for name in block.cameras}
        for camera in range(64):
            center, share = scene.poses.cam_center_in_model[camera, :2], 1.0
            for axis in (0, 1):
                low = -np.inf if block.region.low[axis] is None else block.region.low[axis]
                high = np.inf if block.region.high[axis] is None else block.region.high[axis]
                inside = min(high, center[axis] + half[axis]) - max(low, center[axis] - half[axis])
                share *= float(np.clip(inside / (2 * half[axis]), 0, 1))
            # Points up to 20 m above the ground, and the edge of the points, blur the share by a tenth or so.
            if share > 0.3:
                assert camera in chosen
            elif share == 0.0:
                assert camera not in chosen


def test_memory_decides_on_the_number(scene: SparseScene) -> None:
    # So many Gaussians that they, not the process around them, take the memory.
    many = OPTIONS.model_copy(update={"max_gaussians": 2_000_000})
    whole = plan_blocks(scene, many.model_copy(update={"blocks": 1})).blocks[0]
    for gib in (0.9 * whole.peak_bytes / 2**30, 0.62 * whole.peak_bytes / 2**30):
        plan = plan_blocks(scene, many.model_copy(update={"blocks": None, "block_memory": gib}))
        assert len(plan.blocks) > 1
        assert max(block.peak_bytes for block in plan.blocks) <= 0.9 * gib * 2**30
    enough = many.model_copy(update={"blocks": None, "block_memory": 1.2 * whole.peak_bytes / 2**30})
    assert len(plan_blocks(scene, enough).blocks) == 1
    with refused("not-enough-memory", ResourceError):
        plan_blocks(scene, OPTIONS.model_copy(update={"blocks": None, "block_memory": 0.05}))


def test_visible_gaussians_are_counted(scene: SparseScene) -> None:
    """A view of the one block shows the share of the ground that lies in its footprint."""
    plan = plan_blocks(scene, OPTIONS.model_copy(update={"blocks": 1}))
    points = scene.point_in_model
    in_view = []
    for camera in range(64):
        in_cam = (points - scene.poses.cam_center_in_model[camera]) @ scene.poses.cam_from_model[camera].T
        slope = np.abs(in_cam[:, :2] / in_cam[:, 2:])
        in_view.append(((slope < [600 / 1020, 450 / 1018]).all(axis=1)).mean())
    assert plan.blocks[0].visible == pytest.approx(100_000 * np.mean(in_view), rel=0.2)


def test_few_observations_tell_the_same(scene: SparseScene) -> None:
    few = observed_surface(scene, most_observations=len(scene.sparse.obs_point) // 4)
    every = observed_surface(scene)
    assert len(few.obs_point) < 0.3 * len(every.obs_point)
    cell = plan_blocks(scene, OPTIONS).blocks[0].cell
    shares = [each.surface[cell.contains(each.point_in_model)].sum() for each in (few, every)]
    assert shares[0] == pytest.approx(shares[1], abs=0.05)
