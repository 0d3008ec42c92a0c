"""Table of cameras as CSV: position, angles in both conventions, and σ.

`read_trajectory` of `trajectory_csv` reads position, yaw, pitch, roll and σ back, so that a table can be the input
of another survey. A σ that is not known is an empty cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats.csv_writer import write_table

_METRES, _DEGREES, _ANGLE = "%.4f", "%.9f", "%.6f"  # 0.1 mm; 0.1 mm on the ground; 1 cm at 500 km
_GRID = ("x", "y", "z")
_GEOGRAPHIC = ("longitude", "latitude", "altitude")
_MAP_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_GIMBAL = ("yaw_deg", "pitch_deg", "roll_deg")
_SIGMA = ("sigma_e_m", "sigma_n_m", "sigma_u_m")
_SIGMA_ANGLES = ("sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")


@dataclass(frozen=True)
class CameraTable:
    """Cameras of n photographs.

    Attributes:
        name: n names.
        split: of each, `train` or `test`.
        position: (n, 3) in a CRS: easting, northing, height, or longitude, latitude, height.
        geographic: whether the first two are degrees.
        omega_phi_kappa_deg: (n, 3) against the axes of the CRS.
        yaw_pitch_roll_deg: (n, 3) against true north and the vertical.
        sigma_enu_m: (n, 3) along true east, north, up; NaN: not known.
        sigma_angles_deg: (n, 3) of ω, φ, κ; NaN: not known.
    """

    name: tuple[str, ...]
    split: tuple[str, ...]
    position: FloatArray
    geographic: bool
    omega_phi_kappa_deg: FloatArray
    yaw_pitch_roll_deg: FloatArray
    sigma_enu_m: FloatArray
    sigma_angles_deg: FloatArray


def write_camera_table(path: Path, table: CameraTable) -> None:
    """Write the table; the file appears whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    plan = _DEGREES if table.geographic else _METRES
    forms = [plan, plan, _METRES, *[_ANGLE] * 6, *[_METRES] * 3, *[_ANGLE] * 3]
    numbers = np.concatenate(
        [
            table.position,
            table.omega_phi_kappa_deg,
            table.yaw_pitch_roll_deg,
            table.sigma_enu_m,
            table.sigma_angles_deg,
        ],
        axis=1,
    )
    position = _GEOGRAPHIC if table.geographic else _GRID
    header = ("name", "split", *position, *_MAP_ANGLES, *_GIMBAL, *_SIGMA, *_SIGMA_ANGLES)
    rows = (
        (name, split, *(form % value if np.isfinite(value) else "" for form, value in zip(forms, row, strict=True)))
        for name, split, row in zip(table.name, table.split, numbers, strict=True)
    )
    write_table(path, (header, *rows))
