"""Progress for people: bars on a terminal, a line now and then in a log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.progress import ProgressColumn as Column
from rich.text import Text

from georef_cli.verbosity import LineFormatter, Verbosity
from pipelines.core.progress import SILENT, Progress, ProgressTask

LINE_EVERY_S = 30.0
LEVEL_STYLES = {logging.ERROR: "red", logging.WARNING: "yellow", logging.INFO: ""}

log = logging.getLogger(__name__)


@cache
def stderr_console() -> Console:
    """The one console on stderr: bars and log lines must share it so as not to overwrite each other."""
    return Console(stderr=True, emoji=False)


class ConsoleHandler(logging.Handler):
    """Log records as coloured lines above the bars."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.setFormatter(LineFormatter())
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        style = next((style for level, style in LEVEL_STYLES.items() if record.levelno >= level), "dim")
        self._console.print(Text(self.format(record), style=style))


def progress_for(verbosity: Verbosity) -> Progress:
    """Bars on a terminal, sparse log lines elsewhere, nothing with `--quiet`."""
    if verbosity.quiet:
        return SILENT
    return BarProgress(stderr_console()) if sys.stderr.isatty() else LineProgress()


class SpeedColumn(Column):
    """Steps per second, or seconds per step where that reads better."""

    def render(self, task: Task) -> Text:
        """The speed of a task."""
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        return Text(f"{speed:.1f} it/s" if speed >= 1 else f"{1 / speed:.1f} s/it", style="progress.data.speed")


class BarProgress:
    """Bars, one below the other; a finished one stays as the record of its time."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars: Bars | None = None

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a bar; tasks opened inside it are drawn below."""
        outermost = self._bars is None
        bars = self._bars or self._start()
        bar = bars.add_task(name, total=total, note="")
        try:
            yield _Bar(bars, bar)
        finally:
            bars.stop_task(bar)
            if outermost:
                bars.stop()
                self._bars = None

    def _start(self) -> Bars:
        self._bars = Bars(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            SpeedColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
            refresh_per_second=4,
        )
        self._bars.start()
        return self._bars


class _Bar:
    def __init__(self, bars: Bars, bar: TaskID) -> None:
        self._bars, self._bar = bars, bar

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Move the bar."""
        if note:
            self._bars.update(self._bar, advance=steps, note=note)
        else:
            self._bars.update(self._bar, advance=steps)


class LineProgress:
    """A log line when a task ends, and every half minute of a long one."""

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a task that is told in lines."""
        line = _Line(name, total)
        try:
            yield line
        finally:
            line.tell()


class _Line:
    def __init__(self, name: str, total: int | None) -> None:
        self._name, self._total = name, total
        self._done, self._note = 0, ""
        self._started = self._told = time.monotonic()

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Count, and tell if nothing was told for a while."""
        self._done += steps
        self._note = note or self._note
        if time.monotonic() - self._told >= LINE_EVERY_S:
            self.tell()

    def tell(self) -> None:
        """Log where the task is."""
        self._told = time.monotonic()
        elapsed_s = self._told - self._started
        of = "" if self._total is None else f"/{self._total}"
        note = f", {self._note}" if self._note else ""
        log.info("%s: %d%s after %.0f s%s", self._name, self._done, of, elapsed_s, note)
