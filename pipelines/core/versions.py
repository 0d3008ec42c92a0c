"""Versions of this package and of the libraries whose results depend on their version."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata

from pipelines import __version__

LIBRARIES = ("numpy", "pycolmap", "torch", "numba", "pyproj")
NOT_INSTALLED = "not installed"


def library_versions(libraries: Sequence[str] = LIBRARIES) -> dict[str, str]:
    """Return the versions by distribution, this package's first; `not installed` for a missing one."""
    versions = {"georefgs": __version__}
    for name in libraries:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = NOT_INSTALLED
    return versions
