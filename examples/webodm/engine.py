"""Engine of a NodeODM node: its call becomes one call of `georef run`, and the products OpenDroneMap's files.

    run.sh --project-path FOLDER [--OPTION VALUE] ... TASK

The photographs are in FOLDER/TASK/images, the workspace in FOLDER/TASK/workspace. Options are in
`opendm/config.py`, files in `outputs.py`. Progress goes to the node as datagrams, messages to stdout. A call that
is repeated goes on where the last one was stopped. Exit codes are those that NodeODM explains: 1 the photographs
cannot be processed, 3 something is not installed, 137 not enough memory; and 2 for options, 130 for a stopped call.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))  # NodeODM's folder of an engine is no package

import outputs
from opendm.config import OPTIONS, STEPS, config

from pipelines.core.errors import GeorefError

NODE = ("127.0.0.1", 6367)
# Share of the progress that is the engine's: NodeODM itself reports 93 and 97 while it packs the files.
WHOLE = 90.0
PRESETS = {"ultra": "high", "high": "high", "medium": "standard", "low": "fast", "lowest": "smoke"}
FEATURE_PIXELS = {"ultra": 3200, "high": 1600, "medium": 1200, "low": 800, "lowest": 600}
CROPPED = ("export-ply", "export-spz", "export-tiles")
# Exit codes that NodeODM explains, by the kind of georef's error.
EXIT_CODES = {"backend": 3, "resources": 137}
STOPPED, NOT_INSTALLED = 130, 3
LINE_EVERY_S = 10.0
# What georef has to put its work in order before it is stopped once more, and a stopped one to leave its workspace.
PATIENCE_S, BUSY_S = 5.0, 120.0


class RefusedError(Exception):
    """Call that cannot be done; the message says why, and what to do."""


def main() -> int:
    """Do one task, and return the exit code."""
    given = config()
    project = Path(given.project_path).resolve() / given.name
    journal = Journal({name: getattr(given, name.replace("-", "_")) for name in OPTIONS})
    try:
        if not (project / "images").is_dir():
            raise RefusedError(f"{project} has no folder images.")
        words = run_words(given, project)
        for remark in remarks(given, project):
            journal.say("warning", remark)
        code, result = run_georef(words, journal, Progress(given.name))
        if code == 0:
            outputs.lay_out(project, result, wanted_outputs(given), journal.say)
    except (RefusedError, GeorefError, OSError, ValueError) as error:
        journal.say("error", str(error))
        code = 1
    if project.is_dir():
        outputs.write(project / "log.json", journal.document(code))
    return code


def run_words(given: argparse.Namespace, project: Path) -> list[str]:
    """Return the words of the call of `georef` for options of the node; no shell ever sees them.

    A value is joined to its option, so that none is taken for an option of its own.
    """
    steps = list(STEPS)
    last = steps.index(given.end_with)
    preset = given.preset
    if preset == "by-quality":
        preset = "fast" if given.fast_orthophoto else PRESETS[given.pc_quality]
    words = ["run", str(project / "workspace"), f"--images={project / 'images'}"]
    words += ["--forget=all", f"--threads={max(given.max_concurrency, 1)}"]
    words += [f"--{name}={getattr(given, name)}" for name in ("gcp", "geo", "vertical") if getattr(given, name)]
    if given.gps_accuracy > 0:
        words += [f"--sigma-h={given.gps_accuracy}", f"--sigma-v={given.gps_accuracy}"]
    if given.rerun_from and (project / "workspace").is_dir():
        words += [f"--from={STEPS[given.rerun_from]}", "--force"]
    if last < steps.index("openmvs"):
        words.append(f"--to={STEPS[given.end_with]}")
    sets: dict[str, Any] = {}
    if last >= steps.index("opensfm"):
        sets["sfm.max_image_size"] = FEATURE_PIXELS[given.feature_quality]
    if last >= steps.index("openmvs"):
        words.append(f"--preset={preset}")
        required = {"--tolerance-h": given.tolerance_h, "--tolerance-v": given.tolerance_v}
        words += [f"{option}={metres}" for option, metres in required.items() if metres > 0]
        if given.boundary:
            words.append(f"--boundary={boundary_file(given.boundary, project)}")
        if given.align:
            sets["evaluate.reference"] = json.dumps(str(reference_of(given.align)))
        delivered = deliverables(given) if last >= steps.index("odm_orthophoto") else []
        if delivered:
            words.append(f"--deliver={','.join(delivered)}")
        made = {"export-ply", *(name if name == "report" else f"export-{name}" for name in delivered)}
        sets |= {f"{stage}.crop": "true" for stage in CROPPED if stage in made and given.crop > 0}
        if "raster" in delivered:
            sets["export-raster.terrain"] = str(given.dtm).lower()
            widths = [width for width in (given.orthophoto_resolution, given.dem_resolution) if width > 0]
            if widths:
                sets["export-raster.gsd"] = min(widths) / 100.0
        if "report" in delivered:
            sets |= {"report.pdf": str(outputs.can_print()).lower(), "report.title": json.dumps(given.name)}
    return words + [f"--set={name}={value}" for name, value in sets.items()]


def remarks(given: argparse.Namespace, project: Path) -> list[str]:
    """Return what a call asks and does not get, in sentences."""
    widths = {given.orthophoto_resolution, given.dem_resolution} - {0.0}
    said = {
        f"All rasters have cells of {min(widths, default=0)} cm, the smaller of orthophoto-resolution and "
        "dem-resolution.": len(widths) > 1,
        f"{Path(given.align).name} is compared with the surface, in the report. The survey is not moved onto it: "
        "give control points to correct its place.": bool(given.align),
        "split-image-groups is not used: large surveys are divided by themselves.": bool(given.split_image_groups),
        f"rerun-from {given.rerun_from} is not used: this task has no earlier run here.": (
            bool(given.rerun_from) and not (project / "workspace").is_dir()
        ),
    }
    return [sentence for sentence, is_so in said.items() if is_so]


def deliverables(given: argparse.Namespace) -> list[str]:
    """Return the deliverables that a call makes, by the names of `georef run --deliver`."""
    asked = {
        "raster": True,
        "cloud": not given.fast_orthophoto,
        "mesh": not (given.fast_orthophoto or given.skip_3dmodel),
        "spz": True,
        "tiles": getattr(given, "3d_tiles"),
        "cameras": True,
        "report": not given.skip_report and given.end_with != "odm_orthophoto",
    }
    return [name for name, is_asked in asked.items() if is_asked]


def wanted_outputs(given: argparse.Namespace) -> set[str]:
    """Return the names of the groups of `outputs.FILES` that a call delivers."""
    if list(STEPS).index(given.end_with) < list(STEPS).index("odm_orthophoto"):
        return set()
    wanted = {"splat", *deliverables(given)}
    return wanted | {name for name in ("dsm", "dtm") if getattr(given, name)}


def boundary_file(text: str, project: Path) -> Path:
    """Write the boundary that the node gives as JSON into the task's folder, and return the file."""
    path = project / "boundary.geojson"
    outputs.write(path, {"type": "Feature", "properties": {}, **_polygons(text)})
    return path


