"""Python that has QGIS; as a script, it tells whether there is one: `python -m tests.qgis.qgis_python`."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys


@functools.cache
def qgis_python() -> str:
    """Return the Python in which QGIS can be imported: QGIS_PYTHON, else the system's.

    Raises:
        RuntimeError: there is none; the message says what to install.
    """
    for python in (os.environ.get("QGIS_PYTHON"), "/usr/bin/python3", shutil.which("python3")):
        if python and shutil.which(python):
            environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "PYTHONPATH": ""}
            asked = [python, "-c", "import qgis.core"]
            if subprocess.run(asked, env=environment, capture_output=True, check=False, timeout=60).returncode == 0:
                return python
    raise RuntimeError(
        "The tests in QGIS need QGIS 3.22 or newer: apt-get install --no-install-recommends qgis qgis-providers "
        "python3-qgis, or name the Python that has it in the variable QGIS_PYTHON."
    )


if __name__ == "__main__":
    try:
        qgis_python()
    except RuntimeError as error:
        sys.exit(str(error))
