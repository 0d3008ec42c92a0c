"""Options that stages were last requested with, in `requests.json` of a workspace.

Input paths are remembered as absolute paths, together with the place of the workspace. A path that is gone after
the workspace was moved is looked for where it would lie if it had been moved along.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.core.durable import replace_text
from pipelines.core.errors import InputError
from pipelines.core.files import file_size

REQUESTS = "requests.json"
_PLACE = "workspace"  # no stage has this name


def read_requests(root: Path) -> dict[str, dict[str, Any]]:
    """Return the options that the stages of a workspace were last requested with, by stage.

    Raises:
        InputError: `requests.json` is damaged.
    """
    path = root / REQUESTS
    if not path.exists():
        return {}
    file_size(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError("not valid JSON: delete it and give the options again", path=path) from error
    if not isinstance(document, dict) or not all(isinstance(flags, dict) for flags in document.values()):
        raise InputError("not a table of options by stage: delete it and give them again", path=path)
    place = document.pop(_PLACE, {}).get("root")
    if not isinstance(place, str) or place == str(root):
        return document
    return {
        stage: {name: _moved(value, Path(place), root) for name, value in flags.items()}
        for stage, flags in document.items()
    }


def write_requests(root: Path, flags: Mapping[str, Mapping[str, Any]]) -> None:
    """Record the options that stages are requested with, by stage."""
    document = {**{stage: dict(given) for stage, given in flags.items()}, _PLACE: {"root": str(root)}}
    replace_text(root / REQUESTS, json.dumps(document, indent=1, default=str) + "\n")


def _moved(value: Any, before: Path, root: Path) -> Any:
    """Return a path that is gone as it lies beside a workspace that was at `before`; any other value as it is."""
    if not isinstance(value, str) or not Path(value).is_absolute():
        return value
    try:
        beside = Path(os.path.normpath(root / os.path.relpath(value, before)))
        return str(beside) if not Path(value).exists() and beside.exists() else value
    except (OSError, ValueError):  # no path of this system
        return value
