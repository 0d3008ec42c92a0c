"""Real surveys for tests that kill real commands: tiny, and made once."""

from __future__ import annotations

import io
import json
import re
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipelines.splat.gaussians import read_gaussians
from tests.cli_runs import Result, finish
from tests.forked import start_georef

GEOREF = "from georef_cli.main import main; main()"
ONE_THREAD = ("--threads", "1")  # makes each product the same in every run
PATIENCE_S = 240.0  # a process may have to compile kernels first
_TIMES = re.compile(r"peak_bytes|started|duration_s|files|input_files|.*seconds.*|.*processor_s")
_TIMES_OF_PAGES = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d UTC|[\d.]+ s\b|\d+ min \d\d s")


def make_survey(folder: Path) -> None:
    """Write nine photographs of 200 × 150 pixels in nadir lines, with control and check points."""
    layout = ("--flight", "grid", "--height", 60, "--radius", 10, "--targets", 12, "--control", 4)
    georef("simulate", folder, "--images", 9, "--size", "200x150", "--samples", 1, *layout)


def asked(survey: Path) -> tuple[str, ...]:
    """Return the options of a run of that survey to 40 iterations."""
    return (
        *("--images", str(survey / "images"), "--trajectory", str(survey / "trajectory.csv")),
        *("--gcp", str(survey / "gcp_list.txt"), "--checkpoints", str(survey / "checkpoints.txt")),
        *("--preset", "smoke", "--iterations", "40"),
    )


def make_finished(workspace: Path) -> None:
    """Make a workspace with every product, from a survey beside it."""
    survey = workspace.with_name("survey")
    make_survey(survey)
    georef("run", workspace, *asked(survey), "--deliver", "all", *ONE_THREAD)


def georef(*words: object) -> Result:
    """Run a command to its end, which must be a good one."""
    done = finish(start_georef(*words), PATIENCE_S)
    assert done.code == 0, done.err
    return done


def killed(words: tuple[object, ...], begun: Callable[[], bool], after_s: float) -> bool:
    """Run a command, and kill it some time after it has begun; return whether it was killed before its end."""
    process = start_georef(*words)
    deadline = time.monotonic() + PATIENCE_S
    while process.poll() is None and not begun():
        assert time.monotonic() < deadline
        time.sleep(0.001)
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.kill()
    return finish(process, PATIENCE_S).code != 0


def assert_same(folder: Path, expected: Path) -> None:
    """The files of two products of one request are the same but for times."""
    names = [path.relative_to(expected) for path in sorted(expected.rglob("*")) if path.is_file()]
    assert [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()] == names
    for name in names:
        made, wanted = _without_times(folder / name), _without_times(expected / name)
        if name.suffix == ".ply" and made != wanted:
            assert_same_ply(folder / name, expected / name)
        else:
            assert made == wanted, name


def assert_same_ply(made: Path, expected: Path) -> None:
    """The Gaussians are the same up to the last bit, which the place of arrays in memory decides in a few."""
    for values, wanted in zip(*(read_gaussians(path).tensors().values() for path in (made, expected)), strict=True):
        torch.testing.assert_close(values, wanted, rtol=1e-6, atol=1e-8)


def _without_times(path: Path) -> object:
    data = path.read_bytes()
    if path.suffix == ".json":
        return _untimed(json.loads(data))
    if path.suffix == ".jsonl":
        return [_untimed(json.loads(line)) for line in data.splitlines()]
    if path.suffix == ".npz":
        with np.load(io.BytesIO(data)) as arrays:
            return {name: arrays[name].tobytes() for name in arrays.files if not _TIMES.fullmatch(name)}
    return _TIMES_OF_PAGES.sub(b"", data) if path.suffix == ".html" else data


def _untimed(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _untimed(part) for name, part in value.items() if not _TIMES.fullmatch(name)}
    return [_untimed(part) for part in value] if isinstance(value, list) else value
