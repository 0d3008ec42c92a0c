"""Imported models: forged counts, folders above the model, and models of other images than the photographs."""

from __future__ import annotations

import logging
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.colmap import load_reconstruction, write_sparse
from pipelines.geometry.cameras import Camera
from pipelines.geometry.sparse_model import SparseModel
from pipelines.sfm.imported_model import find_model, import_model
from pipelines.survey.survey import Survey
from tests.refusals import refused
from tests.scenes import Measured, Noise, make_scene, sparse_model, survey_of

pytest.importorskip("pycolmap")

# Where a count stands in the first record of each binary file that `write_sparse` writes, and its struct format.
COUNTS = {
    "images.bin": (8 + 64 + len("image_000.jpg") + 1, "<Q"),
    "points3D.bin": (8 + 43, "<Q"),
    "frames.bin": (8 + 64, "<I"),
    "rigs.bin": (8 + 4, "<I"),
}


@pytest.fixture
def surveyed() -> tuple[SparseModel, Survey]:
    rng = np.random.default_rng(0)
    scene = make_scene(images=6, points=60)
    return sparse_model(scene, Noise(), rng), survey_of(scene, Noise(), Measured(), rng)


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("count", [2**31, 2**36])
def test_forged_inner_count_is_refused_before_reading(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, name: str, count: int
) -> None:
    """COLMAP would read 2³⁶ elements of a track for ever."""
    write_sparse(surveyed[0], tmp_path)
    at, form = COUNTS[name]
    data = bytearray((tmp_path / name).read_bytes())
    (honest,) = struct.unpack_from(form, data, at)
    assert 0 < honest < 100
    struct.pack_into(form, data, at, count % 2 ** (8 * struct.calcsize(form)) or 2**32 - 1)
    (tmp_path / name).write_bytes(data)
    with refused("file-cut-off", InputError) as caught:
        load_reconstruction(tmp_path)
    assert caught.value.path == tmp_path / name and "record 1 of" in caught.value.message


def test_image_name_that_is_not_utf_8_is_refused(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    write_sparse(surveyed[0], tmp_path)
    file = tmp_path / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"image_003", b"image\x85003"))
    with refused("file-damaged", InputError) as caught:
        load_reconstruction(tmp_path)
    assert caught.value.path == file and "Record 4 of 6" in caught.value.message and "UTF-8" in caught.value.message


def test_unknown_camera_model_and_bytes_behind_the_records(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    write_sparse(surveyed[0], tmp_path)
    cameras = (tmp_path / "cameras.bin").read_bytes()
    (tmp_path / "cameras.bin").write_bytes(cameras[:12] + struct.pack("<i", 99) + cameras[16:])
    with refused("file-damaged", InputError) as caught:
        load_reconstruction(tmp_path)
    assert "Record 1 of 1" in caught.value.message and "camera model" in caught.value.message
    (tmp_path / "cameras.bin").write_bytes(cameras + b"\0")
    with refused("file-damaged", InputError) as caught:
        load_reconstruction(tmp_path)
    assert "1 bytes follow its 1 records" in caught.value.message


@pytest.mark.parametrize("place", ["", "sparse/0", "sparse", "0"])
def test_model_is_found_below_a_project(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    model, survey = surveyed
    write_sparse(model, tmp_path / place)
    assert find_model(tmp_path) == tmp_path / place
    assert import_model(tmp_path, survey).num_reg_images() == 6
    assert caplog.text == ""


def test_further_models_of_a_project_are_named(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for place in ("sparse/0", "sparse/1"):
        write_sparse(surveyed[0], tmp_path / place)
    assert find_model(tmp_path) == tmp_path / "sparse/0"
    assert "1 further models lie beside it" in caplog.text


def flat(model: SparseModel, factor: int) -> SparseModel:
    """The model of undistorted copies: cameras without distortion, with other sizes."""
    camera = model.cameras[1]
    size = (camera.width * factor, camera.height * factor)
    params = np.array([camera.params[0], camera.params[0], size[0] / 2, size[1] / 2])
    return replace(model, cameras={1: Camera("PINHOLE", *size, params)})


def test_model_of_undistorted_copies_is_refused(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    model, survey = surveyed
    write_sparse(flat(model, 2), tmp_path)
    with refused("undistorted-copies", InputError) as error:
        import_model(tmp_path, survey)
    size = model.cameras[1].width, model.cameras[1].height
    assert "{}×{}".format(*size) in error.value.message
    assert f"{2 * size[0]}×{2 * size[1]}" in error.value.message


def test_model_of_smaller_copies_is_refused(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    model, survey = surveyed
    camera = model.cameras[1]
    small = Camera(camera.model, camera.width // 2, camera.height // 2, camera.params)
    write_sparse(replace(model, cameras={1: small}), tmp_path)
    with refused("photograph-size", InputError):
        import_model(tmp_path, survey)


def test_pinhole_of_the_right_size_is_taken_with_a_warning(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model, survey = surveyed
    write_sparse(flat(model, 1), tmp_path)
    with caplog.at_level(logging.WARNING):
        assert import_model(tmp_path, survey).num_reg_images() == 6
    assert "no lens distortion (camera 1)" in caplog.text
