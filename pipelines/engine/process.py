"""Process of one job: this program again, which tells its progress, its log and its error as messages.

A crash of the process is the end of its job, and of no other. The process stops when its reader is gone
(`georef_cli/sender.py`), so that no job outlives a killed parent for long.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pipelines.core.restart import python_command, python_environment
from pipelines.engine.job import INTERRUPTED

_TAIL_LINES = 20
_KILLED = "the system killed it, as it does when memory is short: run fewer at a time"


@dataclass(frozen=True)
class ProcessEnd:
    """End of a process.

    Attributes:
        code: exit code; below zero the signal that ended it.
        seconds: from start to end.
        error: its message if it failed, else empty.
        kind: kind of the failure (`GeorefError.code`); empty if it did not tell.
    """

    code: int
    seconds: float
    error: str = ""
    kind: str = ""


class JobProcess:
    """Running process of a job.

    Args:
        program: arguments of Python that start this program.
        arguments: of the program.
        threads: that the job computes with.
        take: gets the messages in a thread; false: it was none of progress or log.
        ended: called at the end of the process, in the same thread.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(
        self,
        program: Sequence[str],
        arguments: Sequence[str],
        threads: int,
        take: Callable[[Mapping[str, Any]], bool],
        ended: Callable[[ProcessEnd], None],
    ) -> None:
        self._take, self._ended = take, ended
        self._kind = ""
        self._plain: deque[str] = deque(maxlen=_TAIL_LINES)
        self._started = time.monotonic()
        self._is_interrupted = False
        # A group of its own: Ctrl-C on the terminal reaches the parent alone, which passes it on once.
        self._process = subprocess.Popen(
            python_command([*program, *arguments, "--json-progress", "--threads", str(threads)]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env=python_environment(),
            **_OWN_GROUP,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def interrupt(self) -> None:
        """Ask the process to save its work and end, as Ctrl-C does."""
        self._is_interrupted = True
        with suppress(OSError):  # It has ended.
            self._process.send_signal(_INTERRUPT)

    def kill(self) -> None:
        """End the process at once, and wait for its end."""
        self._process.kill()
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                message = _message(line)
                if message is not None and message["kind"] == "error":
                    self._kind = str(message["code"])
                elif message is None or not self._take(message):
                    self._plain.append(line.rstrip())
        code = self._process.wait()
        if code < 0 and self._is_interrupted:  # before it could handle signals
            code = INTERRUPTED
        seconds = time.monotonic() - self._started
        self._ended(ProcessEnd(code, seconds, "" if code == 0 else self._error(code), self._kind))

    def _error(self, code: int) -> str:
        """Return the message of the process; its last line, below usage or a traceback."""
        said = next((line for line in reversed(self._plain) if line.strip()), "")
        text = said.removeprefix("error: ").removeprefix("Error: ")
        if code < 0:
            ending = _KILLED if code == -_SIGKILL else f"it crashed ({_name(-code)})"
            return f"{ending}: {text}" if text else ending
        return text or f"it ended with exit code {code}"


def _message(line: str) -> dict[str, Any] | None:
    """Return the message in a line; None for lines of others, as native libraries write them."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) and "kind" in message else None


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


_OWN_GROUP: dict[str, Any]
if sys.platform == "win32":
    _OWN_GROUP = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    _INTERRUPT = signal.CTRL_BREAK_EVENT
    _SIGKILL = 9
else:
    _OWN_GROUP = {"process_group": 0}
    _INTERRUPT = signal.SIGTERM  # SIGINT is ignored by what a shell has started in the background
    _SIGKILL = signal.SIGKILL
