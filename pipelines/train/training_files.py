"""Files of a training in the folder of its stage, and the training that writes them."""

from __future__ import annotations

import logging
import shutil

from pipelines.core.workspace import StageRun
from pipelines.train.loop import LoopOptions, TrainingRecord, optimise
from pipelines.train.options import TrainOptions
from pipelines.train.trainer import JointTrainer

CHECKPOINT, METRICS = "checkpoint.npz", "metrics.jsonl"

log = logging.getLogger(__name__)


def train_in_folder(stage: StageRun, trainer: JointTrainer, options: TrainOptions, done: int = 0) -> TrainingRecord:
    """Run all remaining iterations of a training, and return its record.

    An interrupted run is resumed. A finished training of fewer iterations is extended from its last state.

    Args:
        stage: has the folder.
        trainer: before its first iteration.
        options: of the training.
        done: iterations of the finished training that the stage extends.

    Raises:
        KeyboardInterrupt: the user asked to stop; a checkpoint was written.
        ConvergenceError: the training diverged twice.
        InputError: the checkpoint cannot be read.
        StorageError: a file cannot be written or copied.
    """
    extend = not stage.resumed and _take_over(stage, options.effort.iterations, done)
    files = LoopOptions(
        stage.out / CHECKPOINT,
        stage.out / METRICS,
        options.checkpoint_every,
        options.log_every,
        resume=stage.resumed or extend,
        extend=extend,
        note=stage.record_progress,
    )
    return optimise(trainer, files, stage.progress)


def _take_over(stage: StageRun, iterations: int, done: int) -> bool:
    """Copy the last state of a finished training of fewer iterations, and return whether there is one."""
    if stage.extends is None or not all((stage.extends / name).is_file() for name in (CHECKPOINT, METRICS)):
        return False
    if done >= iterations:
        return False
    log.info("the training of %d iterations is extended to %d; --force trains afresh", done, iterations)
    for name in (CHECKPOINT, METRICS):
        shutil.copyfile(stage.extends / name, stage.out / name)
    return True
