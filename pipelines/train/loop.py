"""Training loop: iterations, metrics, checkpoints, progress, interruption, and one recovery from a divergence."""

import json
import logging
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pipelines.core.errors import ConvergenceError, DamagedPartialError, InputError
from pipelines.core.progress import Progress, deferred_interrupts
from pipelines.core.workspace import StageRun
from pipelines.jobs.costs import TimeLeft
from pipelines.splat.gaussians import NonFiniteError
from pipelines.train.options import TrainOptions
from pipelines.train.trainer import JointTrainer, StepReport, load_checkpoint, save_checkpoint

log = logging.getLogger(__name__)

CHECKPOINT, METRICS = "checkpoint.npz", "metrics.jsonl"
_RECOVERY_RATE = 0.3  # factor on the learning rates after a divergence


@dataclass(frozen=True)
class LoopOptions:
    """Files of a training, and intervals of writing them."""

    checkpoint: Path
    metrics: Path  # one JSON object a line
    checkpoint_every: int = 500  # iterations
    log_every: int = 10  # iterations
    resume: bool = False  # continue from the checkpoint, if the file exists
    extend: bool = False  # the checkpoint is that of a finished, shorter training
    # receives how far the training has come, after each checkpoint (`1500 of 7000 iterations, 12 min`)
    note: Callable[[str], None] = lambda _text: None


@dataclass(frozen=True)
class TrainingRecord:
    """Time and incidents of a training."""

    seconds: float  # duration; of an interrupted training, the sum over its runs
    recovery: str | None  # what value was not finite, and the recovery; None: all were finite
    processor_s: float = math.nan  # of all processors, for one iteration; NaN where no second one ran


def optimise(trainer: JointTrainer, options: LoopOptions, progress: Progress) -> TrainingRecord:
    """Run all remaining iterations and return the record of the training.

    Raises:
        KeyboardInterrupt: the user asked to stop; a checkpoint was written.
        ConvergenceError: a loss or gradient was not finite, and again after the return to the last checkpoint and
            the continuation at a lower rate.
        InputError: the checkpoint cannot be read.
    """
    loop, iterations = _Loop(trainer, options), trainer.options.iterations
    reported, time_left = trainer.iteration, TimeLeft(trainer.work, iterations)
    worked, since = math.nan, iterations  # the first iteration is no measure of the others: it loads kernels
    with deferred_interrupts() as stop, progress.task("training", iterations) as task:
        task.advance(reported)
        while trainer.iteration < iterations:
            try:
                row = loop.iterate()
                if math.isnan(worked):
                    worked, since = time.process_time(), trainer.iteration
                    time_left.start(since)
                if row is not None:
                    note = f"{row['psnr']:.1f} dB, {row['gaussians'] / 1000:.0f} k Gaussians"
                    task.advance(max(trainer.iteration - reported, 0), note, time_left.after(trainer.iteration))
                    reported = max(trainer.iteration, reported)
                if stop.requested:
                    loop.save()
                    log.warning(
                        "stopped at iteration %d of %d; the same command continues",
                        trainer.iteration, iterations,
                    )  # fmt: skip
                    raise KeyboardInterrupt
            except NonFiniteError as error:
                loop.recover(error)
        loop.save()
    each = (time.process_time() - worked) / (iterations - since) if since < iterations else math.nan
    return TrainingRecord(loop.seconds(), loop.recovery, each)


