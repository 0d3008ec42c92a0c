"""Jobs, their ends, and the interface of the engines that run them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipelines.core.progress import Progress

INTERRUPTED = 130


@dataclass(frozen=True)
class Job:
    """Command of this program whose repetition completes an earlier, interrupted one.

    Only names and paths travel: a job runs on every machine that sees its paths, and leaves its result there.

    Attributes:
        name: for people, unique among the jobs of a run.
        arguments: of `georef`.
        peak_bytes: predicted peak of the memory.
        uses_gpu: whether it takes a whole GPU.
        folder: that its command works in, such as the workspace; a machine that does not see it cannot run the job.
        writes: file or folder in `folder` that it changes; needed where its files go through a storage.
        reads: further files and folders in `folder` that it needs there.
    """

    name: str
    arguments: tuple[str, ...]
    peak_bytes: int
    uses_gpu: bool = False
    folder: Path | None = None
    writes: Path | None = None
    reads: tuple[Path, ...] = ()


@dataclass(frozen=True)
class JobEnd:
    """End of a job.

    Attributes:
        job: the job.
        code: exit code; below zero the signal that ended the process.
        seconds: from start to end.
        place: step that the job was at (`train`); empty if it named none.
        error: message of a job that failed, else empty.
    """

    job: Job
    code: int
    seconds: float
    place: str
    error: str

    @property
    def is_done(self) -> bool:
        """Whether the job has reached its result."""
        return self.code == 0

    @property
    def is_interrupted(self) -> bool:
        """Whether the job was stopped and goes on when it is run again."""
        return self.code == INTERRUPTED


class Engine(Protocol):
    """Runner of jobs."""

    def together(self, jobs: Sequence[Job]) -> int:
        """Return how many of the jobs run at a time at the beginning; at least 1."""

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        """Run jobs until all have ended; one that fails stops no other.

        Args:
            title: what the jobs are, for the display: `missions`.
            jobs: in the order in which they begin where resources allow.
            ended: called in this thread at the end of each job.
            progress: shows a task for all jobs, and one for each that runs.

        Raises:
            KeyboardInterrupt: the user stopped the run. The jobs that ran have saved their work, and `ended` was
                called for each of them.
        """
