"""Project the time of large surveys from the models of SfM and blocks: python examples/benchmarks/projection.py.

Nothing is reconstructed or trained: surveys are made up, divided into blocks, and the models that were fitted to
small surveys (pipelines/jobs/costs.py) are evaluated at their sizes. What is printed is a
projection, for processors only: nothing was measured on a GPU.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from block_plan import made_up_scene

from pipelines.sfm.estimate import estimated_cost
from pipelines.sfm.options import SfmOptions
from pipelines.survey.block_plan import BlockPlan
from pipelines.survey.scene import Scene
from pipelines.train.blocks.plan import plan_blocks
from pipelines.train.estimate import block_processor_s
from pipelines.train.options import PlanOptions, TrainOptions

PHOTO_PX = (5280, 3956)
TRAINED_PX = 1600
GAUSSIANS_A_PHOTOGRAPH = 2000
# Two one-thread workers do 1.88 times the work of one (examples/benchmarks/cluster.py); more were not measured.
SHARING = 0.94


@dataclass(frozen=True)
class Machines:
    """Machines for one survey: their cores, and what one worker of the training has; none with a GPU.

    Attributes:
        cores: of all machines.
        workers: that train at the same time.
        memory_gib: of a worker.
    """

    cores: int
    workers: int
    memory_gib: float


COLUMNS = {
    "2 cores": Machines(2, 2, 8.0),
    "32 cores": Machines(32, 32, 8.0),
}


def plan_of(scene: Scene, machines: Machines) -> BlockPlan:
    """Return as many blocks as the memory of a worker demands, and at least one for each worker."""
    options = PlanOptions(
        block_memory=machines.memory_gib,
        max_gaussians=GAUSSIANS_A_PHOTOGRAPH * len(scene.train),
        max_image_size=TRAINED_PX,
        sh_degree=3,
    )
    plan = plan_blocks(scene, options)
    if len(plan.blocks) >= machines.workers:
        return plan
    return plan_blocks(scene, options.model_copy(update={"blocks": machines.workers, "block_memory": None}))


def projected(count: int, scene: Scene, machines: Machines) -> list[str]:
    """Return the steps of a survey on some machines: times, and the number and memory of the blocks."""
    reconstruction = estimated_cost(count, PHOTO_PX, SfmOptions())
    plan = plan_of(scene, machines)
    options = TrainOptions(preset="standard", max_image_size=TRAINED_PX)
    whole = block_processor_s(plan, PHOTO_PX, options)
    blocks = block_processor_s(plan, PHOTO_PX, options.model_copy(update={"dense": False}))
    sfm = (reconstruction.features_s + reconstruction.matching_s) / machines.cores / SHARING
    stereo = (sum(whole.values()) - sum(blocks.values())) / machines.cores / SHARING
    # The longest block is the least time, however many workers there are.
    together = sum(blocks.values()) / machines.workers / SHARING
    training = max(together, *blocks.values())
    peak_gib = max(block.peak_bytes for block in plan.blocks) / 2**30
    size = f"{len(plan.blocks)} of {peak_gib:.1f} GiB"
    times = (sfm, reconstruction.mapping_s, stereo, training)
    return [*map(hours, times), size, hours(sum(times))]


def hours(seconds: float) -> str:
    """Return a duration with two digits."""
    return f"{seconds / 3600:.2g} h" if seconds >= 3600 else f"{seconds / 60:.2g} min"


def main() -> None:
    """Print the projection as a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, nargs="+", default=[1000, 10_000])
    args = parser.parse_args()
    print("| photographs | step | " + " | ".join(COLUMNS) + " |\n" + "|---" * (2 + len(COLUMNS)) + "|")
    steps = ("features and matches", "mapping, in one process", "stereo", "training", "blocks", "together")
    for count in args.photographs:
        scene = made_up_scene(count, 1000)
        columns = [projected(count, scene, machines) for machines in COLUMNS.values()]
        for step, *cells in zip(steps, *columns, strict=True):
            print(f"| {count} | {step} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
