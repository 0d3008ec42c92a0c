"""Log records and progress for a program, as lines of JSON on stderr: `--json-progress`."""

from __future__ import annotations

import signal
import sys
from functools import cache
from typing import Any, TextIO

from pipelines.core.messages import MessageSender


class StderrSender(MessageSender):
    """Sender that interrupts its process when its reader is gone, as Ctrl-C does: nobody waits for the result."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._has_reader = True

    def send(self, kind: str, **content: Any) -> None:
        """Send one message, unless nobody reads any more."""
        if not self._has_reader:
            return
        try:
            super().send(kind, **content)
        except OSError:
            self._has_reader = False
            signal.raise_signal(signal.SIGTERM)


@cache
def stderr_sender() -> StderrSender:
    """Return the sender on stderr, always the same: the lines of threads must not mix."""
    return StderrSender(sys.stderr)
