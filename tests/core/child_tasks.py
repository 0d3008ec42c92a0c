"""Work for child processes of the tests."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.progress import Progress


def work(arguments: Mapping[str, Any], progress: Progress) -> Any:
    """Do as native code of every temper does."""
    match arguments["do"]:
        case "add":
            with progress.task("adding", 2) as task:
                task.advance(2, note="done")
            logging.getLogger("pipelines.sum").warning("carry %d", 1)
            sys.stdout.write("chatter of a library\n")
            return sum(arguments["numbers"])
        case "refuse":
            raise DegenerateGeometryError("points-on-a-line", "The points lie on a line.")
        case "refuse a file":
            raise InputError("folder-missing", "There is none.", path="a.csv", line=3)
        case "defect":
            raise ZeroDivisionError("a defect")
        case "abort":
            os.write(2, b"F20261122 04:00:00.0 1 pose.cc:7] Check failed: points > 3 \n*** stack trace\n")
            os.abort()
        case "hang":
            Path(arguments["pid"]).write_text(str(os.getpid()), encoding="ascii")
            ctypes.PyDLL(None).sleep(60)  # holds the interpreter's lock, as pycolmap does
            time.sleep(60)
    return None
