"""Engine on the workers of a Dask cluster.

The engine chooses the worker of each job, as the local engine chooses what runs beside what; Dask carries the jobs
and the events. A job ends with the event of its worker. A cancelled task is the one sign to stop a job: Ctrl-C, the
end of the engine and the end of the scheduler all lead to it, and the job saves its work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipelines.core.interrupts import deferred_interrupts
from pipelines.core.progress import Progress
from pipelines.engine.cluster import ClusterAddress, connected, place_for, places_of
from pipelines.engine.dask_run import ClusterRun, PendingJob
from pipelines.engine.exchange import EngineExchange
from pipelines.engine.job import Job, JobEnd
from pipelines.engine.storage import Storage
from pipelines.engine.tokens import folder_tokens


@dataclass(frozen=True)
class DaskEngine:
    """Engine that runs jobs on the workers of a Dask cluster.

    A job whose worker is lost, or that fails for a reason that may belong to the machine, is tried again, on
    another worker if there is one; after three failures it has failed. Workers that join are used, also later.

    Attributes:
        cluster: the scheduler's address and certificate.
        at_a_time: most jobs at a time; None: as many as the workers take.
        storage: through which the files of the jobs go; None: the workers share the folders of the jobs.
    """

    cluster: ClusterAddress
    at_a_time: int | None = None
    storage: Storage | None = None

    def together(self, jobs: Sequence[Job]) -> int:
        """Return how many of the jobs run at a time at the beginning; see `Engine`."""
        with connected(self.cluster) as client:
            places = places_of(client.scheduler_info()["workers"])
        running: dict[str, list[Job]] = {}
        for job in jobs:
            if (place := place_for(job, places, running)) is not None:
                running.setdefault(place.address, []).append(job)
        count = sum(map(len, running.values()))
        return max(min(count, self.at_a_time or count), 1)

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        """Run jobs until all have ended; see `Engine`.

        Raises:
            ClusterError: there is no scheduler, it is lost, or no worker can run the jobs.
            InputError: a job needs files that cannot go through the storage.
            StorageError: the storage failed.
            KeyboardInterrupt: see `Engine`.
        """
        exchange = None
        if self.storage is not None:
            self.storage.check()
            exchange = EngineExchange(self.storage)
        with (
            connected(self.cluster) as client,
            folder_tokens([job.folder for job in jobs if exchange is None]) as tokens,
            progress.task(title, len(jobs)) as task,
            deferred_interrupts() as stop,
        ):
            waiting = [PendingJob(job, tokens.get(job.folder, "")) for job in jobs]
            at_a_time = self.at_a_time or len(jobs)
            run = ClusterRun(client, waiting, at_a_time, exchange, ended=ended, progress=progress, task=task)
            try:
                run.until_all_have_ended(title, stop)
            finally:
                run.close()
            if stop.requested:
                raise KeyboardInterrupt
