"""Flat numpy arrays as COLMAP sparse models, written as COLMAP writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.types import IntArray
from pipelines.formats.colmap import pycolmap_module, write_reconstruction
from pipelines.geometry.sparse_model import SparseModel


def write_sparse(model: SparseModel, path: Path) -> None:
    """Write a model in COLMAP's binary form; `read_sparse` returns the same model, and COLMAP opens it.

    Every image gets its own frame and every camera a trivial rig. The folder is made if missing.

    Raises:
        BackendUnavailableError: pycolmap is not installed.
        StorageError: the disk is full.
        OSError: the folder cannot be made.
    """
    pycolmap = pycolmap_module()
    reconstruction = pycolmap.Reconstruction()
    for camera_id, camera in model.cameras.items():
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=camera_id,
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=camera.params,
            )
        )
    rank = _add_images(reconstruction, model)
    _add_points(reconstruction, model, rank)
    write_reconstruction(reconstruction, path)


def _add_images(reconstruction: Any, model: SparseModel) -> IntArray:
    """Add the images with their pixels; return the place of each observation in its image's list."""
    pycolmap = pycolmap_module()
    by_image = np.argsort(model.obs_image, kind="stable")
    bounds = np.searchsorted(model.obs_image[by_image], np.arange(len(model.image_name) + 1))
    rank = np.empty(len(by_image), dtype=np.int64)
    rank[by_image] = np.arange(len(by_image)) - bounds[model.obs_image[by_image]]
    for index, name in enumerate(model.image_name):
        pixels = model.obs_xy_px[by_image[bounds[index] : bounds[index + 1]]]
        image = pycolmap.Image(name, pixels, camera_id=int(model.image_camera_id[index]))
        image.image_id = int(model.image_id[index])
        rotation = pycolmap.Rotation3d(model.rotation_cam_from_local[index])
        pose = pycolmap.Rigid3d(rotation, model.translation_cam_from_local[index])
        reconstruction.add_image_with_trivial_frame(image, pose)
    return rank


def _add_points(reconstruction: Any, model: SparseModel, rank: IntArray) -> None:
    pycolmap = pycolmap_module()
    starts = np.searchsorted(model.obs_point, np.arange(len(model.point_id) + 1))
    observer = model.image_id[model.obs_image]
    for index, point_id in enumerate(model.point_id):
        run = slice(starts[index], starts[index + 1])
        point = pycolmap.Point3D(xyz=model.point_in_local[index], color=model.point_rgb[index])
        if np.isfinite(model.point_error_px[index]):
            point.error = model.point_error_px[index]
        point.track.elements = [
            pycolmap.TrackElement(int(image_id), int(place))
            for image_id, place in zip(observer[run], rank[run], strict=True)
        ]
        reconstruction.add_point3D_with_id(int(point_id), point)
