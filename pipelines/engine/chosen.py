"""Engine that the stages of this command share their work with: chosen by the command line, used by a stage.

A stage that consists of many parts asks for it. The runner and the workspace know of no engine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

from pipelines.core.free_memory import free_main_memory_bytes
from pipelines.core.progress import Progress
from pipelines.core.threads import thread_count
from pipelines.engine.job import Engine, Job, JobEnd
from pipelines.engine.local import LocalEngine

_CHOSEN: ContextVar[Engine | None] = ContextVar("engine", default=None)


@contextmanager
def chosen_engine(engine: Engine) -> Iterator[None]:
    """Let the stages that run in this context share their work with an engine."""
    token = _CHOSEN.set(engine)
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def engine_in_use() -> Engine:
    """Return the engine of this context; by default, processes that share all cores and the free memory."""
    cores = thread_count()
    return _CHOSEN.get() or LocalEngine(cores, cores, free_main_memory_bytes())


def failed_of(title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> list[JobEnd]:
    """Run jobs on the engine in use, and return the ends of those that have failed.

    Args:
        title, jobs, ended, progress: as for `Engine.run`.

    Raises:
        KeyboardInterrupt: the user stopped the run; the jobs that ran have saved their work.
    """
    failed: list[JobEnd] = []

    def take(end: JobEnd) -> None:
        if not (end.is_done or end.is_interrupted):
            failed.append(end)
        ended(end)

    if jobs:
        engine_in_use().run(title, jobs, take, progress)
    return failed
