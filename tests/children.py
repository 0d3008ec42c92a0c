"""The work of a child process in this one, which has the libraries already."""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.core.progress import SILENT, Progress


def run_here(
    task: str, arguments: Mapping[str, Any], remedy: str, progress: Progress = SILENT, *, writes: Path | None = None
) -> Any:
    """Return what `pipelines.core.child.run_in_child` returns, of documents as they come out of its pipes."""
    module, _, name = task.partition(":")
    work = getattr(importlib.import_module(module), name)
    return json.loads(json.dumps(work(json.loads(json.dumps(arguments)), progress)))
