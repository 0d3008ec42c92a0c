"""The README's Python example, run as its reader would."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from pipelines.core.runner import Outcome
from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.survey.report import read_report
from tests.scripts import REPOSITORY


def test_example_prints_the_products_figures(evaluated: tuple[Workspace, Outcome], tmp_path: Path) -> None:
    workspace = evaluated[0]
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "workspace").symlink_to(workspace.root.resolve(), target_is_directory=True)
    (example,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text("utf-8"), re.DOTALL)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    run = subprocess.run(
        [sys.executable, "-c", example], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    headline = read_report(workspace.path(REPORT)).headline
    assert len(run.stdout.splitlines()) == 3
    assert headline.sentence in run.stdout
