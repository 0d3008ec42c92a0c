"""Standard error belongs to the program: lines of libraries, of Python and of errors, with and without JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli_runs import finish, start

# Lines as libtiff (through C's stdio), OpenCV, glog (to the descriptor) and a child process write them.
NOISY = """
import ctypes, os, subprocess, sys, threading, warnings
from pipelines.core.stages import BY_NAME
from tests import fakes
def noisy(stage, options):
    os.write(2, b"[ WARN:0@0.160] global grfmt_tiff.cpp:123 TIFF_Warning\\n")
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        libc.dprintf(2, b"TIFFReadDirectory: Warning, Unknown field with tag 48020\\n")
    glog = "import sys; print('I1127 mapper.cc:1] glog', file=sys.stderr)"
    subprocess.run([sys.executable, "-c", glog], check=True)
    warnings.warn("invalid value encountered in divide", RuntimeWarning)
    print("a library of Python", file=sys.stderr)
    os.write(2, b"many\\n" * 900 + b"the last line before the end\\n")
    {end}
fakes.install(ingest=noisy)
from georef_cli.main import main
main()
"""
ENDS = {
    0: "return fakes.fake_run(BY_NAME['ingest'])(stage, options)",
    1: "raise ZeroDivisionError('a defect')",
}


def _lines(text: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.parametrize("code", [0, 1])
def test_every_line_is_json(tmp_path: Path, photos: Path, code: int) -> None:
    words = ("--json-progress", "ingest", tmp_path / "ws", "--images", photos)
    ended = finish(start(*words, code=NOISY.replace("{end}", ENDS[code])))
    assert ended.code == code, ended.err
    lines = _lines(ended.err)
    told = [str(line.get("text", "")) for line in lines if line["kind"] == "log"]
    assert "a library of Python" in told
    assert any("invalid value encountered" in text for text in told)
    assert not any("TIFF" in text or "glog" in text for text in told), "they are for the log alone"
    if code:
        (error,) = (line for line in lines if line["kind"] == "error")
        assert error["error_kind"] == "defect" and "ZeroDivisionError: a defect" in str(error["text"])
    log = (tmp_path / "ws/logs/ingest.log").read_text("utf-8")
    assert "grfmt_tiff.cpp" in log and "mapper.cc" in log
    assert "the last line before the end" in log, "the stage's log is complete, however late its lines are read"


def test_without_json_they_are_seen_with_verbose_alone(tmp_path: Path, photos: Path) -> None:
    noisy = NOISY.replace("{end}", ENDS[0])
    plain = finish(start("ingest", tmp_path / "a", "--images", photos, code=noisy))
    assert plain.code == 0 and "TIFF" not in plain.err and "glog" not in plain.err
    verbose = finish(start("ingest", tmp_path / "b", "--images", photos, "-v", code=noisy))
    assert "debug: a library wrote: [ WARN:0@0.160] global grfmt_tiff.cpp" in verbose.err


def test_usage_and_known_errors_are_json(tmp_path: Path) -> None:
    usage = finish(start("status", "--json-progress"))
    failed = finish(start("ingest", tmp_path / "ws", "--images", tmp_path / "none", "--json-progress"))
    for ended, kind, text in ((usage, "usage", "Missing argument 'WS'"), (failed, "input", "does not exist")):
        error = _lines(ended.err)[-1]
        assert error["kind"] == "error" and error["error_kind"] == kind and text in str(error["text"])
