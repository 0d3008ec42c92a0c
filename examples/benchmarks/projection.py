"""Project the time of large surveys from the models of SfM and training: python examples/benchmarks/projection.py.

Nothing is reconstructed or trained: surveys of photographs of 1600×1200 are made up, divided into blocks where one
training does not fit, and the models of pipelines/jobs/costs.py are evaluated at their sizes, for processors only.
Each cell says whether it is projected or was measured; results/scale.md has the measured survey.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from block_plan import made_up_scene

from pipelines.jobs.costs import MEASURED_CORES
from pipelines.sfm.estimate import estimated_cost
from pipelines.sfm.options import SfmOptions
from pipelines.survey.block_plan import BlockPlan
from pipelines.survey.scene import SparseScene
from pipelines.train.blocks.plan import plan_blocks
from pipelines.train.estimate import block_processor_s, training_pinhole, with_effort
from pipelines.train.options import PlanOptions, Preset, TrainOptions

PHOTO_PX = (1600, 1200)
STEPS = ("features and matches", "mapping, in one process", "stereo", "training", "blocks", "together")
# Seconds of steps, by photographs and machines, on 2 cores of an AMD EPYC without AVX-512, 2026-11-26.
MEASURED = {
    (1000, "2 cores"): {
        "features and matches": 900.0,
        "mapping, in one process": 410.0,
        "stereo": 232.0,
        "training": 2195.0,
    }
}
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
    "2 cores": Machines(2, 1, 20.0),
    "32 cores": Machines(32, 32, 8.0),
}


def plan_of(scene: SparseScene, machines: Machines, effort: Preset) -> BlockPlan:
    """Return as many blocks as the memory of a worker demands, and at least one for each worker."""
    options = PlanOptions(
        block_memory=machines.memory_gib,
        max_gaussians=effort.max_gaussians,
        max_image_size=effort.max_image_size,
        sh_degree=3,
    )
    plan = plan_blocks(scene, options)
    if len(plan.blocks) >= machines.workers:
        return plan
    return plan_blocks(scene, options.model_copy(update={"blocks": machines.workers, "block_memory": None}))


def projected(count: int, scene: SparseScene, name: str) -> list[str]:
    """Return the steps of a survey on some machines: times, and the number and memory of the blocks."""
    machines, measured = COLUMNS[name], MEASURED.get((count, name), {})
    reconstruction = estimated_cost(count, PHOTO_PX, SfmOptions())
    standard = TrainOptions(preset="standard")
    options = with_effort(standard, count, training_pinhole(PHOTO_PX, standard), None)
    plan = plan_of(scene, machines, options.effort)
    whole = block_processor_s(plan, PHOTO_PX, options)
    blocks = block_processor_s(plan, PHOTO_PX, options.model_copy(update={"dense": False}))
    each = machines.cores / machines.workers
    # The longest block is the least time, however many workers there are.
    training = max(sum(blocks.values()) / machines.cores / SHARING, max(blocks.values()) / each)
    times = {
        "features and matches": (reconstruction.features_s + reconstruction.matching_s) / machines.cores / SHARING,
        "mapping, in one process": reconstruction.mapping_s / min(machines.cores, MEASURED_CORES),
        "stereo": (sum(whole.values()) - sum(blocks.values())) / machines.cores / SHARING,
        "training": training,
    }
    peak_gib = max(block.peak_bytes for block in plan.blocks) / 2**30
    cells = {step: f"{hours(seconds)} (projected)" for step, seconds in times.items()}
    cells |= {
        step: f"{hours(seconds)} (measured; projected {hours(times[step])})" for step, seconds in measured.items()
    }
    total = sum((times | measured).values())
    cells |= {"blocks": f"{len(plan.blocks)} of {peak_gib:.1f} GiB (projected)", "together": hours(total)}
    return [cells[step] for step in STEPS]


def hours(seconds: float) -> str:
    """Return a duration with two digits."""
    return f"{seconds / 3600:.2g} h" if seconds >= 3600 else f"{seconds / 60:.2g} min"


def main() -> None:
    """Print the projection as a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, nargs="+", default=[1000, 10_000])
    args = parser.parse_args()
    print("| photographs | step | " + " | ".join(COLUMNS) + " |\n" + "|---" * (2 + len(COLUMNS)) + "|")
    for count in args.photographs:
        scene = made_up_scene(count, 1000)
        columns = [projected(count, scene, name) for name in COLUMNS]
        for step, *cells in zip(STEPS, *columns, strict=True):
            print(f"| {count} | {step} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
