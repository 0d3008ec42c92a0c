"""A workspace to measure in, for all tests."""

from __future__ import annotations

import pytest

from pipelines.core.workspace import Workspace
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.view.measuring import MeasuringModel
from tests.splat_scenes import make_rendered
from tests.view_scenes import renderer_of, smooth, viewed_workspace


@pytest.fixture(scope="session")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The hill, with its true Gaussians as the trained model."""
    return viewed_workspace(tmp_path_factory.mktemp("viewed") / "hill", smooth(make_rendered()))


@pytest.fixture(scope="session")
def model(viewed: Workspace) -> MeasuringModel:
    """The hill, to measure in."""
    return MeasuringModel(viewed, load_survey(viewed), renderer_of(viewed), CrsOptions())
