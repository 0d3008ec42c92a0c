"""Messages of a process to the one that started it: log records and progress as lines of JSON."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any, TextIO

from pipelines.core.progress import Progress, ProgressTask


class MessageSender:
    """Sender of messages, and the `Progress` of its process.

    Args:
        stream: that the receiver reads.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._lock = stream, threading.Lock()

    def send(self, kind: str, **content: Any) -> None:
        """Send one message.

        Raises:
            OSError: nobody reads the stream.
        """
        with self._lock:
            self._stream.write(json.dumps({"kind": kind, **content}) + "\n")
            self._stream.flush()

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a task that the receiver shows."""
        self.send("begin", name=name, total=total)
        try:
            yield _SentTask(self)
        finally:
            self.send("end")


class _SentTask:
    def __init__(self, sender: MessageSender) -> None:
        self._sender = sender

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Send the steps."""
        self._sender.send("advance", steps=steps, note=note, left_s=left_s)


class SentRecords(logging.Handler):
    """Handler that sends log records."""

    def __init__(self, sender: MessageSender) -> None:
        super().__init__()
        self._sender = sender

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record."""
        self._sender.send("log", name=record.name, level=record.levelno, text=self.format(record))


class MessageReceiver:
    """Receiver that shows the tasks of another process, and logs its records as those of this process.

    Args:
        progress: shows the tasks.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._open: list[tuple[AbstractContextManager[ProgressTask], ProgressTask]] = []

    def take(self, message: Mapping[str, Any]) -> bool:
        """Return whether a message was one of progress or of the log, and act on it."""
        match message["kind"]:
            case "log":
                self.log(message["name"], message["level"], message["text"])
            case "begin":
                context = self._progress.task(message["name"], message["total"])
                self._open.append((context, context.__enter__()))
            case "advance":
                self._open[-1][1].advance(message["steps"], message["note"], message["left_s"])
            case "end":
                self._open.pop()[0].__exit__(None, None, None)
            case _:
                return False
        return True

    def log(self, name: str, level: int, text: str) -> None:
        """Log a record of the other process."""
        logging.getLogger(name).log(level, "%s", text)

    def close(self) -> None:
        """Close the tasks that the other process has left open."""
        while self._open:
            self._open.pop()[0].__exit__(None, None, None)
