"""An evaluated workspace with its page, made once for all tests of the report."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pipelines.core.stages import REPORT_PAGE
from pipelines.core.workspace import StageRun
from pipelines.report.options import ReportOptions
from pipelines.report.stage import run
from pipelines.report.views import EvaluatedSurvey, load_evaluated
from tests.evaluated_workspaces import Evaluated, evaluated_workspace

HOSTILE = "<script>alert(1)</script>"  # in the names of all points, so that every test meets it


@dataclass(frozen=True)
class Reported:
    """True scene with its workspace, the survey as the report loads it, and the report's page."""

    truth: Evaluated
    survey: EvaluatedSurvey
    html: str


def page_of(made: Evaluated, options: ReportOptions | None = None) -> str:
    """Return the page of a workspace, made in its place."""
    out = made.workspace.root / "report"
    out.mkdir(exist_ok=True)
    run(StageRun(made.workspace, out), options or ReportOptions())
    return (made.workspace.root / REPORT_PAGE).read_text("utf-8")


@pytest.fixture(scope="package")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    made = evaluated_workspace(tmp_path_factory.mktemp("report") / "flight", rename=HOSTILE)
    return Reported(made, load_evaluated(made.workspace, ReportOptions()), page_of(made))