class _Loop:
    """Iterations of a trainer, with their files; begins anew, or from a checkpoint of this training."""

    def __init__(self, trainer: JointTrainer, options: LoopOptions) -> None:
        self.trainer, self.options = trainer, options
        self.recovery: str | None = None
        self._spent, self._clock = 0.0, time.monotonic()
        if options.resume and options.checkpoint.exists():
            try:
                self._spent = self._go_back()
            except (InputError, KeyError, ValueError, RuntimeError, TypeError) as error:
                text = f"the checkpoint is damaged: {error}"
                raise DamagedPartialError("checkpoint-damaged", text, path=options.checkpoint) from error
            if options.extend:
                trainer.schedule.extended_from = trainer.iteration
            log.info("%s at iteration %d", "extended" if options.extend else "resumed", trainer.iteration)
        else:
            options.metrics.write_text("", encoding="utf-8")
            self.save()

    def seconds(self) -> float:
        """Return the duration so far, with the runs before a resume."""
        return self._spent + time.monotonic() - self._clock

    def iterate(self) -> dict[str, Any] | None:
        """Run one iteration, check and save where due, and return the row of metrics if one was due."""
        trainer, options = self.trainer, self.options
        report = trainer.step()
        due = trainer.iteration % options.log_every == 0 or trainer.iteration == trainer.options.iterations
        if due or trainer.device.type == "cpu":  # a GPU would have to wait for a check at every iteration
            trainer.watch.check()
        row = _metrics_row(trainer, report, self.seconds()) if due else None
        if row is not None:
            with options.metrics.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(row) + "\n")
        if trainer.iteration % options.checkpoint_every == 0:
            self.save()
        return row

    def save(self) -> None:
        """Write a checkpoint, if all losses and gradients were finite; else raise `NonFiniteError`."""
        self.trainer.watch.check()
        loop_state = {
            "seconds": torch.tensor(self.seconds(), dtype=torch.float64),
            "recovery": torch.tensor(list((self.recovery or "").encode()), dtype=torch.uint8),
        }
        save_checkpoint(self.options.checkpoint, {**self.trainer.state(), **loop_state})
        if self.trainer.iteration > self.trainer.schedule.extended_from:
            minutes = f"{self.seconds() / 60:.0f} min" if self.seconds() >= 60 else f"{self.seconds():.0f} s"
            total = self.trainer.options.iterations
            self.options.note(f"{self.trainer.iteration} of {total} iterations, {minutes}")

    def recover(self, error: NonFiniteError) -> None:
        """Return to the last checkpoint and lower the learning rates; a second time is a `ConvergenceError`."""
        advice = "Train again with a smaller --geo-weight, another --seed or fewer --max-gaussians."
        if self.recovery is not None:
            raise ConvergenceError("training-diverged", f"{error}; earlier, {self.recovery}. {advice}") from error
        self._go_back()
        self.trainer.slow_down(_RECOVERY_RATE)
        self.recovery = (
            f"{error}; continued from iteration {self.trainer.iteration} at {_RECOVERY_RATE} × the learning rates"
        )
        log.warning("%s", self.recovery)
        self.save()

    def _go_back(self) -> float:
        """Restore the checkpoint, drop the metrics of later iterations, and return the checkpoint's seconds."""
        state = load_checkpoint(self.options.checkpoint)
        self.trainer.restore(state)
        self.recovery = bytes(state["recovery"].tolist()).decode() or None
        path = self.options.metrics
        rows = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        kept = [row for row in rows if row.endswith("}") and json.loads(row)["iteration"] <= self.trainer.iteration]
        path.write_text("".join(row + "\n" for row in kept), encoding="utf-8")
        return float(state["seconds"])


# Motion of the whole since the start of training, in `model`: without unit, radians, metres.
_MOTION = ("ln_scale", "turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")


def _metrics_row(trainer: JointTrainer, report: StepReport, seconds: float) -> dict[str, Any]:
    problem = trainer.problem
    row: dict[str, Any] = {
        "iteration": trainer.iteration,
        "seconds": round(seconds, 2),
        "photometric": float(report.losses["photometric"]),
        "psnr": -10.0 * math.log10(max(float(report.mean_square_error), 1e-10)),
        "gaussians": len(trainer.optimizer.gaussians),
        "visible": report.visible,
        "pixels": report.pixels,
        "geo_weight": report.weight,
    }
    if not problem.unknowns.w.numel():  # frozen
        return row
    with torch.no_grad():
        losses, moved = problem.losses(), problem.unknowns.common_motion()
    row |= {name: float(value) for name, value in losses.items()}
    if "control_by_depth" in report.losses:
        row["control_by_depth"] = float(report.losses["control_by_depth"])
    return row | dict(zip(_MOTION, moved.tolist(), strict=True))


def train_in_folder(stage: StageRun, trainer: JointTrainer, options: TrainOptions, done: int = 0) -> TrainingRecord:
    """Run a training's remaining iterations, return its record; errors as of `optimise`, or a StorageError.

    An interrupted run is resumed. A finished training of fewer iterations, `done`, is extended from its last state.
    """
    iterations, kept = options.effort.iterations, (CHECKPOINT, METRICS)
    earlier = None if stage.resumed else stage.extends
    extend = earlier is not None and done < iterations and all((earlier / name).is_file() for name in kept)
    if earlier is not None and extend:
        log.info("the training of %d iterations is extended to %d; --force trains afresh", done, iterations)
        for name in kept:
            shutil.copyfile(earlier / name, stage.out / name)
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
