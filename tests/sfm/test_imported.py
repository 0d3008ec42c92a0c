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
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
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
    """COLMAP numbers its models as it finds them: the one with most images is taken, wherever it stands."""
    model = surveyed[0]
    for place, images in (("0", 3), ("1", 6), ("2", 4)):
        write_sparse(model.of_images(np.arange(images)), tmp_path / "sparse" / place)
    assert find_model(tmp_path) == tmp_path / "sparse/1"
    assert "0: 3, 1: 6, 2: 4" in caplog.text
    assert find_model(tmp_path / "sparse/0") == tmp_path / "sparse/0"  # asked for by name


def test_largest_model_without_number_zero_is_found_in_text(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    for place, images in (("3", 4), ("12", 6)):
        write_sparse(surveyed[0].of_images(np.arange(images)), tmp_path / "binary")
        (folder := tmp_path / "sparse" / place).mkdir(parents=True)
        load_reconstruction(tmp_path / "binary").write_text(str(folder))
    assert find_model(tmp_path) == tmp_path / "sparse/12"


def test_names_match_as_in_tables(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Folder, case, suffix, Windows' separators and folders of another machine."""
    model, survey = surveyed
    names = [
        "images/Image_000.JPG",
        "IMAGE_001.jpg",
        "image_002.png",
        "a\\b\\image_003.jpg",
        "/home/u/image_004.jpg",
    ]
    write_sparse(replace(model, image_name=(*names, "C:\\flight\\image_005.JPG")), tmp_path)
    taken = import_model(tmp_path, survey)
    assert {image.name for image in taken.images.values()} == {image.name for image in survey.images}
    assert "6 images of the model have another folder, case or suffix" in caplog.text


def test_names_of_other_photographs_are_shown_beside_ours(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    model, survey = surveyed
    write_sparse(replace(model, image_name=tuple(f"frame_{k:05d}.png" for k in range(6))), tmp_path)
    with refused("too-few-images-in-survey", InputError) as error:
        import_model(tmp_path, survey)
    assert "frame_00000.png" in error.value.message and "image_000.jpg" in error.value.message


def test_two_images_of_a_model_for_one_photograph_are_refused(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    model, survey = surveyed
    twice = ("a/image_000.jpg", "b/image_000.jpg", *model.image_name[2:])
    write_sparse(replace(model, image_name=twice), tmp_path)
    with refused("image-twice", InputError):
        import_model(tmp_path, survey)


def as_written(model: SparseModel, kind: str) -> SparseModel:
    """Return a model whose poses another program has written."""
    rotation, translation = model.rotation_cam_from_local, model.translation_cam_from_local
    flip = np.array([1.0, -1.0, -1.0])
    if "opengl" in kind:
        rotation, translation = rotation * flip[:, None], translation * flip
    if "camera-to-world" in kind or "camera-centre" in kind:
        centre = -np.einsum("nji,nj->ni", rotation, translation)
        rotation = np.swapaxes(rotation, 1, 2) if "camera-to-world" in kind else rotation
        translation = centre
    if "real-part-last" in kind:  # x, y, z, w is read as w, x, y, z
        rotation = matrix_from_quat_xyzw(np.roll(quat_xyzw_from_matrix(rotation), -1, axis=1))
    return replace(model, rotation_cam_from_local=rotation, translation_cam_from_local=translation)


@pytest.mark.parametrize(
    "kind",
    ["opengl-axes", "camera-to-world", "camera-to-world-opengl-axes", "camera-centre", "real-part-last"],
)
def test_poses_of_other_conventions_are_named(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, kind: str
) -> None:
    model, survey = surveyed
    write_sparse(replace(as_written(model, kind), point_error_px=np.full(len(model.point_id), 0.3)), tmp_path)
    with refused(f"model-{kind}", InputError):
        import_model(tmp_path, survey)


def test_model_of_a_left_handed_world_fits_no_convention(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    model, survey = surveyed
    mirrored = replace(model, point_in_local=model.point_in_local * np.array([1.0, 1.0, -1.0]))
    write_sparse(mirrored, tmp_path)
    with refused("model-against-observations", InputError):
        import_model(tmp_path, survey)


def test_reprojection_error_is_computed_and_not_passed_on(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    """Noise of the scene is 0.5 px and more an axis; the file claims 0.01 px."""
    model, survey = surveyed
    write_sparse(replace(model, point_error_px=np.full(len(model.point_id), 0.01)), tmp_path)
    assert 0.2 < import_model(tmp_path, survey).compute_mean_reprojection_error() < 3.0


def test_poses_without_observations_are_refused_with_the_remedy(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model, survey = surveyed
    write_sparse(model, tmp_path)
    blind = load_reconstruction(tmp_path)
    blind.delete_all_points2D_and_points3D()
    blind.write_binary(str(tmp_path))
    with refused("model-without-observations", InputError) as error:
        import_model(tmp_path, survey)
    assert "6 of its 6" in error.value.message and "--triangulate" in error.value.message
    # One image among many is left out.
    seen = model.obs_image != 2
    few = replace(
        model, obs_point=model.obs_point[seen], obs_image=model.obs_image[seen], obs_xy_px=model.obs_xy_px[seen]
    )
    write_sparse(few, tmp_path / "few")
    assert import_model(tmp_path / "few", survey).num_reg_images() == 5
    assert "1 images of the model observe no points" in caplog.text and "--triangulate" in caplog.text


@pytest.mark.parametrize(
    ("drop", "line", "code"),
    [
        ("all blank lines", 6, "observations-line-missing"),
        ("one observation cell", 6, "observations-line-missing"),
        ("first observations", 6, "observations-line-missing"),
        ("name of an image", 5, "images-line"),
    ],
)
def test_lines_of_images_and_observations_stand_by_turns(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, drop: str, line: int, code: str
) -> None:
    write_sparse(surveyed[0], tmp_path / "binary")
    (folder := tmp_path / "text").mkdir()
    model = load_reconstruction(tmp_path / "binary")
    if drop == "all blank lines":
        model.delete_all_points2D_and_points3D()
    model.write_text(str(folder))
    file = folder / "images.txt"
    lines = file.read_text().split("\n")
    assert lines[3].startswith("#") and lines[4].endswith(".jpg")
    if drop == "all blank lines":
        lines = [text for text in lines if text]
    elif drop == "one observation cell":
        lines[5] = lines[5].strip().rsplit(" ", 1)[0]
    elif drop == "first observations":
        del lines[5]
    else:
        lines[4] = lines[4].rsplit(" ", 1)[0]
    file.write_text("\n".join(lines))
    with refused(code, InputError) as error:
        load_reconstruction(folder)
    assert (error.value.path, error.value.line) == (file, line)


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