def _polygons(text: str) -> dict[str, Any]:
    """Return a multipolygon, and the CRS if there is one, of GeoJSON.

    NodeODM 2.2.4 removes the quotation marks of every value that it hands over: what is left of GeoJSON has its
    coordinates, whose depth tells polygons from other shapes, and the name of its CRS.
    """
    polygons: list[Any] = []
    for found in re.finditer(r'"?coordinates"?\s*:\s*(\[[-+\d.eE\s,\[\]]*\])', text):
        coordinates, depth = json.loads(found[1]), 0
        level = coordinates
        while isinstance(level, list) and level:
            level, depth = level[0], depth + 1
        if depth not in (3, 4):
            raise RefusedError("--boundary: only polygons and multipolygons of GeoJSON are an area.")
        polygons += [coordinates] if depth == 3 else coordinates
    if not polygons:
        raise RefusedError("--boundary: the text has no polygon of GeoJSON.")
    found_crs = re.search(r'"?crs"?\s*:\s*\{[^}]*?"?name"?\s*:\s*"?([\w:./-]+:[\w:./-]+)"?\s*\}', text)
    if found_crs is None and re.search(r'"?crs"?\s*:\s*\{', text):
        raise RefusedError("--boundary: its CRS has no name. Give longitude and latitude, as GeoJSON wants.")
    document: dict[str, Any] = {"geometry": {"type": "MultiPolygon", "coordinates": polygons}}
    if found_crs is not None:
        document["crs"] = {"type": "name", "properties": {"name": found_crs[1]}}
    return document


