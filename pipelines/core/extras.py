"""Extras: optional libraries, what needs them, whether they are installed, and the command that installs them."""

import contextlib
import json
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit
from urllib.request import url2pathname

from pipelines.core.errors import BackendUnavailableError

Extra = Literal[
    "bags",
    "cluster",
    "copc",
    "heif",
    "learned",
    "mesh",
    "reference",
    "scans",
    "simulator",
    "terrain",
    "vectors",
    "viewer",
]
# What needs each extra, and the libraries that it installs, by the names of their packages.
EXTRAS: dict[Extra, tuple[str, tuple[str, ...]]] = {
    "bags": ("a ROS bag (--bag, georef inspect)", ("rosbags",)),
    "cluster": ("a cluster (--cluster, georef cluster)", ("distributed", "cryptography")),
    "copc": ("a cloud for the web (georef export-cloud --copc)", ("copclib",)),
    "heif": ("HEIC photographs", ("pillow-heif",)),
    "learned": ("learned features (--features learned)", ("kornia",)),
    "mesh": ("georef export-mesh", ("trimesh",)),
    "reference": ("M3C2 (georef evaluate --reference)", ("py4dgeo",)),
    "scans": ("E57 clouds and EXR depth maps (--lidar, --reference)", ("pye57", "OpenEXR")),
    "simulator": ("georef simulate", ("embreex",)),
    "terrain": ("the ground (dtm.tif, classes of the cloud)", ("cloth-simulation-filter",)),
    "vectors": ("contour lines and boundaries (--contours, --boundary)", ("ezdxf", "pyogrio")),
    "viewer": ("georef view", ("tornado",)),
}
# Megabytes on the disk that an extra adds to an installation without extras, and those of that installation: Linux
# (x86-64), Python 3.11, torch for the CPU. `cuda` includes what torch's build for CUDA adds.
CORE_MB = 1900
SIZES_MB: dict[Extra | Literal["cuda"], int] = {
    "bags": 22,
    "cluster": 52,
    "copc": 2,
    "heif": 27,
    "learned": 29,
    "mesh": 4,
    "reference": 150,
    "scans": 64,
    "simulator": 46,
    "terrain": 6,
    "vectors": 130,
    "viewer": 5,
    "cuda": 5000,
}


@dataclass(frozen=True)
class Part:
    """Part of an installation: its version or place, or None if it is missing, and then how to get it."""

    name: str
    found: str | None
    remedy: str


def module_of(package: str) -> str:
    """Return the module that a package of an extra installs."""
    return {"cloth-simulation-filter": "CSF", "pillow-heif": "pillow_heif"}.get(package, package)


def installing(extra: str) -> str:
    """Return the command that adds an extra, from where this program came: a checkout, a file, an index."""
    home = Path(__file__).parents[2]
    if (home / "pyproject.toml").is_file():
        return f"pip install '{home}[{extra}]'"
    with contextlib.suppress(metadata.PackageNotFoundError):
        origin = json.loads(metadata.distribution("georefgs").read_text("direct_url.json") or "{}")
        url = origin.get("url", "")
        if url.startswith("file:"):
            return f"pip install '{url2pathname(urlsplit(url).path)}[{extra}]'"
        if url:
            vcs = f"{origin['vcs_info']['vcs']}+" if "vcs_info" in origin else ""
            return f"pip install 'georefgs[{extra}] @ {vcs}{url}'"
    return f"pip install 'georefgs[{extra}]'"


def require(extra: Extra) -> None:
    """Raise a BackendUnavailableError unless the libraries of an extra are installed."""
    part = extra_part(extra)
    if part.found is None:
        raise BackendUnavailableError("extra-missing", part.remedy)


def extra_part(extra: Extra) -> Part:
    """Return an extra with its libraries' versions, or with what is missing and the command that installs it."""
    user, libraries = EXTRAS[extra]
    missing = [name for name in libraries if find_spec(module_of(name)) is None]
    if missing:
        remedy = f"{user} needs {', '.join(missing)}, which the extra {extra} installs: {installing(extra)}"
        return Part(extra, None, remedy)
    return Part(extra, ", ".join(f"{name} {metadata.version(name)}" for name in libraries), "")
