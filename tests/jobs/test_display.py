"""A job as one line of the display: its outermost task, and what runs inside as the note."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from pipelines.core.progress import ProgressTask
from pipelines.jobs.engine import JobDisplay


def test_inner_tasks_are_the_note_of_the_line() -> None:
    seen: list[tuple[str, int, str, float | None]] = []

    class Recorder:
        @contextmanager
        def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
            class Task:
                def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
                    seen.append((f"{name} of {total}", steps, note, left_s))

            yield Task()

    line = JobDisplay(Recorder(), "north")
    with line.task("stages", 8) as stages:
        stages.advance(0, note="train")
        with line.task("training", 900) as training:
            training.advance(300, note="20.1 dB", left_s=125.0)
            training.advance(300, left_s=math.inf)  # jobs of the job, whose time is not known
        stages.advance()
    assert seen == [
        ("north of 8", 0, "train", math.inf),
        ("north of 8", 0, "train · training 300/900 · 20.1 dB · 2 min 05 s left", math.inf),
        ("north of 8", 0, "train · training 600/900 · 20.1 dB", math.inf),
        ("north of 8", 1, "train", math.inf),
    ]
    assert line.step == "train"
