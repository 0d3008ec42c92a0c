"""Work that takes longer than a click: jobs on threads of their own, with progress, a first answer, and an end."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import BaseModel

from pipelines.core.errors import GeorefError
from pipelines.core.json_values import JsonValue

log = logging.getLogger(__name__)

_KEPT = 200  # finished jobs
_THREADS = 2


class CancelledError(Exception):
    """The page does not want the answer any more."""


@dataclass
class ViewJob:
    """Work for a page.

    Attributes:
        request: what was asked.
        answer: the latest answer; an estimate until the state is `done`.
        share: of the work that is done.
        failure: why there is no answer.
    """

    number: int
    request: Any
    state: Literal["running", "done", "failed", "cancelled"] = "running"
    answer: Any = None
    share: float = 0.0
    failure: str = ""
    cancelled: threading.Event = field(default_factory=threading.Event)

    def advance(self, share: float) -> None:
        """State the share that is done; a CancelledError ends the work."""
        if self.cancelled.is_set():
            raise CancelledError
        self.share = share


class Jobs:
    """Jobs of all pages; the oldest are forgotten."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="measure")
        self._jobs: OrderedDict[int, ViewJob] = OrderedDict()
        self._lock = threading.Lock()
        self._last = 0

    def begin(self, request: BaseModel, work: Callable[[ViewJob], Iterable[JsonValue]]) -> ViewJob:
        """Begin a job whose work yields answers, each better than the one before."""
        with self._lock:
            self._last += 1
            job = self._jobs[self._last] = ViewJob(self._last, request)
            while len(self._jobs) > _KEPT:
                self._jobs.popitem(last=False)[1].cancelled.set()
        self._pool.submit(self._run, job, work)
        return job

    def find(self, number: int) -> ViewJob | None:
        with self._lock:
            return self._jobs.get(number)

    def close(self) -> None:
        with self._lock:
            for job in self._jobs.values():
                job.cancelled.set()
        self._pool.shutdown(cancel_futures=True)

    @staticmethod
    def _run(job: ViewJob, work: Callable[[ViewJob], Iterable[JsonValue]]) -> None:
        try:
            for answer in work(job):
                job.answer = answer
                job.advance(job.share)
            job.share, job.state = 1.0, "done"
        except CancelledError:
            job.state = "cancelled"
        except GeorefError as error:
            job.failure, job.state = str(error), "failed"
        except Exception:
            log.exception("a measurement failed")
            job.failure, job.state = "The measurement failed: the terminal tells more.", "failed"
