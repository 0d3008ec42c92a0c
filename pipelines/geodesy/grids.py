"""Grids of PROJ on this machine: geoid models and datum shifts."""

from __future__ import annotations

from pathlib import Path

_SUFFIXES = (".tif", ".gtx", ".gsb")


def grid_folders() -> list[Path]:
    """Return the existing folders in which PROJ looks for grids."""
    from pyproj import datadir

    named = [*datadir.get_data_dir().split(";"), datadir.get_user_data_dir()]
    folders = [Path(part) for text in named for part in (text.split(":") if "/" in text else [text]) if part]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def installed_grids() -> list[str]:
    """Return the file names of the grids in PROJ's folders, sorted."""
    files = (file for folder in grid_folders() for file in folder.iterdir())
    return sorted({file.name for file in files if file.suffix.lower() in _SUFFIXES})
