"""Product of `georef change`: registration, regions and their volumes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pipelines.change.detection import QUANTILE_95, Noise, Volume
from pipelines.core.products import Product
from pipelines.core.types import Vector3, vector3


class Registration(Product):
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

    @classmethod
    def of(cls, noise: Noise, *, applied: bool, datum_v_m: float) -> Registration:
        sigma = np.sqrt(np.diag(noise.shift_cov_m2))
        limit = QUANTILE_95 * float(np.hypot(datum_v_m, np.hypot(sigma[2], noise.long_range_m)))
        return cls(
            applied=applied,
            shift_m=vector3(noise.shift_m),
            sigma_shift_m=vector3(sigma),
            tilt=(float(noise.tilt[0]), float(noise.tilt[1])),
            sigma_tilt=(float(noise.tilt_sigma[0]), float(noise.tilt_sigma[1])),
            datum_sigma_v_m=datum_v_m,
            long_range_sigma_m=noise.long_range_m,
            correlated_m2=noise.correlated_m2,
            correlation_length_m=noise.length_m,
            noise_factor=float(np.sqrt(noise.factor)),
            stable_share=noise.share,
            contradicts=not applied and abs(float(noise.shift_m[2])) > limit,
        )


class ChangedRegion(Product):
    """Region by its name: R, found; P, of the user's polygons; with the σ of its net volume."""

    name: str
    area_m2: float
    cut_m3: float
    fill_m3: float
    net_m3: float
    sigma_m3: float
    lowest_m: float
    highest_m: float

    @classmethod
    def of(cls, name: str, volume: Volume, noise: Noise, cell_m2: float) -> ChangedRegion:
        return cls(
            name=name,
            area_m2=volume.cells * cell_m2,
            cut_m3=volume.cut * cell_m2,
            fill_m3=volume.fill * cell_m2,
            net_m3=(volume.fill - volume.cut) * cell_m2,
            sigma_m3=volume.sigma_m3(noise, cell_m2),
            lowest_m=volume.lowest,
            highest_m=volume.highest,
        )


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
        lowered, raised, found: sums of the found regions that lost, that gained, and of all.
        along_normals: of the clouds, on request.
    """

    format_version: Literal[2] = 2
    of: Literal["surface", "terrain"]
    crs: str
    cell_m: float
    registration: Registration
    shared_control_points: tuple[str, ...]
    shared_sigma_v_m: float
    median_lod_m: float
    significant_share: float
    lowered: ChangedRegion
    raised: ChangedRegion
    found: ChangedRegion
    regions: tuple[ChangedRegion, ...]
    along_normals: AlongNormals | None = None
