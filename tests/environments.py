"""Environments of their own with the libraries of this one, for tests of what users install; no index is asked."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def make_environment(folder: Path) -> Path:
    """Make a virtual environment in which all libraries are installed and this program is not; return its programs.

    It has no pip of its own.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    site = site_packages(folder)
    for path in filter(Path.is_dir, (Path(entry) for entry in sys.path if entry.endswith("site-packages"))):
        for library in path.iterdir():
            ours = library.name.startswith(("georefgs", "__editable__", "__pycache__")) or library.suffix == ".pth"
            if not ours and not (site / library.name).exists():
                (site / library.name).symlink_to(library)
    return folder / ("Scripts" if sys.platform == "win32" else "bin")


def site_packages(environment: Path) -> Path:
    return next(environment.glob("**/site-packages"))


def without_python() -> dict[str, str]:
    """Return this process's variables without those that would lead Python back to the checkout."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
