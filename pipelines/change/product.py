"""Records of the product of `georef change`, from noise and sums of cells."""

from __future__ import annotations

import numpy as np

from pipelines.change.detection import QUANTILE_95, Noise, Volume
from pipelines.core.types import vector3
from pipelines.survey.change_report import ChangedRegion, Registration


def registration_of(noise: Noise, *, applied: bool, datum_v_m: float) -> Registration:
    """Return the record of a registration; `datum_v_m` is the σ of a vertical shift by both adjustments."""
    sigma = np.sqrt(np.diag(noise.shift_cov_m2))
    limit = QUANTILE_95 * float(np.hypot(datum_v_m, np.hypot(sigma[2], noise.long_range_m)))
    return Registration(
        applied=applied,
        shift_m=vector3(noise.shift_m),
        sigma_shift_m=vector3(sigma),
        tilt=(float(noise.tilt[0]), float(noise.tilt[1])),
        sigma_tilt=(float(noise.tilt_sigma[0]), float(noise.tilt_sigma[1])),
        datum_sigma_v_m=datum_v_m,
        long_range_sigma_m=noise.long_range_m,
        correlated_m2=noise.correlated_m2,
        correlation_length_m=noise.length_m,
        noise_factor=noise.scatter,
        stable_share=noise.share,
        contradicts=not applied and abs(float(noise.shift_m[2])) > limit,
    )


def region_of(name: str, volume: Volume, noise: Noise, cell_m2: float) -> ChangedRegion:
    """Return the record of a region from the sums of its cells."""
    return ChangedRegion(
        name=name,
        area_m2=volume.cells * cell_m2,
        cut_m3=volume.cut * cell_m2,
        fill_m3=volume.fill * cell_m2,
        net_m3=(volume.fill - volume.cut) * cell_m2,
        sigma_m3=volume.sigma_m3(noise, cell_m2),
        lowest_m=volume.lowest,
        highest_m=volume.highest,
    )