def reference_of(path: str) -> Path:
    """Return the cloud that the survey is compared with; a survey is not moved onto it."""
    if not path.lower().endswith((".las", ".laz")):
        raise RefusedError(f"--align: {Path(path).name} is no cloud (LAS or LAZ). Give control points instead.")
    return Path(path)


class Progress:
    """Progress of a task, told to the node as `PGUP/PID/UUID/PERCENT`.

    A run has stages that count alike. A stage has an unknown number of tasks: each takes it half of the way that is
    left to its end.
    """

    def __init__(self, name: str, node: tuple[str, int] = NODE) -> None:
        self._name, self._node = name, node
        self._open: list[list[float]] = []  # steps and total of each open task; the outermost counts stages
        self._ended = 0  # tasks of this stage
        self._told = -1.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def take(self, message: Mapping[str, Any]) -> str:
        """Follow one message of `georef --json-progress`; return the stage that it begins, or nothing."""
        stage = ""
        match message["kind"]:
            case "begin":
                self._open.append([0.0, float(message["total"] or 0)])
            case "advance":
                self._open[-1][0] += message["steps"]
                if len(self._open) == 1:
                    self._ended = 0
                    stage = "" if message["steps"] else message["note"]
            case "end":
                self._open.pop()
                self._ended += len(self._open) == 1
        self.tell(WHOLE * self.share())
        return stage

    def share(self) -> float:
        """Return the share of the run that is done, from 0 to 1."""
        if not self._open:
            return max(self._told, 0.0) / WHOLE
        (stages, total), inner = self._open[0], self._open[1:2]
        left = 0.5**self._ended
        done = 1.0 - left + (left / 2.0 * min(inner[0][0] / inner[0][1], 1.0) if inner and inner[0][1] else 0.0)
        return min((stages + done) / total, 1.0) if total and stages < total else 1.0

    def tell(self, percent: float) -> None:
        """Send the progress if it is new; whether the node hears it changes nothing."""
        if percent < self._told + 0.05 and percent < WHOLE:
            return
        self._told = max(percent, self._told)
        try:
            self._socket.sendto(f"PGUP/{os.getpid()}/{self._name}/{self._told:.1f}".encode(), self._node)
        except OSError:
            return


