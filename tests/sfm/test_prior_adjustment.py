"""Stage `adjust`: a disturbed model and fixes with noise against the true cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import ADJUST
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.solution import Solution
from tests.refusals import refused
from tests.scenes import (
    Measured,
    Noise,
    TrueScene,
    make_scene,
    sparse_model,
    survey_of,
    without_fixes,
    write_workspace,
)

pytest.importorskip("pycolmap")
pytestmark = pytest.mark.usefixtures("children_here")  # but for `rtk`, which is adjusted before
RTK = Noise(fix_m=(0.02, 0.02, 0.03), pixel_px=0.5)
SCENE = make_scene(images=24, points=200)
# A camera whose images said nothing would be as wrong as its fix: 2, 2 and 3 cm. What images do say is worth about
# as much here, 0.5 px being 5 cm on the ground and a turn trading against a shift.
FIX_M = float(np.linalg.norm(RTK.fix_m))
EXPECTED_M = 0.85 * FIX_M


def disturbed(model: SparseModel, rng: np.random.Generator) -> SparseModel:
    """The model with its cameras and points moved by 0.3 m, and its cameras turned by 0.3°."""
    scale = SCENE.geo_from_local.scale
    turn = exp_so3(np.radians(0.3) * rng.normal(size=(len(model.image_name), 3)))
    rotation = turn @ model.rotation_cam_from_local
    center = model.cam_center_in_local + 0.3 / scale * rng.normal(size=model.cam_center_in_local.shape)
    return replace(
        model,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=model.point_in_local + 0.3 / scale * rng.normal(size=model.point_in_local.shape),
    )


def adjusted(root: Path, noise: Noise, seed: int = 0, scene: TrueScene = SCENE) -> tuple[Workspace, Outcome]:
    """A workspace whose disturbed model was adjusted."""
    rng = np.random.default_rng(seed)
    survey = survey_of(scene, noise, Measured(attitudes=False), rng)
    workspace = write_workspace(root, survey, disturbed(sparse_model(scene, noise, rng), rng))
    return workspace, run_stage(workspace, ADJUST, {})


def error_m(workspace: Workspace) -> float:
    """RMS distance of the adjusted camera centres from the truth, without any further alignment."""
    center = read_sparse(workspace.path("adjust/sparse")).cam_center_in_local
    return float(np.sqrt(((center - SCENE.center_in_geo) ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def rtk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, Outcome]:
    """Adjusted to RTK fixes."""
    return adjusted(tmp_path_factory.mktemp("rtk"), RTK)


def test_cameras_come_to_their_true_places(rtk: tuple[Workspace, Outcome]) -> None:
    assert error_m(rtk[0]) < EXPECTED_M  # from 0.5 m of disturbance, in another frame


def test_wrong_fixes_do_not_drag_it(rtk: tuple[Workspace, Outcome], tmp_path: Path) -> None:
    workspace, _ = adjusted(tmp_path, replace(RTK, outliers=(2, 9, 17), outlier_m=15.0))
    # Cauchy's kernel leaves a fix of r = 15 m the weight of one that is c² σ²/r off, 0.2 mm. But three good fixes
    # less hold the model.
    assert error_m(workspace) < EXPECTED_M + 0.003
    found = load_json(Solution, workspace.path("adjust/adjustment.json"))
    assert found.gnss_outliers == tuple(SCENE.names[index] for index in (2, 9, 17))


def test_its_similarity_is_the_identity(rtk: tuple[Workspace, Outcome]) -> None:
    found = load_json(Solution, rtk[0].path("adjust/adjustment.json")).initial
    identity = Similarity.from_record(found.geo_from_local)
    np.testing.assert_array_equal(identity.matrix(), np.eye(4))
    assert found.method == "adjusted"
    assert found.correspondences == {"gnss": 24, "gcp": 0, "points": 0}
    sigma = np.sqrt(np.diag(np.array(found.geo_from_local.covariance)))
    np.testing.assert_allclose(sigma[4:], np.array(RTK.fix_m) / np.sqrt(24), rtol=0.3)


def test_fixes_and_images_are_met_as_their_noise_allows(rtk: tuple[Workspace, Outcome]) -> None:
    stats = rtk[1].manifest.values["residuals"]
    assert stats["count"] == 24
    assert 0.3 * FIX_M < stats["rmse_3d_m"] < FIX_M  # the cameras give way to their own fixes, which is the method
    # The mean of √(x² + y²) for σ = 0.5 px is 0.63 px; the fit takes a little.
    assert rtk[1].manifest.values["reprojection_error_px"] == pytest.approx(0.61, abs=0.03)


def test_images_without_a_fix_follow(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    survey = without_fixes(survey_of(SCENE, RTK, Measured(attitudes=False), rng), SCENE.names[::4])
    workspace = write_workspace(tmp_path, survey, disturbed(sparse_model(SCENE, RTK, rng), rng))
    outcome = run_stage(workspace, ADJUST, {})
    assert outcome.manifest.values["residuals"]["count"] == 18
    assert error_m(workspace) < EXPECTED_M


def test_fixes_on_a_line_are_refused(tmp_path: Path) -> None:
    scene, rng = make_scene("line", images=8, points=100), np.random.default_rng(0)
    survey = survey_of(scene, RTK, Measured(), rng)
    workspace = write_workspace(tmp_path, survey, sparse_model(scene, RTK, rng))
    with refused("positions-on-a-line", DegenerateGeometryError):
        run_stage(workspace, ADJUST, {})
