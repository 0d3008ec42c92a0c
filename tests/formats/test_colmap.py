"""COLMAP models: round trip, agreement with pycolmap, and bad files."""

from __future__ import annotations

import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.colmap import read_sparse, write_sparse
from pipelines.geometry.sparse_model import SparseModel
from tests.refusals import refused
from tests.scenes import Noise, make_scene, sparse_model

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture
def model() -> SparseModel:
    return sparse_model(make_scene(images=6, points=60), Noise(), np.random.default_rng(0))


def test_written_model_is_read_again(model: SparseModel, tmp_path: Path) -> None:
    model = replace(model, image_id=model.image_id * 7, point_id=model.point_id * 3)
    model.point_error_px[3] = np.nan
    write_sparse(model, tmp_path / "sparse")
    again = read_sparse(tmp_path / "sparse")
    for name in (field.name for field in fields(SparseModel)):
        if name in ("cameras", "image_name", "travel_in_cam"):
            continue
        np.testing.assert_allclose(getattr(again, name), getattr(model, name), atol=1e-12, err_msg=name)
    assert again.image_name == model.image_name
    assert again.cameras[1].model == "OPENCV"
    np.testing.assert_array_equal(again.cameras[1].params, model.cameras[1].params)


def test_text_model_from_pycolmap_gives_its_tracks_and_centres(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_points3D = 2, 40
    oracle = pycolmap.synthesize_dataset(options)
    oracle.write_text(str(tmp_path))
    model = read_sparse(tmp_path)
    assert len(model.point_id) == 40
    for index, name in enumerate(model.image_name):
        image = oracle.find_image_with_name(name)
        np.testing.assert_allclose(model.cam_center_in_local[index], image.projection_center(), atol=1e-9)
    for index in (0, 7, 39):
        point = oracle.points3D[int(model.point_id[index])]
        seen_in = set(model.image_id[model.obs_image[model.obs_point == index]].tolist())
        assert seen_in == {element.image_id for element in point.track.elements}
        expected = sorted(
            (element.image_id, *oracle.images[element.image_id].points2D[element.point2D_idx].xy)
            for element in point.track.elements
        )
        mine = model.obs_point == index
        observations = np.column_stack([model.image_id[model.obs_image[mine]], model.obs_xy_px[mine]])
        np.testing.assert_allclose(observations, expected)


def test_unregistered_images_are_left_out(model: SparseModel, tmp_path: Path) -> None:
    write_sparse(model, tmp_path)
    reconstruction = pycolmap.Reconstruction(str(tmp_path))
    reconstruction.deregister_frame(reconstruction.images[2].frame_id)
    reconstruction.write(str(tmp_path))
    again = read_sparse(tmp_path)
    assert 2 not in again.image_id
    assert len(again.image_name) == 5
    assert again.image_index()["image_002.jpg"] == 1


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_forged_record_count_is_refused_before_reading(model: SparseModel, tmp_path: Path, name: str) -> None:
    write_sparse(model, tmp_path)
    with (tmp_path / name).open("r+b") as handle:
        handle.write(struct.pack("<Q", 2**62))
    with refused("file-cut-off", InputError) as caught:
        read_sparse(tmp_path)
    assert caught.value.path == tmp_path / name


def test_truncated_missing_and_not_finite_models_are_refused(model: SparseModel, tmp_path: Path) -> None:
    with refused("folder-missing", InputError):
        read_sparse(tmp_path / "nowhere")
    with refused("not-a-colmap-model", InputError):
        read_sparse(tmp_path)
    broken = replace(model, point_in_local=model.point_in_local.copy())
    broken.point_in_local[0] = np.nan
    write_sparse(broken, tmp_path / "nan")
    with refused("values-not-finite", InputError):
        read_sparse(tmp_path / "nan")
    write_sparse(model, tmp_path / "cut")
    with (tmp_path / "cut" / "points3D.bin").open("r+b") as handle:
        handle.truncate(1000)
    with refused("file-cut-off", InputError):
        read_sparse(tmp_path / "cut")


def text_model(model: SparseModel, folder: Path) -> Path:
    """Write a model as text."""
    write_sparse(model, folder / "binary")
    (folder / "text").mkdir()
    pycolmap.Reconstruction(str(folder / "binary")).write_text(str(folder / "text"))
    for name in ("rigs", "frames"):
        (folder / "text" / f"{name}.txt").unlink(missing_ok=True)
    return folder / "text"


@pytest.mark.parametrize(
    "quaternion", [(0, 0, 0, 0), (2, 0, 0, 0), (1, 1, 1, 1), (0.5, 0.5, 0.5, 0.1), (1e-6, 0, 0, 0)]
)
@pytest.mark.parametrize("image", [1, 3])
def test_rotations_that_are_none(
    model: SparseModel, tmp_path: Path, quaternion: tuple[float, ...], image: int
) -> None:
    folder = text_model(model, tmp_path)
    lines = (folder / "images.txt").read_text().splitlines(keepends=True)
    at = next(k for k, line in enumerate(lines) if line.startswith(f"{image} "))
    cells = lines[at].split()
    lines[at] = " ".join([cells[0], *map(str, quaternion), *cells[5:]]) + "\n"
    (folder / "images.txt").write_text("".join(lines))
    with refused("quaternion-norm", InputError) as caught:
        read_sparse(folder)
    assert (caught.value.path, caught.value.line) == (folder / "images.txt", at + 1)
    assert cells[9] in caught.value.message
    binary = tmp_path / "binary"
    data = bytearray((binary / "images.bin").read_bytes())
    struct.pack_into("<4d", data, 8 + 4, *quaternion)  # of the first record
    (binary / "images.bin").write_bytes(data)
    with refused("file-damaged", InputError) as caught:
        read_sparse(binary)
    assert caught.value.path == binary / "images.bin" and "Record 1 of 6" in caught.value.message


def test_quaternions_of_few_digits_are_rotations(model: SparseModel, tmp_path: Path) -> None:
    folder = text_model(model, tmp_path)
    lines = (folder / "images.txt").read_text().splitlines()
    for k, line in enumerate(lines):
        cells = line.split()
        if len(cells) == 10 and not line.startswith("#"):
            lines[k] = " ".join([cells[0], *(f"{float(cell):.2f}" for cell in cells[1:5]), *cells[5:]])
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    again = read_sparse(folder)
    apart = again.rotation_cam_from_local - model.rotation_cam_from_local
    assert np.abs(apart).max() < 0.03  # twice the half digit that was lost, over the cells


@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("PINHOLE", (0, 300, 160, 120)),
        ("PINHOLE", (300, 0, 160, 120)),
        ("SIMPLE_PINHOLE", (-300, 160, 120)),
        ("OPENCV", (8.8, 8.8, 160, 120, 0, 0, 0, 0)),  # millimetres
        ("SIMPLE_RADIAL", (0.9, 160, 120, 0.01)),  # widths of the picture
        ("RADIAL", (1e9, 160, 120, 0, 0)),
    ],
)
def test_focal_lengths_that_no_lens_has(
    model: SparseModel, tmp_path: Path, name: str, params: tuple[float, ...]
) -> None:
    folder = text_model(model, tmp_path)
    (folder / "cameras.txt").write_text(f"1 {name} 320 240 {' '.join(map(str, params))}\n")
    with refused("focal-length-impossible", InputError) as caught:
        read_sparse(folder)
    assert (caught.value.path, caught.value.field) == (folder / "cameras.txt", "camera 1")
