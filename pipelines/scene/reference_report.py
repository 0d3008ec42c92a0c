"""Comparison of the model's surface with a reference cloud: part of `evaluate/report.json`. Lengths are metres."""

from __future__ import annotations

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Matrix34, Vector3

Alignment = Literal["none", "shift", "similarity"]


class SurfaceScore(Product):
    """Shares of points that lie within a distance of the other cloud; None: there are no points.

    Attributes:
        threshold_m: the distance.
        precision: of the model's points, where the reference covers the plan.
        recall: of the reference's points that photographs saw.
        f1: their harmonic mean.
    """

    threshold_m: float
    precision: float | None
    recall: float | None
    f1: float | None


class M3c2Figures(Product):
    """Distances model minus reference along the reference's normals (M3C2), positive on the cameras' side.

    Attributes:
        core_points: places on the reference that photographs saw.
        measured: places at which both clouds have points within the cylinder.
        median_m, mean_m: signed.
        nmad_m: 1.4826 times the median absolute deviation from the median.
        rmse_m: root mean square.
        abs_95_m: 95 % of the distances are shorter.
        median_lod_m: median level of detection, 95 %.
        significant: share of the distances beyond their level of detection.
    """

    core_points: int
    measured: int
    median_m: float | None
    mean_m: float | None
    nmad_m: float | None
    rmse_m: float | None
    abs_95_m: float | None
    median_lod_m: float | None
    significant: float | None


class CloudDistances(Product):
    """Distances of the model's points from the nearest point of the reference (C2C), to the millimetre.

    Attributes:
        count: points of the model where the reference covers the plan.
        median_m, mean_m, abs_95_m: of the distances; those beyond 2 m count as 2 m.
    """

    count: int
    median_m: float | None
    mean_m: float | None
    abs_95_m: float | None


class ReferenceGroup(Product):
    """Figures of one part of the surface.

    Attributes:
        name: `all`; a class (`ground`, `roof`, `wall`, `vegetation`, `other`); or a range of slopes.
        kind: of the name.
        seen_points: points of the reference that photographs saw.
        m3c2, c2c, scores: distances and shares.
    """

    name: str
    kind: Literal["all", "class", "slope"]
    seen_points: int
    m3c2: M3c2Figures
    c2c: CloudDistances
    scores: tuple[SurfaceScore, ...]


class ReferenceShift(Product):
    """Translation that moves the model onto the reference best, by points and planes.

    Attributes:
        enu_m: east, north, up.
        sigma_m: their σ, from the spread between parts of the scene.
        scale_ppm, turn_deg: of the similarity; 0 for a shift.
        reference_from_model: rows of the matrix [sR | t] in geo.
        points: that decide.
    """

    enu_m: Vector3
    sigma_m: Vector3
    scale_ppm: float
    turn_deg: float
    reference_from_model: Matrix34
    points: int


class ReferenceComparison(Product):
    """Comparison of the surface with a reference cloud.

    Attributes:
        name: of the file or folder.
        crs: of the reference.
        points: of the reference within the scene, after thinning.
        seen: share of them that photographs saw.
        spacing_m: median distance between neighbours in the reference.
        model_points: of the model's cloud.
        model_spacing_m: side of its voxels.
        sigma_m: stated σ of the reference.
        georeference_sigma_m: median predicted σ of the georeference along the normals; None: not known, and the
            level of detection does not hold it.
        shift: of the model against the reference.
        aligned: whether that was removed before the comparison.
        cylinder_m: radius of the cylinders of M3C2.
        groups: figures of the whole, of classes and of slopes.
    """

    name: str
    crs: tuple[str, ...]
    points: int
    seen: float
    spacing_m: float
    model_points: int
    model_spacing_m: float
    sigma_m: float
    georeference_sigma_m: float | None
    shift: ReferenceShift | None
    aligned: Alignment
    cylinder_m: float
    groups: tuple[ReferenceGroup, ...]

    def group(self, name: str) -> ReferenceGroup:
        """Return the figures of a part of the surface."""
        return next(group for group in self.groups if group.name == name)
