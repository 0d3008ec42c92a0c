"""Record of the LiDAR that a training has used: `train/lidar.json`."""

from __future__ import annotations

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Vector3


class LidarArea(Product):
    """Area where the LiDAR and the photographs contradict each other.

    Attributes:
        kind: `removed`: the photographs look through the LiDAR's points; `added`: they show a surface above them.
        area_m2: in plan.
        points: of the thinned cloud.
        center_in_geo: mean of these points.
        lat_deg, lon_deg: of that mean.
    """

    kind: Literal["removed", "added"]
    area_m2: float
    points: int
    center_in_geo: Vector3
    lat_deg: float
    lon_deg: float


class LidarRegistration(Product):
    """Shift of the LiDAR against the surface of the photographs, axes of geo.

    Attributes:
        shift_m: LiDAR minus photographs.
        sigma_m: of the shift: comparison, georeference and stated σ of the LiDAR.
        sigma_comparison_m: of the comparison alone.
        points: compared, on planes.
        spread_m: robust σ of the distances that remain.
        wall_bias_m: surface of stereo outside the LiDAR's walls.
        removed: whether the shift was taken out, by `--lidar-register`.
    """

    shift_m: Vector3
    sigma_m: Vector3
    sigma_comparison_m: Vector3
    points: int
    spread_m: float
    wall_bias_m: float
    removed: bool


class LidarReport(Product):
    """LiDAR of a training.

    Attributes:
        crs: names of the files' CRSs.
        read, noise, withheld, overlap, outside: numbers of points read, and dropped by reason.
        points: that remain after thinning.
        voxel_m: distance between them, about.
        registration: check against the photographs.
        rejected_share: of the points, which contradict the photographs.
        confidence: median over the points.
        areas: that have changed, the largest first.
        assumptions: what the files do not say.
    """

    format_version: Literal[1] = 1
    crs: tuple[str, ...]
    read: int
    noise: int
    withheld: int
    overlap: int
    outside: int
    points: int
    voxel_m: float
    registration: LidarRegistration
    rejected_share: float
    confidence: float
    areas: tuple[LidarArea, ...]
    assumptions: tuple[str, ...] = ()
