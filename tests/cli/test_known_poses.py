"""Known poses that give no points, as a user sees it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.colmap import load_reconstruction, write_sparse
from pipelines.geometry.cameras import Camera
from tests.cli_runs import Georef
from tests.photos import write_flight
from tests.scenes import Noise, make_scene, sparse_model

pytest.importorskip("pycolmap")


@pytest.mark.slow
def test_photographs_without_common_texture_are_told_from_wrong_poses(real_georef: Georef, tmp_path: Path) -> None:
    """Known poses of pictures of noise: no point can be had, and it is not for the poses."""
    names = write_flight(tmp_path / "photos", 6)
    scene = make_scene("grid", images=6)
    camera = Camera("SIMPLE_PINHOLE", 64, 48, np.array([54.0, 32.0, 24.0]))
    model = sparse_model(replace(scene, camera=camera), Noise(), np.random.default_rng(0))
    write_sparse(replace(model, image_name=tuple(names)), tmp_path / "poses")
    blind = load_reconstruction(tmp_path / "poses")
    blind.delete_all_points2D_and_points3D()
    blind.write_binary(str(tmp_path / "poses"))
    words = ("--import", tmp_path / "poses", "--triangulate", "--to", "sfm")
    found = real_georef("run", tmp_path / "ws", "--images", tmp_path / "photos", *words)
    found.assert_failed(1, "no-matches")
