"""The cost of blocks: the model is found again from measured blocks, and a plan's estimate follows its sizes."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.jobs.costs import BUSY_CORES, COSTS, SURFACE_FACTOR, Work
from pipelines.survey.block_plan import BlockCell, BlockPlan, PlannedBlock
from pipelines.train.estimate import block_processor_s
from pipelines.train.options import TrainOptions
from tests.scripts import REPOSITORY, load_script

PHOTO_PX = (640, 480)
SCRIPT = load_script(REPOSITORY / "examples/benchmarks/fitted_cost.py")


def test_the_model_is_found_again() -> None:
    """From 16 blocks measured to 3 %, predictions are right to 5 %: four unknowns take a quarter of the noise."""
    rng = np.random.default_rng(0)
    truth = Work(0.004, megapixels=0.2, visible=1.2, gaussians=0.3)
    sizes = rng.uniform([3e4, 5e2, 5e3], [3e5, 2e4, 1e5], (16, 3))
    seconds = np.array([truth.of(work_of(*size)) for size in sizes])
    fitted = SCRIPT.fitted_cost(sizes, seconds * (1 + 0.03 * rng.standard_normal(16)))
    found = [fitted.of(work_of(*size)) for size in sizes]
    np.testing.assert_allclose(found, seconds, rtol=0.05)
    assert min(fitted) >= 0


def work_of(*size: float) -> Work:
    work: Work = SCRIPT.work_of(np.array(size))
    return work


def plan(*blocks: tuple[float, float, int]) -> BlockPlan:
    """Plan of blocks with these pixels, visible Gaussians and Gaussians."""
    planned = tuple(
        PlannedBlock(
            id=number,
            cell=BlockCell(),
            margin_m=(1.0, 1.0),
            cameras=("a.jpg", "b.jpg"),
            share=0.5,
            gaussians=count,
            visible=visible,
            view_px=pixels,
            peak_bytes=1,
        )
        for number, (pixels, visible, count) in enumerate(blocks)
    )
    return BlockPlan(blocks=planned, gaussians=10_000, scaffold_gaussians=500, photographs=2)


def test_an_estimate_is_that_of_its_iterations() -> None:
    options = TrainOptions(
        iterations=300, dense=False, coarse_to_fine=False, geometry_regularisation=False, max_image_size=640
    )
    document = plan((50_000, 3_000, 8_000), (25_000, 1_000, 2_000))
    predicted = block_processor_s(document, PHOTO_PX, options)
    # A block's iterations see the scaffold around it, too.
    expected = [
        300 * BUSY_CORES * COSTS["iteration"].of(work_of(5e4, 3e3, 8_500)),
        300 * BUSY_CORES * COSTS["iteration"].of(work_of(2.5e4, 1e3, 2_500)),
    ]
    np.testing.assert_allclose([predicted[0], predicted[1]], expected)
    surface = block_processor_s(document, PHOTO_PX, options.model_copy(update={"geometry_regularisation": True}))
    assert surface[0] == pytest.approx(SURFACE_FACTOR * predicted[0])
    coarse = block_processor_s(document, PHOTO_PX, options.model_copy(update={"coarse_to_fine": True}))
    assert predicted[0] / 4 < coarse[0] < predicted[0]  # a part of the iterations is of shrunken photographs
    dense = block_processor_s(document, PHOTO_PX, options.model_copy(update={"dense": True}))
    assert dense[0] - predicted[0] == pytest.approx(dense[1] - predicted[1])  # stereo of two photographs each
