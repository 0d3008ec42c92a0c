"""How this program starts Python again, for native code, jobs, workers and compilers: the one place that knows.

Python looks for modules in the current folder first when it is started with `-m` or `-c`. That folder belongs to
the photographs, and a `queue.py` among them is a file of the user, not code of this program.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

# Arguments of Python that start the command line.
THIS_PROGRAM = ("-m", "georef_cli")
_HOME = Path(__file__).parents[2]


def python_command(arguments: Sequence[str]) -> list[str]:
    """Return the command that runs this Python, which takes no module from the current folder.

    Args:
        arguments: of Python, such as `-m` and a module.
    """
    return [sys.executable, "-P", *arguments]


def python_environment() -> dict[str, str]:
    """Return this environment, in which Python finds the modules that this process finds, and none beside the data.

    The safe path is also a variable, for what libraries start by themselves: Dask's nannies spawn their workers.
    A checkout that is itself the current folder comes last, behind the standard library and installed packages.
    """
    path = [entry for entry in sys.path if Path(entry).is_absolute() and not _is_current(Path(entry))]
    if _is_current(_HOME):
        path.append(str(_HOME))
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(path)}


def _is_current(folder: Path) -> bool:
    """Return whether a folder is the current one, by whatever name."""
    try:
        return folder.samefile(os.curdir)
    except OSError:  # Python lists a `python311.zip` that does not exist.
        return False
