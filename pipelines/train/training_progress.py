"""Progress of a training: the first iteration, in which kernels compile, and then all iterations."""

from __future__ import annotations

from contextlib import ExitStack
from types import TracebackType

from pipelines.core.progress import Progress, ProgressTask
from pipelines.train.pace import TimeLeft

_COMPILING = "compiling kernels (a minute, once)"


class TrainingProgress:
    """Tasks of a training, closed at the end of the context.

    The first iteration of a run has a task of its own: its duration is no measure of the others.

    Args:
        progress: shows the tasks.
        begun: iterations of earlier runs.
        iterations: length of the training.
        time_left: of the training.
    """

    def __init__(self, progress: Progress, begun: int, iterations: int, time_left: TimeLeft) -> None:
        self._progress, self._iterations, self._time_left = progress, iterations, time_left
        self._shown = begun
        self._first, self._all = ExitStack(), ExitStack()
        self._warming_up: ProgressTask | None = None
        self._training: ProgressTask | None = None

    def __enter__(self) -> TrainingProgress:
        if self._shown < self._iterations:
            self._warming_up = self._first.enter_context(self._progress.task("first iteration", 1))
            self._warming_up.advance(0, _COMPILING)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._all.close()
        self._first.close()

    def iterated(self, iteration: int, note: str | None) -> None:
        """Note the end of an iteration.

        Args:
            iteration: that has ended, from 1.
            note: on the training; None: the display stays as it is.
        """
        if self._warming_up is not None:
            self._warming_up.advance(1, " ")
            self._warming_up = None
            self._first.close()
            self._training = self._all.enter_context(self._progress.task("training", self._iterations))
            self._training.advance(self._shown)
            self._time_left.start(iteration)
        if note is not None and self._training is not None:
            self._training.advance(max(iteration - self._shown, 0), note, self._time_left.after(iteration))
            self._shown = max(iteration, self._shown)
