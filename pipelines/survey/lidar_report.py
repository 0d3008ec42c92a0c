"""LiDAR and other measured geometry of a training: its figures, and the points that the training was not given.

Lengths are metres. docs/formats.md explains the fields of what `evaluate` writes.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from pipelines.core.products import ArrayProduct, Product, Remark
from pipelines.core.types import FloatArray, IntArray, Vector3


class LidarArea(Product):
    """Area where the LiDAR and the photographs disagree.

    Attributes:
        kind: `removed`: the photographs look through the LiDAR's points; `added`: they show a surface above them.
        area_m2: in plan.
        points: of the thinned cloud; their mean is `center_in_geo`, `lat_deg`, `lon_deg`.
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
        read, noise, withheld, overlap, outside: numbers of points read, and dropped by reason.
        points: that remain after thinning, about `voxel_m` apart, and that the training was given.
        held_out: number of further ones that it was not given (`lidar_held_out`).
        rejected_share: of the points, which disagree with the photographs.
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
    held_out: int = 0
    voxel_m: float
    registration: LidarRegistration
    rejected_share: float
    confidence: float
    areas: tuple[LidarArea, ...]
    assumptions: tuple[Remark, ...] = ()


class DepthErrors(Product):
    """Errors of a surface at measured points, along their normals; above zero, it lies in front of them.

    Attributes:
        points: number of points.
        bias_m: median with sign.
        median_m, abs_90_m: median and 90th percentile of the magnitude.
    """

    points: int
    bias_m: float | None
    median_m: float | None
    abs_90_m: float | None


class HeldOutDepths(Product):
    """Errors of the surface at the measured points that the training was not given.

    Both are of the same points: where the depth maps of the photographs and the renders both show a surface, in the
    view that shows the point most closely.

    Attributes:
        share: of the squares of the plan that were held out.
        points: held-out points that a training view shows.
        changed, unseen: numbers of those that the photographs contradict, and that no training view shows.
        known_before, known_after: numbers of points at which depth maps and renders show a surface.
        before: of the photographs' depth maps, without measured geometry.
        after: of the trained model.
    """

    share: float
    points: int
    changed: int
    unseen: int
    known_before: int
    known_after: int
    before: DepthErrors
    after: DepthErrors


@dataclass(frozen=True)
class HeldOutPoints(ArrayProduct):
    """Product of `train` with measured geometry: N points of the squares that were held out.

    Attributes:
        point_in_model, normal_in_model: the points on the planes through their neighbours, and unit normals towards
            the view.
        view: camera of the training view that shows the point most closely.
        before_m: distance of the surface in the photographs' own depth map of that view from the point's plane,
            along the normal; NaN: the map shows none.
        share: of the squares that were held out.
        changed: number of held-out points that the photographs contradict; they are left out.
        unseen: number of those that no training view shows; they are left out.
    """

    FORMS: ClassVar = {
        "point_in_model": ("f", "N", 3),
        "normal_in_model": ("f", "N", 3),
        "view": ("i", "N"),
        "before_m": ("f", "N"),
        "share": ("f",),
        "changed": ("i",),
        "unseen": ("i",),
    }

    point_in_model: FloatArray
    normal_in_model: FloatArray
    view: IntArray
    before_m: FloatArray
    share: FloatArray
    changed: IntArray
    unseen: IntArray
