"""The extra `cuda` brings a compiler whose parts are of one version, that of torch's CUDA."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.cli_runs import REPOSITORY

pytestmark = pytest.mark.slow
# torch 2.11 for CUDA pins the toolkit to this release; the pin stands for torch, which takes long to resolve.
TORCHS_TOOLKIT = "13.0.2"
PARTS = ("nvcc", "nvvm", "cuda-crt", "cuda-runtime", "cuda-cccl")


@pytest.mark.skipif(sys.platform != "linux", reason="the extra has wheels of the toolkit for Linux alone")
def test_compiler_resolves_to_one_version(tmp_path: Path) -> None:
    lines = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]["cuda"]
    (toolkit,) = (line.partition(">=")[0] for line in lines if line.startswith("cuda-toolkit"))
    report = tmp_path / "report.json"
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet",
         "--only-binary=:all:", "--report", str(report), f"{toolkit}=={TORCHS_TOOLKIT}"],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    if done.returncode != 0 and re.search("connection|network|resolution|timed out", done.stderr, re.IGNORECASE):
        pytest.skip("no package index to ask")
    assert done.returncode == 0, done.stderr[-1000:]
    found = {
        each["metadata"]["name"]: each["metadata"]["version"] for each in json.loads(report.read_text())["install"]
    }
    versions = {part: version for part in PARTS for name, version in found.items() if name.endswith(part)}
    assert sorted(versions) == sorted(PARTS)
    assert {tuple(version.split(".")[:2]) for version in versions.values()} == {("13", "0")}, versions
