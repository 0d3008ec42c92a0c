"""The program `georef` as a process: words in, messages and progress to QGIS, the result as a document."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import QgsProcessingException, QgsProcessingFeedback

SETTING = "GEOREF_PROGRAM"
_WAIT_S = 0.2
_WARNING, _ERROR = 30, 40


def program() -> str:
    """Return the program: Processing's option, else the variable GEOREF, else that on PATH."""
    found = ProcessingConfig.getSetting(SETTING) or os.environ.get("GEOREF") or shutil.which("georef")
    if not found:
        raise QgsProcessingException(
            "The program georef was not found. Install georefgs, and name the program in Settings > Options > "
            "Processing > Providers > GeoRefGS."
        )
    return str(found)


def call(words: Sequence[str], feedback: QgsProcessingFeedback) -> Any:
    """Run `georef` with words, none of which a shell sees, and return its result.

    Raises:
        QgsProcessingException: the program failed, with its message, or was cancelled.
    """
    command = [program(), "--json-progress", *words, "--json"]
    feedback.pushCommandInfo(" ".join(command))
    # QGIS's own Python must not enter that of the program.
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    with tempfile.TemporaryFile("w+", encoding="utf-8") as result:
        try:
            process = subprocess.Popen(
                command, stdout=result, stderr=subprocess.PIPE, text=True, encoding="utf-8", env=environment
            )
        except OSError as error:
            raise QgsProcessingException(f"{command[0]} cannot be started: {error}") from error
        with process:
            failure = _follow(process, feedback)
        code = process.returncode
        if feedback.isCanceled():
            raise QgsProcessingException("Cancelled. What is done is kept: the next run goes on from there.")
        if code != 0:
            raise QgsProcessingException(failure or f"georef ended with exit code {code}.")
        result.seek(0)
        return json.load(result)


def _follow(process: subprocess.Popen[str], feedback: QgsProcessingFeedback) -> str:
    """Show the messages of a process until its end, and return that of its error."""
    failure = ""
    tasks: list[list[float]] = []  # steps and total of each open task
    for line in _lines(process, feedback):
        try:
            message = json.loads(line)
        except ValueError:
            feedback.pushWarning(line)
            continue
        kind = message["kind"]
        if kind == "log":
            show = feedback.pushWarning if _WARNING <= message["level"] < _ERROR else feedback.pushInfo
            show(message["text"])
        elif kind == "error":
            failure = message["text"].removeprefix("error: ")
        elif kind == "begin":
            tasks.append([0.0, float(message["total"] or 0)])
        elif kind == "advance":
            tasks[-1][0] += message["steps"]
            if message["note"].strip():
                feedback.setProgressText(message["note"].strip())
        elif kind == "end":
            tasks.pop()
        if tasks and tasks[0][1]:
            share, part = 0.0, 1.0
            for steps, total in tasks[:2]:  # stages, and the task of the stage
                share, part = share + part * steps / max(total, 1.0), part / max(total, 1.0)
            feedback.setProgress(min(100.0 * share, 100.0))
    return failure


def _lines(process: subprocess.Popen[str], feedback: QgsProcessingFeedback) -> Iterator[str]:
    """Yield lines of stderr as they come; a process whose algorithm is cancelled is asked to end."""
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            lines.put(line.rstrip("\n"))
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    asked = False
    while True:
        if feedback.isCanceled() and not asked:
            process.terminate()  # georef puts its work in order
            asked = True
        try:
            line = lines.get(timeout=_WAIT_S)
        except queue.Empty:
            continue
        if line is None:
            return
        if line.strip():
            yield line
