"""Folder of a survey's photographs, also after it was moved."""

from __future__ import annotations

import contextlib
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.stages import BY_NAME
from pipelines.core.staleness import stage_config
from pipelines.core.workspace import Workspace


def photograph_folder(workspace: Workspace, image_dir: str) -> Path:
    """Return the folder of photographs that a survey names; if it is gone, the one that `ingest` is to read now.

    Whoever reads a photograph compares its hash with that of the survey.

    Args:
        workspace: of the survey.
        image_dir: of the survey: absolute, or inside the workspace.
    """
    home = workspace.base or workspace
    named = home.root / image_dir
    if named.is_dir():
        return named
    spec = BY_NAME["ingest"]
    with contextlib.suppress(InputError):
        images: Path | None = getattr(stage_config(home, spec, home.requests().get(spec.name, {})), "images", None)
        if images is not None and images.is_dir():
            return images
    return named
