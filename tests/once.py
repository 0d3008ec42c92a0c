"""What tests share on the disk: between the processes of a run, and between the tests of a process."""

from __future__ import annotations

import atexit
import contextlib
import shutil
import tempfile
from collections.abc import Callable, Hashable, Mapping
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout


def make_once(tasks: Mapping[Path, Callable[[Path], object]]) -> None:
    """Call each function with the path of what it makes, unless another process of this run has, or does."""
    for wait in (False, True):  # first what nobody has begun
        for made, make in tasks.items():
            made.parent.mkdir(exist_ok=True)
            done = made.with_name(f"{made.name}.done")
            with contextlib.suppress(Timeout), FileLock(f"{made}.lock", blocking=wait):
                if not done.exists():
                    make(made)
                    done.touch()


def fill_folder(root: Path, key: Hashable, make: Callable[[Path], object]) -> Path:
    """Fill a folder as `make` does, and return it. What has a key is made once in this process, then copied.

    Each test has a copy of its own, which it may change. What is made must not depend on its place.
    """
    kept = _kept_folders()
    if key not in kept:
        made = _folder_of_this_process() / str(len(kept))
        make(made)
        kept[key] = made
    return Path(shutil.copytree(kept[key], root, symlinks=True, dirs_exist_ok=True))


@cache
def _kept_folders() -> dict[Hashable, Path]:
    return {}


@cache
def _folder_of_this_process() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="georef-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
