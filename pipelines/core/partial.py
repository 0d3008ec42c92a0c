"""Partial product of a stage: the request that it was begun for, how far it came, and why it failed."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from pipelines.core.durable import remove, replace_text
from pipelines.core.errors import InputError

TOKEN = "token.txt"
FAILURE = "failure.txt"
PROGRESS = "progress.txt"
_MOST_TEXT_BYTES = 1 << 20


@dataclass(frozen=True)
class PartialProduct:
    """Folder that a stage writes into until its product is complete.

    The request, as a text, is the first file to be deleted: a half deleted folder is never continued.

    Attributes:
        folder: `<stage folder>.partial`.
    """

    folder: Path

    def exists(self) -> bool:
        """Return whether a run has begun and not ended."""
        return self.folder.exists()

    def is_of(self, token: str) -> bool:
        """Return whether the run was begun for the same request."""
        return _text(self.folder / TOKEN) == token

    def request(self) -> tuple[dict[str, Any], dict[str, str]] | None:
        """Return options and fingerprints of the inputs of the run; None if they cannot be read."""
        try:
            config, inputs = json.loads(_text(self.folder / TOKEN) or "")
        except (ValueError, TypeError, RecursionError):
            return None
        return (config, inputs) if isinstance(config, dict) and isinstance(inputs, dict) else None

    def progress(self) -> str | None:
        """Return how far an interrupted run came; None if nothing of it is worth keeping."""
        return _text(self.folder / PROGRESS)

    def found(self) -> str:
        """Return how far the run came, and when (`1500 of 7000 iterations, 12 min, saved 2026-05-01 14:30`)."""
        progress = self.progress()
        verb, note = ("begun", TOKEN) if progress is None else (f"{progress}, saved", PROGRESS)
        with contextlib.suppress(OSError):
            moment = datetime.fromtimestamp((self.folder / note).stat().st_mtime).astimezone()
            return f"{verb} {moment:%Y-%m-%d %H:%M}"
        return progress or "half deleted"

    def record_progress(self, text: str) -> None:
        """Record how far the run has come (`1500 of 7000 iterations`): from now on it is not dropped unasked."""
        replace_text(self.folder / PROGRESS, text)

    def failure(self) -> str | None:
        """Return the message with which the run failed, or None; a full disk leaves an empty file."""
        return _text(self.folder / FAILURE) or None

    def fail(self, message: str, *, worthless: bool = False) -> None:
        """Record the message with which the run failed; a full disk has no room even for that.

        Args:
            message: of the error.
            worthless: whether what the run has done may be dropped unasked.
        """
        with contextlib.suppress(OSError):
            if worthless:
                (self.folder / PROGRESS).unlink(missing_ok=True)
            (self.folder / FAILURE).write_text(message, encoding="utf-8", errors="backslashreplace")

    def begin(self, token: str) -> None:
        """Make the folder anew for a request."""
        if self.folder.is_dir() and not self.folder.is_symlink():
            (self.folder / TOKEN).unlink(missing_ok=True)
        remove(self.folder)
        self.folder.mkdir(parents=True)
        (self.folder / TOKEN).write_text(token, encoding="utf-8")

    def go_on(self, token: str, *, insist: bool) -> bool:
        """Return whether the folder holds a run for the same request, which can go on, and forget its failure.

        Raises:
            InputError: `insist`, and the folder holds a run for another request.
        """
        if self.folder.is_symlink() or not (self.folder / TOKEN).is_file():
            return False
        if self.is_of(token):
            (self.folder / FAILURE).unlink(missing_ok=True)
            return True
        if insist:
            raise InputError(
                "the interrupted run had other inputs or options: give those, or start afresh with --force",
                path=self.folder,
            )
        return False

    def tidy(self) -> None:
        """Delete the notes on the run, which is complete."""
        for name in (TOKEN, PROGRESS):
            (self.folder / name).unlink(missing_ok=True)


def _text(path: Path) -> str | None:
    try:
        if not path.is_file() or path.stat().st_size > _MOST_TEXT_BYTES:
            return None
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
