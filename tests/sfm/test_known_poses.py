"""Models of poses alone, as of Unity, Blender or a vehicle: points are triangulated from the photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.stages import SPARSE
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.colmap import load_reconstruction, read_sparse, write_sparse
from pipelines.geometry.sparse_model import SparseModel
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.stage import run
from tests import foreign_files as write
from tests.refusals import refused
from tests.sfm_scenes import CONFIG

pytest.importorskip("pycolmap")
pytestmark = pytest.mark.usefixtures("children_here")


def poses_alone(model: SparseModel, folder: Path) -> Path:
    """Write the poses and lenses of a model, under names of another machine, without points."""
    names = tuple(f"/home/u/flight/{name.upper()}" for name in model.image_name)
    write_sparse(replace(model, image_name=names), folder)
    blind = load_reconstruction(folder)
    blind.delete_all_points2D_and_points3D()
    blind.write_binary(str(folder))
    return folder


def options_of(folder: Path) -> SfmOptions:
    return CONFIG.model_copy(update={"import_model": folder, "triangulate": True})


def test_points_are_triangulated_and_poses_stay(mapped: Workspace, tmp_path: Path) -> None:
    given = read_sparse(mapped.path(SPARSE))
    (out := tmp_path / "sfm.partial").mkdir()
    summary = run(StageRun(mapped, out), options_of(poses_alone(given, tmp_path / "poses")))
    taken = read_sparse(out / "sparse")
    assert sorted(taken.image_name) == sorted(given.image_name)
    rows = [taken.image_name.index(name) for name in given.image_name]
    np.testing.assert_allclose(taken.cam_center_in_local[rows], given.cam_center_in_local, atol=1e-9)
    np.testing.assert_allclose(taken.rotation_cam_from_local[rows], given.rotation_cam_from_local, atol=1e-9)
    # The poses are those of an adjustment of such matches: half as many points at least, errors below 2 px.
    assert summary.values["points"] > 0.5 * len(given.point_id)
    assert 0.0 < summary.values["reprojection_error_px"] < 2.0


@pytest.mark.slow
def test_cameras_of_a_file_without_points_are_triangulated_unasked(mapped: Workspace, tmp_path: Path) -> None:
    given = read_sparse(mapped.path(SPARSE))
    (out := tmp_path / "sfm.partial").mkdir()
    path = write.metashape(given, tmp_path / "cameras.xml")
    summary = run(StageRun(mapped, out), CONFIG.model_copy(update={"import_model": path}))
    taken = read_sparse(out / "sparse")
    rows = [taken.image_name.index(name) for name in given.image_name]
    np.testing.assert_allclose(taken.cam_center_in_local[rows], given.cam_center_in_local, atol=1e-6)
    np.testing.assert_allclose(taken.rotation_cam_from_local[rows], given.rotation_cam_from_local, atol=1e-6)
    assert summary.values["points"] > 0.5 * len(given.point_id)
    assert 0.0 < summary.values["reprojection_error_px"] < 2.0


@pytest.mark.parametrize("kind", ["opengl-axes", "camera-to-world"])
def test_poses_of_another_convention_contradict_the_matches(mapped: Workspace, tmp_path: Path, kind: str) -> None:
    given = read_sparse(mapped.path(SPARSE))
    rotation, translation = given.rotation_cam_from_local, given.translation_cam_from_local
    flip = np.array([1.0, -1.0, -1.0])
    if kind == "opengl-axes":
        written = replace(
            given, rotation_cam_from_local=rotation * flip[:, None], translation_cam_from_local=translation * flip
        )
    else:
        centre = -np.einsum("nji,nj->ni", rotation, translation)
        written = replace(
            given, rotation_cam_from_local=np.swapaxes(rotation, 1, 2), translation_cam_from_local=centre
        )
    (out := tmp_path / "sfm.partial").mkdir()
    with refused(f"model-{kind}", InputError):
        run(StageRun(mapped, out), options_of(poses_alone(written, tmp_path / "poses")))


def test_triangulate_needs_poses() -> None:
    with pytest.raises(ValueError, match="--import"):
        SfmOptions(triangulate=True)
