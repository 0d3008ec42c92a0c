"""Footprints of the photographs as GeoJSON features."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.deliver.placement import Placement
from pipelines.formats.camera_table import CameraTable
from pipelines.formats.geojson import Json, feature, polygon
from pipelines.geodesy.enu import lla_from_ecef
from pipelines.geometry.footprints import PointSurface, border_rays, footprint
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.survey import Survey

_LEAST_RAYS = 3  # of a point that counts as a part of the surface
_RIM = 0.005  # fraction of the points that are taken for errors above, and below


@dataclass(frozen=True)
class Footprints:
    """Footprints of n photographs.

    Attributes:
        features: n, the outline of the ground that each photograph shows, with its properties.
        corner_lla: (M, 3) corners of all outlines; the centres of the cameras if none shows ground.
    """

    features: list[Json]
    corner_lla: FloatArray


def footprints_of(survey: Survey, model: SparseModel, table: CameraTable, placement: Placement) -> Footprints:
    """Return the footprints of the photographs.

    The geometry is null for a photograph that shows no ground. `clipped` says that part of the photograph lies
    above the horizon, or so near below it that the outline ends at ten times the height above ground.

    Args:
        survey: has the times of exposure.
        model: cameras and points in the frame of the placement, z up.
        table: the same cameras, with split and σ.
        placement: of that frame.
    """
    surface = PointSurface(_surface_points(model))
    times = {image.name: image.timestamp_s for image in survey.images}
    rays = {key: border_rays(camera) for key, camera in model.cameras.items()}
    features, corners = [], []
    for index, (name, center) in enumerate(zip(model.image_name, model.cam_center_in_local, strict=True)):
        in_file = rays[int(model.image_camera_id[index])] @ model.rotation_cam_from_local[index]
        found = footprint(in_file, center, surface)
        lla = lla_from_ecef(placement.ecef_from_file.apply(found.outline))
        east, north, up = table.sigma_enu_m[index].tolist()
        properties = {
            "name": name,
            "split": table.split[index],
            "time": _iso(times.get(name)),
            "sigma_e_m": east,
            "sigma_n_m": north,
            "sigma_u_m": up,
            "clipped": found.clipped,
        }
        features.append(feature(polygon(lla[:, [1, 0]]), properties))
        corners.append(lla)
    seen = np.concatenate(corners)
    if not len(seen):
        seen = lla_from_ecef(placement.ecef_from_file.apply(model.cam_center_in_local))
    return Footprints(features, seen)


def _surface_points(model: SparseModel) -> FloatArray:
    """Return the points that three photographs show, without the highest and lowest; all if none are left."""
    rays = np.bincount(model.obs_point, minlength=len(model.point_id))
    good = rays >= _LEAST_RAYS
    points = model.point_in_local[good if good.any() else slice(None)]
    low, high = np.quantile(points[:, 2], [_RIM, 1 - _RIM])
    kept = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
    return kept if len(kept) else points


def _iso(seconds: float | None) -> str | None:
    try:
        return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):  # a clock beyond the calendar
        return None
