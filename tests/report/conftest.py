"""An evaluated workspace with its page, made once for all tests of the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.stages import REPORT_PAGE
from pipelines.core.workspace import StageRun
from pipelines.geometry.network import Network
from pipelines.geometry.sparse_model import SparseModel
from pipelines.report.options import ReportOptions
from pipelines.report.stage import run
from pipelines.report.views import adjusted_network, read_evaluated, seen_scene
from pipelines.survey.navigation import load_survey
from pipelines.survey.report import EvaluationReport
from pipelines.survey.solution import Solution, read_sfm
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, usable_crs
from tests.evaluated_workspaces import Evaluated, evaluated_workspace

HOSTILE = "<script>alert(1)</script>"  # in the names of all points, so that every test meets it


@dataclass(frozen=True)
class Reported:
    """True scene with its workspace, what the report loads of it, and the report's page."""

    truth: Evaluated
    solution: Solution
    report: EvaluationReport
    html: str

    @property
    def posterior(self) -> Posterior:
        return posterior_of(self.truth.workspace, self.solution, self.sfm)

    @property
    def sfm(self) -> SparseModel:
        return read_sfm(self.truth.workspace, self.solution)

    @property
    def survey(self) -> Survey:
        return self.solution.weighted(load_survey(self.truth.workspace))

    @property
    def crs(self) -> TargetCrs:
        survey = self.survey
        return usable_crs(ReportOptions(), survey.origin, self.solution.center_in_geo, survey.vertical)

    @property
    def network(self) -> Network:
        return adjusted_network(self.solution, self.sfm)

    @property
    def scene_in_geo(self) -> np.ndarray:
        return seen_scene(self.network, self.solution.similarity)


def page_of(made: Evaluated, options: ReportOptions | None = None) -> str:
    """Return the page of a workspace, made in its place."""
    out = made.workspace.root / "report"
    out.mkdir(exist_ok=True)
    run(StageRun(made.workspace, out), options or ReportOptions())
    return (made.workspace.root / REPORT_PAGE).read_text("utf-8")


@pytest.fixture(scope="package")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    made = evaluated_workspace(tmp_path_factory.mktemp("report") / "flight", rename=HOSTILE)
    return Reported(made, *read_evaluated(made.workspace), page_of(made))
