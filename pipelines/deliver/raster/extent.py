"""Frame of the rasters: cells on whole multiples of their size, over the scene, checked before the work begins."""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.deliver.options import ExportRasterOptions
from pipelines.formats.geotiff import RasterFrame
from pipelines.scene.target_crs import TargetCrs
from pipelines.scene.trained_survey import TrainedSurvey

_MARGIN = 0.02  # of the extent, on each side
_LARGEST_DEG = 0.01  # about a kilometre
# Bytes of a cell on the disk at most: colours, height and two σ, as parts and as final rasters.
_BYTES_PER_CELL = 32


@dataclass(frozen=True)
class GroundSampling:
    """Ground sample distances in metres, medians over the SfM points' observations: depth over focal length.

    Attributes:
        photographs_m: of the photographs as they are.
        training_m: at the size at which the model was trained.
    """

    photographs_m: float
    training_m: float


def ground_sampling(trained: TrainedSurvey) -> GroundSampling:
    """Return the ground sample distances of a trained survey."""
    sfm, poses = trained.sfm, trained.poses
    cameras = [trained.sparse.camera_of(index) for index in range(len(sfm.image_name))]
    focal_px = np.array([camera.mean_focal_px for camera in cameras])
    longest_px = np.array([max(camera.width, camera.height) for camera in cameras])
    arm = trained.point_in_model[sfm.obs_point] - poses.cam_center_in_model[sfm.obs_image]
    depth = np.einsum("kj,kj->k", poses.cam_from_model[sfm.obs_image][:, 2], arm)
    gsd_m = trained.geo_from_model.scale * depth / focal_px[sfm.obs_image]
    reduced = np.maximum(longest_px / trained.model.max_image_size, 1.0)[sfm.obs_image]
    return GroundSampling(float(np.median(gsd_m)), float(np.median(gsd_m * reduced)))


def make_frame(
    xy: FloatArray, target: TargetCrs, default_gsd_m: float, options: ExportRasterOptions
) -> RasterFrame:
    """Return the frame of the rasters over points of the scene.

    Args:
        xy: (P, 2) points in the CRS, easting or longitude first.
        target: the CRS.
        default_gsd_m: size of a cell in metres without `--gsd`.
        options: size of a cell, and the largest number of cells.

    Raises:
        InputError: a geocentric CRS, a geographic CRS without a size in degrees, or too many cells.
    """
    crs = target.crs
    if crs.is_geocentric:
        raise InputError(f"{crs.name} has no map plane: give a projected CRS, such as EPSG:32632", field="--crs")
    if crs.is_geographic and options.gsd is None:
        raise InputError(
            f"{crs.name} has its coordinates in {crs.units[0]}s: give the size of a cell in that unit, such as "
            "--gsd 0.000001, or a projected CRS",
            field="--gsd",
        )
    if crs.is_geographic and options.gsd is not None and options.gsd > _LARGEST_DEG:
        raise InputError(
            f"{options.gsd:g} {crs.units[0]}s are more than a kilometre, and {crs.name} has no metres: give the "
            "size of a cell in its unit, such as --gsd 0.000001",
            field="--gsd",
        )
    step = _readable(default_gsd_m / crs.horizontal_unit) if options.gsd is None else options.gsd
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = _MARGIN * (high - low)
    west, south = np.floor((low - margin) / step)
    east, north = np.ceil((high + margin) / step)
    columns, rows = int(east - west), int(north - south)
    if columns * rows > options.max_pixels:
        enough = step * math.sqrt(columns * rows / options.max_pixels)
        raise InputError(
            f"cells of {step:g} {crs.units[0]} make {columns} × {rows} = {columns * rows:.3g} cells, more than "
            f"--max-pixels {options.max_pixels:.3g}: give --gsd {enough:.2g} or larger, or a larger --max-pixels",
            field="--gsd",
        )
    return RasterFrame(crs.wkt1, west * step, north * step, step, step, columns, rows)


def require_space(folder: Path, frame: RasterFrame) -> None:
    """Refuse rasters that the disk would not hold.

    Raises:
        InputError: too little space is free.
    """
    needed, free = _BYTES_PER_CELL * frame.columns * frame.rows, shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"rasters of {frame.columns} × {frame.rows} cells may need {needed / 2**30:.1f} GiB, and "
            f"{free / 2**30:.1f} GiB are free: give a larger --gsd, or make room on this disk",
            path=folder,
        )


def _readable(gsd: float) -> float:
    """Return a size rounded up to two digits, which people can copy."""
    digit = 10.0 ** (math.floor(math.log10(gsd)) - 1)
    return round(math.ceil(gsd / digit - 1e-9) * digit, 12)
