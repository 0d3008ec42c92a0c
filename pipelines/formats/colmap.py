"""COLMAP sparse models, binary or text, as flat numpy arrays."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.durable import storage_failure_of
from pipelines.core.errors import BackendUnavailableError, InputError, StorageError
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.validators import stays_inside
from pipelines.formats.colmap_check import check_model_files
from pipelines.geometry.cameras import Camera
from pipelines.geometry.sparse_model import SparseModel

log = logging.getLogger(__name__)


# COLMAP logs a line for each step; only its errors are of use here.
_COLMAP_ERRORS_ONLY = 2

_INVALID_POINT = np.uint64(2**64 - 1)


def read_sparse(path: Path) -> SparseModel:
    """Read the COLMAP model (cameras, images, points3D as .bin or .txt) in a folder.

    Images without a pose and observations without a point are left out.

    Raises:
        InputError: unreadable, inconsistent, or with values that are not finite.
        BackendUnavailableError: pycolmap is not installed.
    """
    model = flatten(load_reconstruction(path))
    _check(model, path)
    return model


def flatten(reconstruction: Any) -> SparseModel:
    """Return a `pycolmap.Reconstruction` as arrays; images without a pose and stray observations are left out."""
    cameras = {
        int(camera_id): Camera(
            camera.model_name, int(camera.width), int(camera.height), np.array(camera.params, dtype=np.float64)
        )
        for camera_id, camera in reconstruction.cameras.items()
    }
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


def pycolmap_module() -> Any:
    """Return pycolmap, imported so that the process's signals stay as they are.

    On import, pycolmap handles SIGTERM by a stack trace and the end of the process: an interrupted stage would not
    end cleanly.

    Raises:
        BackendUnavailableError: pycolmap is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise BackendUnavailableError("pycolmap is not installed: `pip install pycolmap`") from error
    if threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGTERM)  # Python's own record, which the import has not changed
        signal.signal(signal.SIGTERM, signal.SIG_DFL if handler is None else handler)
    return pycolmap


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


def write_reconstruction(reconstruction: Any, folder: Path) -> None:
    """Write a `pycolmap.Reconstruction` in COLMAP's binary form into a folder, made if missing, and read it back.

    COLMAP does not notice that a disk is full while it writes.

    Raises:
        StorageError: the files are shorter than what was written.
        OSError: the folder cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(str(folder))
    try:
        copy = load_reconstruction(folder)
        whole = _counts(copy) == _counts(reconstruction)
    except InputError:
        whole = False
    if not whole:
        failure = storage_failure_of(folder) or StorageError(f"{folder}: the model could not be written whole")
        raise failure


def _counts(reconstruction: Any) -> tuple[int, int, int]:
    return (
        reconstruction.num_images(),
        reconstruction.num_points3D(),
        reconstruction.compute_num_observations(),
    )


def load_reconstruction(path: Path) -> Any:
    """Return the COLMAP model in a folder as a `pycolmap.Reconstruction`.

    Raises:
        InputError: no such folder, not a readable model, or one whose counts do not fit its files.
        BackendUnavailableError: pycolmap is not installed.
    """
    pycolmap = pycolmap_module()
    check_model_files(path)
    try:
        return pycolmap.Reconstruction(str(path))
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        raise InputError(f"not a readable COLMAP model: {error}", path=path) from error


def _observations(images: list[Any], point_ids: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return flat arrays over all observations that belong to a point, sorted by point."""
    pycolmap = pycolmap_module()
    # A pinhole of unit focal length at the origin turns a list of pixels into an array in one call.
    unit = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1.0, 0.0, 0.0])
    xy: list[FloatArray] = [np.empty((0, 2))]
    owner: list[NDArray[np.uint64]] = [np.empty(0, dtype=np.uint64)]
    source: list[IntArray] = [np.empty(0, dtype=np.int64)]
    for index, image in enumerate(images):
        points = image.points2D
        ids = np.fromiter((point.point3D_id for point in points), dtype=np.uint64, count=len(points))
        seen = ids != _INVALID_POINT
        xy.append(np.asarray(unit.cam_from_img(points)).reshape(-1, 2)[seen])
        owner.append(ids[seen])
        source.append(np.full(int(seen.sum()), index, dtype=np.int64))
    obs_image, obs_owner = np.concatenate(source), np.concatenate(owner).astype(np.int64)
    obs_point = np.searchsorted(point_ids, obs_owner).astype(np.int64)
    order = np.lexsort((obs_image, obs_point))
    return obs_point[order], obs_image[order], np.concatenate(xy)[order]


def _check(model: SparseModel, path: Path) -> None:
    for name in ("rotation_cam_from_local", "translation_cam_from_local", "point_in_local", "obs_xy_px"):
        if not np.isfinite(getattr(model, name)).all():
            raise InputError("contains values that are not finite: reconstruct again", path=path, field=name)
    if any(not np.isfinite(camera.params).all() for camera in model.cameras.values()):
        raise InputError("contains values that are not finite: reconstruct again", path=path, field="camera params")
    if len(set(model.image_name)) != len(model.image_name):
        raise InputError("two images have the same name", path=path, field="images")
    astray = next((name for name in model.image_name if not stays_inside(name)), None)
    if astray is not None:
        message = f"{astray!r} leaves the folder of photographs: names are relative to it"
        raise InputError(message, path=path, field="images")
