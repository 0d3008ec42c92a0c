"""Tokens: files by which a worker recognises that it shares a folder, and not only its name."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def folder_tokens(folders: Iterable[Path | None]) -> Iterator[dict[Path | None, str]]:
    """Put a token into each folder while the context lasts, and return their paths by folder.

    Raises:
        OSError: a folder cannot be written.
    """
    name = f".georef-{uuid.uuid4().hex}"
    tokens: dict[Path | None, str] = {
        folder: str(folder.absolute() / name) for folder in folders if folder is not None
    }
    try:
        for token in tokens.values():
            Path(token).touch()
        yield tokens
    finally:
        for token in tokens.values():
            with suppress(OSError):
                Path(token).unlink()
