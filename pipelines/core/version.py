"""The version of this program, with the commit or tag that it was made from."""

import subprocess
from pathlib import Path

from pipelines import __version__

PACKED = "pipelines/commit.txt"  # only in a package: a build writes it (setup.py)


def described_version() -> str:
    """Return the version with the commit, if it is known: `0.2.0 (v0.2.0)`, `0.2.0 (v0.2.0-5-g1a2b3c4)`."""
    home = Path(__file__).parents[2]
    packed = home / PACKED
    commit = packed.read_text(encoding="utf-8").strip() if packed.is_file() else described_commit(home)
    return f"{__version__} ({commit})" if commit else __version__


def described_commit(checkout: Path) -> str | None:
    """Return the commit of a checkout by the last tag of a release, `-dirty` if files differ; None: it is none."""
    if not (checkout / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(checkout), "describe", "--tags", "--match", "v*", "--always", "--dirty"],
            check=True,
            capture_output=True,
            text=True,
            encoding="utf-8",
        )
    except (OSError, subprocess.CalledProcessError):  # no git, or another user's checkout
        return None
    return done.stdout.strip() or None
