"""The surface has an accuracy of its own: a roof that is too low is no fault of the triangulated points."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.products import load_json, save_json
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, MODEL, REPORT, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.splat.gaussians import read_gaussians, write_gaussians
from pipelines.survey.report import EvaluationReport
from pipelines.survey.solution import TrainedModel
from pipelines.survey.survey import Survey

pytestmark = pytest.mark.usefixtures("one_thread")

ROOF_M, LOW_M = 6.0, 0.5
REACH_M = 6.0


@pytest.fixture(scope="module")
def with_roof(evaluated: tuple[Workspace, Outcome], tmp_path_factory: pytest.TempPathFactory) -> EvaluationReport:
    """Flat ground with a roof over one check point, which the Gaussians show 0.5 m too low.

    The marks stay as they were: only the surface is looked at.
    """
    root = tmp_path_factory.mktemp("roof") / "ws"
    shutil.copytree(evaluated[0].root, root, symlinks=True, ignore=shutil.ignore_patterns("evaluate"))
    workspace = Workspace(root)
    survey = load_json(Survey, workspace.path(SURVEY))
    plan = [point.position_in_geo[:2] for point in survey.check_points]
    points = tuple(
        point.model_copy(update={"position_in_geo": (*place, 0.0 if index else ROOF_M)})
        for index, (point, place) in enumerate(zip(survey.check_points, plan, strict=True))
    )
    save_json(survey.model_copy(update={"check_points": points}), root / SURVEY)
    model, gaussians = load_json(TrainedModel, root / MODEL), read_gaussians(root / GAUSSIANS)
    in_geo = model.similarity.apply(gaussians.means.numpy())
    above = np.abs(in_geo[:, :2] - plan[0]).max(axis=1) < REACH_M
    in_geo[:, 2] = np.where(above, ROOF_M - LOW_M, 0.0)
    means = torch.from_numpy(model.similarity.inverse().apply(in_geo)).float()
    write_gaussians(root / GAUSSIANS, replace(gaussians, means=means))
    run_stage(workspace, BY_NAME["evaluate"], {"renders": 0, "tolerance_h": 0.05, "tolerance_v": 0.4})
    return load_json(EvaluationReport, root / REPORT)


def test_a_low_roof_is_found_on_the_roof_alone(with_roof: EvaluationReport) -> None:
    first, *others = with_roof.checkpoints.heights
    # The Gaussians are 0.1 m thick.
    assert first.place == "raised" and first.du_m == pytest.approx(-LOW_M, abs=0.1)
    assert {row.place for row in others} == {"ground"}
    assert all(row.du_m is not None and abs(row.du_m) < 0.15 for row in others)
    surface = with_roof.headline.surface
    assert surface is not None and surface.ground is not None and surface.raised is not None
    assert (surface.ground.check_points, surface.raised.check_points) == (5, 1)
    assert surface.raised.rmse_v_m == pytest.approx(LOW_M, abs=0.1) and surface.ground.rmse_v_m < 0.15
    assert "cm on roofs" in with_roof.headline.text and "triangulated" in with_roof.headline.text


def test_tolerances_are_judged_by_the_standards_rule(with_roof: EvaluationReport) -> None:
    verdicts = {test.of: test.verdict for test in with_roof.tolerances}
    # Six points are fewer than the 30 that a pass needs; a fail needs no number.
    assert verdicts["vertical, of the surface on the ground"] == "met"
    assert verdicts["vertical, of the surface on roofs and other raised places"] == "fail"
    assert len(with_roof.tolerances) == 4


def test_without_training_the_surface_has_no_accuracy(untrained: Workspace) -> None:
    run_stage(untrained, BY_NAME["evaluate"], {"tolerance_v": 0.4})
    report = load_json(EvaluationReport, Path(untrained.root) / REPORT)
    assert report.headline.surface is None and not report.checkpoints.heights
    assert [test.of for test in report.tolerances] == ["vertical, of triangulated points"]
