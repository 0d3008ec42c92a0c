"""COLMAP sparse models, binary or text, as flat numpy arrays, read and written.

COLMAP trusts the counts in its binary files: a forged track length of 2³⁶ is read for ever, past the end of the
file. Before COLMAP reads a model, every count is held against the file. Layouts after `reconstruction_io_binary.cc`
and `reconstruction_io_text.cc` of COLMAP 4.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError, StorageError
from pipelines.core.files import file_size, storage_failure_of
from pipelines.core.products import ImageName, Product, load_json
from pipelines.core.types import FloatArray, IntArray, Vector3
from pipelines.core.validators import stays_inside
from pipelines.formats.colmap_checks import (
    check_images_text,
    check_lenses,
    check_quaternions_text,
    quaternion_fault,
)
from pipelines.geometry.cameras import Camera, ColmapCamera, ColmapImage, Reconstruction, pycolmap_module
from pipelines.geometry.sparse_model import SparseModel

ROLLING_SHUTTER = "rolling_shutter.json"
FILES = ("rigs", "cameras", "frames", "images", "points3D")
_REQUIRED = ("cameras", "images", "points3D")
_OBSERVATION_BYTES, _TRACK_BYTES, _FRAME_DATA_BYTES = 24, 8, 16
_LONGEST_NAME = 4096
# Parameters of COLMAP's camera models by number of the model, from SIMPLE_PINHOLE on.
_CAMERA_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
_INVALID_CAMERA = "has a camera model that is unknown"
_INVALID_NAME = "has a name that is not UTF-8"
# COLMAP logs a line for each step; only its errors are of use here.
_COLMAP_ERRORS_ONLY = 2


class RollingShutter(Product):
    """Motion of cameras from the readout of the first row to that of the last, beside a model: a file of our own.

    The observations of such a model lie where a global shutter would have shown them.

    Attributes:
        travel_in_cam: by name of the image, in the axes of the camera and units of the model.
    """

    format_version: Literal[1] = 1
    travel_in_cam: dict[ImageName, Vector3]


class _CutOffError(ValueError):
    """A record that reaches beyond the end of its file."""


def _check_model_files(folder: Path) -> None:
    """Refuse a COLMAP model, binary or text, whose files do not hold what they state."""
    if not folder.is_dir():
        message = "The folder does not exist."
        remedy = "Give that of a COLMAP model (cameras, images, points3D)."
        raise InputError("folder-missing", message, path=folder, remedy=remedy)
    suffix = next((s for s in (".bin", ".txt") if all((folder / (n + s)).exists() for n in _REQUIRED)), None)
    if suffix is None:
        message = "The folder has no COLMAP model: cameras, images and points3D, all .bin or all .txt, are needed."
        raise InputError("not-a-colmap-model", message, path=folder)
    for name in FILES:
        file = folder / (name + suffix)
        if not file.exists():
            continue
        size = file_size(file)
        if suffix == ".bin":
            _check_binary(file, size, _RECORDS[name])
            continue
        if name == "images":
            check_images_text(file)
            check_quaternions_text(file)


def _check_binary(file: Path, size: int, record_end: Callable[[_Bytes, int], int]) -> None:
    cut_off, remedy = "The file is shorter than its number of records requires.", "Copy it again."
    if size < 8:
        raise InputError("file-cut-off", cut_off, path=file, remedy=remedy)
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        record = _Bytes(data, size)
        (count,) = struct.unpack_from("<Q", data)
        if count > size:
            raise InputError("file-cut-off", cut_off, path=file, remedy=remedy)
        at = 8
        for number in range(count):
            try:
                at = record_end(record, at)
            except _CutOffError as error:
                message = f"{cut_off} (record {number + 1} of {count})."
                raise InputError("file-cut-off", message, path=file) from error
            except ValueError as error:
                message = f"Record {number + 1} of {count} is damaged: it {error}"
                raise InputError("file-damaged", message, path=file) from error
        if at != size:
            message = f"The file is damaged: {size - at} bytes follow its {count} records."
            raise InputError("file-damaged", message, path=file)


@dataclass(frozen=True)
class _Bytes:
    """Content of a file, read within its size."""

    data: mmap.mmap
    size: int

    def unsigned(self, at: int, width: int) -> int:
        self.end(at + width)
        return int.from_bytes(self.data[at : at + width], "little")

    def end(self, at: int) -> int:
        """Return the end of a record, which lies inside the file."""
        if at > self.size:
            raise _CutOffError
        return at


def _camera(record: _Bytes, at: int) -> int:
    model = record.unsigned(at + 4, 4)
    if model >= len(_CAMERA_PARAMS):
        raise ValueError(_INVALID_CAMERA)
    return record.end(at + 24 + 8 * _CAMERA_PARAMS[model])


def _image(record: _Bytes, at: int) -> int:
    _require_rotation(record, at + 4)
    name_at = at + 64
    name_end = record.data.find(b"\0", name_at, min(record.size, name_at + _LONGEST_NAME))
    if name_end < 0:
        raise _CutOffError
    try:
        record.data[name_at:name_end].decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(_INVALID_NAME) from error
    return record.end(name_end + 9 + _OBSERVATION_BYTES * record.unsigned(name_end + 1, 8))


def _rig(record: _Bytes, at: int) -> int:
    sensors = record.unsigned(at + 4, 4)
    at = record.end(at + 8 + (8 if sensors else 0))
    if sensors > record.size:
        raise _CutOffError
    for _ in range(sensors - 1):
        at = record.end(at + 9 + (56 if record.unsigned(at + 8, 1) else 0))
    return at


def _frame(record: _Bytes, at: int) -> int:
    _require_rotation(record, at + 8)
    return record.end(at + 68 + _FRAME_DATA_BYTES * record.unsigned(at + 64, 4))


def _require_rotation(record: _Bytes, at: int) -> None:
    record.end(at + 32)
    fault = quaternion_fault(struct.unpack_from("<4d", record.data, at))
    if fault is not None:
        raise ValueError(fault)


# The end of a record that begins at a place, by file.
_RECORDS: dict[str, Callable[[_Bytes, int], int]] = {
    "rigs": _rig,
    "cameras": _camera,
    "frames": _frame,
    "images": _image,
    "points3D": lambda record, at: record.end(at + 51 + _TRACK_BYTES * record.unsigned(at + 43, 8)),
}


def read_sparse(path: Path) -> SparseModel:
    r"""Read the COLMAP model (cameras, images, points3D as .bin or .txt) in a folder.

    Images without a pose and observations without a point are left out. The motion of the cameras comes from the
    file beside the model, if there is one.

    Raises:
        InputError: unreadable, inconsistent, or with values that are not finite.

    Examples:
        >>> _ = Path("cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
        >>> _ = Path("images.txt").write_text("1 1 0 0 0 -2 -3 5 1 a.jpg\n\n")
        >>> Path("points3D.txt").touch()
        >>> model = read_sparse(Path())
        >>> model.image_name, model.cam_center_in_local.tolist(), model.focal_px.tolist()
        (('a.jpg',), [[2.0, 3.0, -5.0]], [350.0])
    """
    model = flatten(load_reconstruction(path))
    if (path / ROLLING_SHUTTER).exists():
        travel = load_json(RollingShutter, path / ROLLING_SHUTTER).travel_in_cam
        moved = np.array([travel.get(name, (0.0, 0.0, 0.0)) for name in model.image_name])
        model = replace(model, travel_in_cam=moved)
    _check(model, path)
    return model


def lens_of_colmap(camera: ColmapCamera) -> Camera:
    """Return a `pycolmap.Camera` as a lens."""
    return Camera(camera.model_name, int(camera.width), int(camera.height), np.array(camera.params, np.float64))


def flatten(reconstruction: Reconstruction) -> SparseModel:
    """Return a `pycolmap.Reconstruction` as arrays; images without a pose and stray observations are left out."""
    cameras = {int(camera_id): lens_of_colmap(camera) for camera_id, camera in reconstruction.cameras.items()}
    images = [reconstruction.images[image_id] for image_id in sorted(reconstruction.reg_image_ids())]
    poses = [image.cam_from_world().matrix() for image in images]
    pose = np.array(poses, dtype=np.float64).reshape(-1, 3, 4)
    ids = np.array(sorted(reconstruction.point3D_ids()), dtype=np.int64)
    points = [reconstruction.points3D[int(point_id)] for point_id in ids]
    obs_point, obs_image, obs_xy = _observations(images, ids)
    return SparseModel(
        cameras=cameras,
        image_id=np.array([image.image_id for image in images], dtype=np.int64),
        image_name=tuple(image.name for image in images),
        image_camera_id=np.array([image.camera_id for image in images], dtype=np.int64),
        rotation_cam_from_local=np.ascontiguousarray(pose[:, :, :3]),
        translation_cam_from_local=np.ascontiguousarray(pose[:, :, 3]),
        point_id=ids,
        point_in_local=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        point_rgb=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        point_error_px=np.array([point.error if point.has_error() else np.nan for point in points]),
        obs_point=obs_point,
        obs_image=obs_image,
        obs_xy_px=obs_xy,
    )


@contextmanager
def quiet_colmap() -> Iterator[Any]:
    """Yield pycolmap, with its log reduced to errors while in use."""
    pycolmap = pycolmap_module()
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _COLMAP_ERRORS_ONLY
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = level


def write_reconstruction(reconstruction: Reconstruction, folder: Path) -> None:
    """Write a `pycolmap.Reconstruction` in COLMAP's binary form into a folder, made if missing, and read it back.

    COLMAP does not notice that a disk is full while it writes.

    Raises:
        StorageError: the files are shorter than what was written.
        OSError: the folder cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(str(folder))
    counts = []
    try:
        for model in (reconstruction, _loaded(folder)):
            counts.append((model.num_images(), model.num_points3D(), model.compute_num_observations()))
        whole = counts[0] == counts[1]
    except InputError:
        whole = False
    if not whole:
        message = f"{folder}: the model could not be written whole."
        raise storage_failure_of(folder) or StorageError("model-not-written", message)


def load_reconstruction(path: Path) -> Any:
    r"""Return the COLMAP model in a folder as a `pycolmap.Reconstruction`.

    Raises:
        InputError: no such folder, not a readable model, one whose counts do not fit its files, or poses or lenses
            that are nonsense.

    Examples:
        >>> _ = Path("cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
        >>> _ = Path("images.txt").write_text("1 1 0 0 0 -2 -3 5 1 a.jpg\n\n")
        >>> Path("points3D.txt").touch()
        >>> load_reconstruction(Path()).images[1].projection_center().tolist()  # −Rᵀ t
        [2.0, 3.0, -5.0]
    """
    model = _loaded(path)
    files = (path / f"cameras{suffix}" for suffix in (".bin", ".txt"))
    check_lenses(model, next(file for file in files if file.exists()))
    return model


def _loaded(path: Path) -> Any:
    pycolmap = pycolmap_module()
    _check_model_files(path)
    try:
        return pycolmap.Reconstruction(str(path))
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        raise InputError("model-unreadable", f"COLMAP cannot read the model: {error}", path=path) from error


def _observations(images: list[ColmapImage], point_ids: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return flat arrays over all observations that belong to a point, sorted by point."""
    pycolmap = pycolmap_module()
    # A pinhole of unit focal length at the origin turns a list of pixels into an array in one call.
    unit = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1.0, 0.0, 0.0])
    xy: list[FloatArray] = [np.empty((0, 2))]
    owner: list[NDArray[np.uint64]] = [np.empty(0, dtype=np.uint64)]
    source: list[IntArray] = [np.empty(0, dtype=np.int64)]
    for index, image in enumerate(images):
        points = image.get_observation_points2D()  # most keypoints observe none: Python would visit each of them
        ids = np.fromiter((point.point3D_id for point in points), dtype=np.uint64, count=len(points))
        xy.append(np.asarray(unit.cam_from_img(points)).reshape(-1, 2))
        owner.append(ids)
        source.append(np.full(len(ids), index, dtype=np.int64))
    obs_image, obs_owner = np.concatenate(source), np.concatenate(owner).astype(np.int64)
    obs_point = np.searchsorted(point_ids, obs_owner).astype(np.int64)
    order = np.lexsort((obs_image, obs_point))
    return obs_point[order], obs_image[order], np.concatenate(xy)[order]


def _check(model: SparseModel, path: Path) -> None:
    names = ("rotation_cam_from_local", "translation_cam_from_local", "point_in_local", "obs_xy_px")
    values = [(name, getattr(model, name)) for name in names]
    values += [("camera params", camera.params) for camera in model.cameras.values()]
    for name, numbers in values:
        if not np.isfinite(numbers).all():
            message = "The model contains values that are not finite: reconstruct again."
            raise InputError("values-not-finite", message, path=path, field=name)
    if len(set(model.image_name)) != len(model.image_name):
        raise InputError("image-twice", "Two images have the same name.", path=path, field="images")
    astray = next((name for name in model.image_name if not stays_inside(name)), None)
    if astray is not None:
        message = f"The image name {astray!r} leaves the folder of photographs: names are relative to it."
        raise InputError("image-outside-folder", message, path=path, field="images")


def write_sparse(model: SparseModel, path: Path) -> None:
    """Write a model in COLMAP's binary form; `read_sparse` returns the same model, and COLMAP opens it.

    Every image gets its own frame and every camera a trivial rig. Raises as `write_reconstruction`.
    """
    write_reconstruction(reconstruction_of(model), path)


def reconstruction_of(model: SparseModel) -> Any:
    """Return a model as a `pycolmap.Reconstruction`, in which every image has its own frame."""
    pycolmap = pycolmap_module()
    reconstruction = pycolmap.Reconstruction()
    for camera_id, camera in model.cameras.items():
        size = {"width": camera.width, "height": camera.height}
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera_id, model=camera.model, params=camera.params, **size)
        )
    by_image = np.argsort(model.obs_image, kind="stable")
    bounds = np.searchsorted(model.obs_image[by_image], np.arange(len(model.image_name) + 1))
    rank = np.empty(len(by_image), dtype=np.int64)  # place of each observation in its image's list
    rank[by_image] = np.arange(len(by_image)) - bounds[model.obs_image[by_image]]
    for index, name in enumerate(model.image_name):
        pixels = model.obs_xy_px[by_image[bounds[index] : bounds[index + 1]]]
        image = pycolmap.Image(name, pixels, camera_id=int(model.image_camera_id[index]))
        image.image_id = int(model.image_id[index])
        rotation = pycolmap.Rotation3d(model.rotation_cam_from_local[index])
        pose = pycolmap.Rigid3d(rotation, model.translation_cam_from_local[index])
        reconstruction.add_image_with_trivial_frame(image, pose)
    starts = np.searchsorted(model.obs_point, np.arange(len(model.point_id) + 1))
    observer = model.image_id[model.obs_image]
    for index, point_id in enumerate(model.point_id):
        run = slice(starts[index], starts[index + 1])
        point = pycolmap.Point3D(xyz=model.point_in_local[index], color=model.point_rgb[index])
        if np.isfinite(model.point_error_px[index]):
            point.error = model.point_error_px[index]
        point.track.elements = [
            pycolmap.TrackElement(int(image_id), int(slot))
            for image_id, slot in zip(observer[run], rank[run], strict=True)
        ]
        reconstruction.add_point3D_with_id(int(point_id), point)
    return reconstruction
