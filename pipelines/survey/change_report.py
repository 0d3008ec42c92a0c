"""Change between two surveys of one place: registration, regions and their volumes."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.products import Product
from pipelines.core.types import Vector3


class EpochShift(Product):
    """Shift of the later epoch against the earlier one on unchanged ground, east, north, up.

    Attributes:
        applied: whether the differences are free of it.
        datum_sigma_v_m: σ of a vertical shift by both adjustments; 0: not known.
        long_range_sigma_m: of errors that vary slowly over the scene.
        correlated_m2: area over which the errors of cells are one error.
        noise_factor: of the predicted σ of the cells, by the scatter of unchanged ground.
        stable_share: of the level ground that is measured in both.
        contradicts: whether the shift is not applied, and larger than its σ allows.
    """

    applied: bool
    shift_m: Vector3
    sigma_shift_m: Vector3
    tilt: tuple[float, float]
    sigma_tilt: tuple[float, float]
    datum_sigma_v_m: float
    long_range_sigma_m: float
    correlated_m2: float
    correlation_length_m: float
    noise_factor: float
    stable_share: float
    contradicts: bool


class CommonDates(Product):
    """Points in common that tie two epochs, one of which was adjusted onto the other, or both onto others.

    Attributes:
        steps: from one epoch to the other, by way of the epochs that they were adjusted onto.
        points, used: number of the points of the step with the fewest, and of those that agree with the others.
        spread: share of the ground in common that has points, least of the steps.
        sigma_h_m, sigma_v_m: σ of the difference of both epochs, horizontal along an axis and vertical, in the
            median over the scene. It has no part of the place on Earth, which both share.
    """

    steps: int
    points: int
    used: int
    spread: float
    sigma_h_m: float
    sigma_v_m: float


class ChangedRegion(Product):
    """Region by its name: R, found; P, of the user's polygons; with the σ of its net volume.

    Area, volumes and σ are those of the cells with a height of both dates: `known_share` of the polygon.
    """

    name: str
    area_m2: float
    cut_m3: float
    fill_m3: float
    net_m3: float
    sigma_m3: float
    lowest_m: float
    highest_m: float
    known_share: float = 1.0


class DoubtfulRegion(ChangedRegion):
    """Found region that counts as no change, by its name: D. `reason` is the code of the warning that says why."""

    reason: str


class RegionAtDate(Product):
    """Net volume of a region at a date against the earlier epoch, and against the date before; `all`: of all R."""

    name: str
    net_m3: float
    sigma_m3: float
    since_previous_m3: float
    sigma_since_previous_m3: float


class DateOfChange(Product):
    """Date of a chain, its regions, and the vertical σ of its difference to the earlier epoch.

    `name` is that of the workspace, `taken_on` the days of its photographs, a dash if they have no time.
    """

    name: str
    taken_on: str
    sigma_v_m: float
    regions: tuple[RegionAtDate, ...]


class AlongNormals(Product):
    """Change along the normals of the earlier surface, at points of its cloud.

    Attributes:
        points, measured: number of core points, and of those near which both clouds have enough points.
        cylinder_m: radius of the cylinders, and distance of the core points.
        reach_m: largest distance that is found.
        median_lod_m, significant_share: of the measured; None: there are none.
    """

    points: int
    measured: int
    cylinder_m: float
    reach_m: float
    median_lod_m: float | None
    significant_share: float | None


class Change(Product):
    """Change between two epochs.

    Attributes:
        shared_sigma_v_m: σ of the vertical error that both have in common.
        median_lod_m: level of detection of the cells that both have measured.
        significant_share: of all cells.
        doubtful_share: of the cells that differ significantly, those of doubtful regions, which count as no change.
        lowered, raised, found: sums of the found regions that lost, that gained, and of all; none of doubtful ones.
        doubtful: the largest first.
        along_normals: of the clouds, on request.
        common: what ties both epochs; None: they were solved apart.
        unmeasured: known share of the user's polygons that are no regions, as hardly any of them is known, by name.
        by_date: volumes in the regions at each later date of a chain, in their order; empty without dates between.
    """

    format_version: Literal[2] = 2
    of: Literal["surface", "terrain"]
    crs: str
    cell_m: float
    registration: EpochShift
    shared_control_points: tuple[str, ...]
    shared_sigma_v_m: float
    median_lod_m: float
    significant_share: float
    doubtful_share: float = 0.0
    lowered: ChangedRegion
    raised: ChangedRegion
    found: ChangedRegion
    regions: tuple[ChangedRegion, ...]
    doubtful: tuple[DoubtfulRegion, ...] = ()
    unmeasured: dict[str, float] = Field(default_factory=dict)
    along_normals: AlongNormals | None = None
    common: CommonDates | None = None
    by_date: tuple[DateOfChange, ...] = ()
