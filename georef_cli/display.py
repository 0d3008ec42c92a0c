"""Display of progress: bars on a terminal, a line every half minute in a log."""

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Task, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.progress import ProgressColumn as Column
from rich.table import Column as TableColumn
from rich.text import Text

from georef_cli.verbosity import LineFormatter, Verbosity, stderr_sender
from pipelines.core.progress import SILENT, Progress, ProgressTask

LINE_EVERY_S = 30.0
# Columns of a terminal from which a bar shows the speed too, and the columns of the bar itself.
_WIDE, _WIDE_BAR, _NARROW_BAR = 100, 20, 8
_MARGIN_LINES = 4  # for log lines above the bars
STDERR = Console(stderr=True, emoji=False)  # one for all: bars and log lines must not overwrite each other
LEVEL_STYLES = {logging.ERROR: "red", logging.WARNING: "yellow", logging.INFO: ""}

log = logging.getLogger(__name__)


class ConsoleHandler(logging.Handler):
    """Handler that prints log records as coloured lines above the bars."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.setFormatter(LineFormatter())
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        style = next((style for level, style in LEVEL_STYLES.items() if record.levelno >= level), "dim")
        self._console.print(Text(self.format(record), style=style))


def is_logged(verbosity: Verbosity) -> bool:
    """Return whether the reader of stdout has the lines on stderr before their eyes, on the same terminal."""
    return not verbosity.quiet and sys.stderr.isatty() and sys.stdout.isatty()


def progress_for(verbosity: Verbosity) -> Progress:
    """Return the display of progress: bars on a terminal, log lines elsewhere; none with `--quiet`."""
    if verbosity.json_progress:
        return stderr_sender()
    if verbosity.quiet:
        return SILENT
    return BarProgress(STDERR) if sys.stderr.isatty() else LineProgress()


class _TextColumn(Column):
    def __init__(self, text: Callable[[Task], Text], *, no_wrap: bool = True) -> None:
        super().__init__(TableColumn(no_wrap=no_wrap))
        self._text = text

    def render(self, task: Task) -> Text:
        return self._text(task)


def _speed(task: Task) -> Text:
    """Return the steps per second, or the seconds per step where they are more; nothing for steps that differ."""
    speed = task.finished_speed or task.speed
    if not speed or task.fields["left_s"] == math.inf:
        return Text("")
    return Text(f"{speed:.1f} it/s" if speed >= 1 else f"{1 / speed:.1f} s/it", style="progress.data.speed")


def _so_far(task: Task) -> Text:
    """Return the time since the beginning, or that of a finished task."""
    if task.finished:
        return Text(clock(task.finished_time or 0.0))
    return Text("" if task.elapsed is None else f"{clock(task.elapsed)} so far")


def _time_left(task: Task) -> Text:
    """Return the time that is left, by the task's own estimate or the speed of its steps; nothing if unknown."""
    left_s = task.time_remaining if task.fields["left_s"] is None else task.fields["left_s"]
    return Text("" if left_s is None or math.isinf(left_s) or task.finished else f"{clock(left_s)} left")


def clock(seconds: float) -> str:
    """Return a time as `0:07`, `12:30` or `1:02:03`."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"


class BarProgress:
    """Progress as bars, one below the other; a finished bar stays and shows its time."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars: Bars | None = None

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a bar; tasks that are opened inside it are drawn below. A task without steps has no bar."""
        if total == 0:
            with SILENT.task(name) as silent:
                yield silent
            return
        outermost = self._bars is None
        bars = self._bars or self._start()
        bar = bars.add_task(name, total=total, note="", left_s=None)
        try:
            yield _Bar(bars, bar)
        finally:
            bars.stop_task(bar)
            # The height of the terminal has no room for the oldest of many finished bars.
            finished = [task.id for task in bars.tasks if task.stop_time is not None]
            for old in finished[: max(0, len(bars.tasks) + _MARGIN_LINES - self._console.height)]:
                bars.remove_task(old)
            if outermost:
                bars.stop()
                self._bars = None

    def _start(self) -> Bars:
        wide = self._console.width >= _WIDE
        columns: tuple[Column, ...] = (
            TextColumn("{task.description}", markup=False, table_column=TableColumn(no_wrap=True)),
            BarColumn(_WIDE_BAR if wide else _NARROW_BAR),
            MofNCompleteColumn(table_column=TableColumn(no_wrap=True)),
            *([_TextColumn(_speed)] if wide else []),
            _TextColumn(_so_far),
            _TextColumn(_time_left),
            # The note is cut off where the line ends.
            _TextColumn(lambda task: Text(task.fields["note"], no_wrap=True, overflow="ellipsis"), no_wrap=False),
        )
        self._bars = Bars(*columns, console=self._console, refresh_per_second=4)
        self._bars.start()
        return self._bars


class _Bar:
    def __init__(self, bars: Bars, bar: TaskID) -> None:
        self._bars, self._bar = bars, bar
        self._note = ""

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        self._note = note or self._note
        self._bars.update(self._bar, advance=steps, note=self._note, left_s=left_s)


class LineProgress:
    """Progress as log lines: at the end of a task, and every half minute of a long one."""

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        line = _Line(name, total)
        try:
            yield line
        finally:
            line.log_count()


class _Line:
    def __init__(self, name: str, total: int | None) -> None:
        self._name, self._total = name, total
        self._done, self._note = 0, ""
        self._left_s: float | None = None
        self._started = self._logged = time.monotonic()

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Add `steps` to the count, and log it if the last line is half a minute old."""
        self._done += steps
        self._note, self._left_s = note.strip() if note else self._note, left_s
        if time.monotonic() - self._logged >= LINE_EVERY_S:
            self.log_count()

    def log_count(self) -> None:
        self._logged = time.monotonic()
        elapsed_s = self._logged - self._started
        total = "" if self._total is None else f"/{self._total}"
        note = f", {self._note}" if self._note else ""
        left = f", about {clock(self._left_s)} left" if self._left_s and math.isfinite(self._left_s) else ""
        log.info("%s: %d%s after %.0f s%s%s", self._name, self._done, total, elapsed_s, note, left)