class Journal:
    """Messages of a task: lines of the console, and `log.json` in OpenDroneMap's form."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._started = datetime.now()
        self._options = dict(options)
        self._stages: list[dict[str, Any]] = []
        self._line_at = 0.0
        self.begin("task")

    def begin(self, stage: str) -> None:
        """Begin a stage, to which the messages that follow belong."""
        self._stages.append({"name": stage, "startTime": datetime.now().isoformat(), "messages": []})

    def say(self, level: str, text: str) -> None:
        """Print a message, and keep it."""
        self._stages[-1]["messages"].append({"message": text, "type": level})
        for line in text.splitlines():
            print(f"{f'[{level.upper()}]':<9} {line}", flush=True)

    def take(self, message: Mapping[str, Any]) -> None:
        """Show one message of `georef --json-progress`."""
        match message["kind"]:
            case "log":
                self.say({30: "warning", 40: "error", 50: "error"}.get(message["level"], "info"), message["text"])
            case "error":
                self.say("error", message["text"].removeprefix("error: "))
            case "advance" if message["note"] and time.monotonic() > self._line_at + LINE_EVERY_S:
                self._line_at = time.monotonic()
                print(f"          {message['note']}", flush=True)

    def document(self, code: int) -> dict[str, Any]:
        """Return the content of `log.json`."""
        ended = datetime.now()
        return {
            "odmVersion": (Path(__file__).parent / "VERSION").read_text(encoding="utf-8").strip(),
            "engine": "georef",
            "options": self._options,
            "startTime": self._started.isoformat(),
            "endTime": ended.isoformat(),
            "totalTime": round((ended - self._started).total_seconds(), 2),
            "stages": self._stages,
            "success": code == 0,
            **({} if code == 0 else {"error": {"code": code, "message": self._last_error()}}),
        }

    def _last_error(self) -> str:
        said = [message for stage in self._stages for message in stage["messages"] if message["type"] == "error"]
        return said[-1]["message"] if said else "stopped"


def program() -> list[str]:
    """Return the words that start `georef`: what GEOREF names, else that of this Python."""
    named = os.environ.get("GEOREF")
    return [named] if named else [sys.executable, "-P", "-m", "georef_cli"]


def run_georef(words: list[str], journal: Journal, progress: Progress) -> tuple[int, dict[str, Any]]:
    """Run `georef` to its end, and return the exit code and the result.

    A task that is restarted at once may meet the one that was stopped: it waits until that has left the workspace.
    """
    deadline = time.monotonic() + BUSY_S
    while True:
        code, kind, result = _run_once(words, journal, progress)
        if kind != "busy" or code in (0, STOPPED) or time.monotonic() > deadline:
            return EXIT_CODES.get(kind, code), result
        time.sleep(2.0)


def _run_once(words: list[str], journal: Journal, progress: Progress) -> tuple[int, str, dict[str, Any]]:
    """Return the exit code of `georef`, the kind of its error, and its result.

    NodeODM stops a task by SIGTERM to every process of its tree, and `georef` then puts its work in order. The node
    takes the exit of this process as that of a task that was restarted meanwhile: it exits at once, and a copy of
    it waits for `georef`.
    """
    command = [*program(), "--json-progress", *words, "--json"]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as result:
        try:
            process = subprocess.Popen(command, stdout=result, stderr=subprocess.PIPE, text=True, encoding="utf-8")
        except OSError as error:
            journal.say("error", f"{command[0]} cannot be started: {error}")
            return NOT_INSTALLED, "", {}
        kind = ""
        with _stops_handed_to(process) as stopped:
            for message in _messages(process):
                if stopped:
                    continue
                if stage := progress.take(message):
                    journal.begin(stage)
                journal.take(message)
                kind = message.get("error_kind", kind)
            code = process.wait()
        if stopped:
            return STOPPED, "", {}
        if code < 0:
            journal.say("error", f"georef was ended by signal {-code}.")
            return 128 - code, "", {}
        result.seek(0)
        return code, kind, json.load(result) if code == 0 else {}


def _messages(process: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    """Yield the messages of `georef`; a line that is none, as of Python itself, becomes a warning."""
    assert process.stderr is not None
    for line in process.stderr:
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if isinstance(message, dict) and "kind" in message:
            yield message
        elif line.strip():
            yield {"kind": "log", "level": 30, "text": line.rstrip()}


@contextmanager
def _stops_handed_to(process: subprocess.Popen[str]) -> Iterator[list[int]]:
    """Go on in a silent copy of this process after a signal to stop, which is remembered.

    A `georef` that has not heard the signal is sent it.
    """
    stopped: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        if stopped:
            return
        sys.stdout.flush()
        if os.fork():
            os._exit(STOPPED)
        stopped.append(number)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        timer = threading.Timer(PATIENCE_S, process.terminate)
        timer.daemon = True
        timer.start()

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
