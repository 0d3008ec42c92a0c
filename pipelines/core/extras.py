"""Extras: optional libraries, what needs them, whether they are installed, and the command that installs them."""

from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from typing import Literal

from pipelines.core.errors import BackendUnavailableError

Extra = Literal[
    "bags", "cluster", "heif", "learned", "mesh", "reference", "simulator", "terrain", "vectors", "viewer"
]
# What needs each extra, and the libraries that it installs, by the names of their packages.
EXTRAS: dict[Extra, tuple[str, tuple[str, ...]]] = {
    "bags": ("a ROS bag (--bag, georef inspect)", ("rosbags",)),
    "cluster": ("a cluster (--cluster, georef cluster)", ("distributed", "cryptography")),
    "heif": ("HEIC photographs", ("pillow-heif",)),
    "learned": ("learned features (--features learned)", ("kornia",)),
    "mesh": ("georef export-mesh", ("trimesh",)),
    "reference": ("M3C2 (georef evaluate --reference)", ("py4dgeo",)),
    "simulator": ("georef simulate", ("embreex",)),
    "terrain": ("the ground (dtm.tif, classes of the cloud)", ("cloth-simulation-filter",)),
    "vectors": ("contour lines and boundaries (--contours, --boundary)", ("ezdxf", "pyogrio")),
    "viewer": ("georef view", ("tornado",)),
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
    return f"pip install 'georefgs[{extra}]' (in a checkout: pip install '.[{extra}]')"


def require(extra: Extra) -> None:
    """Raise a BackendUnavailableError unless the libraries of an extra are installed."""
    part = extra_part(extra)
    if part.found is None:
        raise BackendUnavailableError("extra-missing", part.remedy)


def extra_part(extra: Extra) -> Part:
    user, libraries = EXTRAS[extra]
    missing = [name for name in libraries if find_spec(module_of(name)) is None]
    if missing:
        remedy = f"{user} needs {', '.join(missing)}, which the extra {extra} installs: {installing(extra)}"
        return Part(extra, None, remedy)
    return Part(extra, ", ".join(f"{name} {metadata.version(name)}" for name in libraries), "")
