"""Comparison of the surface with a reference cloud, as `evaluate` states it: scores, distances, groups, shift.

Lengths are metres. docs/formats.md explains the fields.
"""

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Matrix34, Vector3

Alignment = Literal["none", "shift", "similarity"]


class SurfaceScore(Product):
    """Shares of points that lie within a distance of the other cloud; None: there are no points.

    Precision is that of the model's points, where the reference covers the plan; recall that of the reference's
    points that photographs saw; F1 their harmonic mean.
    """

    threshold_m: float
    precision: float | None
    recall: float | None
    f1: float | None


class M3c2Figures(Product):
    """Distances model minus reference along the reference's normals (M3C2), positive on the cameras' side.

    They are measured at those of the core points, which photographs saw, that have points of both clouds nearby.
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

    They are taken where the reference covers the plan; those beyond 2 m count as 2 m.
    """

    count: int
    median_m: float | None
    mean_m: float | None
    abs_95_m: float | None


class ReferenceGroup(Product):
    """Figures of one part of the surface, of which photographs saw `seen_points` of the reference.

    Its name is `all`; a class (`ground`, `roof`, `wall`, `vegetation`, `other`); or a range of slopes.
    """

    name: str
    kind: Literal["all", "class", "slope"]
    seen_points: int
    m3c2: M3c2Figures
    c2c: CloudDistances
    scores: tuple[SurfaceScore, ...]


class ReferenceShift(Product):
    """Translation that moves the model onto the reference best, by points and planes.

    σ are from the spread between parts of the scene; `reference_from_model` has the rows of [sR | t] in geo.
    """

    enu_m: Vector3
    sigma_m: Vector3
    scale_ppm: float
    turn_deg: float
    reference_from_model: Matrix34
    points: int


class ReferenceComparison(Product):
    """Comparison of the surface with a reference cloud, from which a shift may have been removed (`aligned`).

    The level of detection holds `georeference_sigma_m`, but for None, which is not known.
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
