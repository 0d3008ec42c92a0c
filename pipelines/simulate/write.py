"""Writing of a survey's tables: trajectory, raw navigation, control and check points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.simulate.sensors import GnssLog, ImuLog

POINTS_CRS = "EPSG:4979"


@dataclass(frozen=True)
class SurveyedTarget:
    """Target as the surveyor measured it: position (3,) in geo, and (image, x, y) of its marks."""

    name: str
    position_in_geo: FloatArray
    marks: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class PhotoRecords:
    """Records of N photographs.

    Attributes:
        names: file names.
        stamp_ns: (N,) camera clock.
        lla: (N, 3) degrees and ellipsoidal metres of the antenna.
        yaw_pitch_roll_deg: (N, 3) of the camera.
        sigma_enu_m: (3,) that the receiver states.
    """

    names: tuple[str, ...]
    stamp_ns: IntArray
    lla: FloatArray
    yaw_pitch_roll_deg: FloatArray
    sigma_enu_m: FloatArray


def write_trajectory(path: Path, photos: PhotoRecords) -> None:
    """Write a line for each photograph: position and attitude at its stamp."""
    rows = ["image,timestamp,latitude,longitude,altitude,yaw,pitch,roll,sigma_e,sigma_n,sigma_u"]
    sigma = ",".join(f"{value:.4g}" for value in photos.sigma_enu_m)
    for name, stamp, lla, angles in zip(
        photos.names, photos.stamp_ns, photos.lla, photos.yaw_pitch_roll_deg, strict=True
    ):
        turned = ",".join(f"{angle:.4f}" for angle in angles)
        rows.append(f"{name},{_seconds(stamp)},{_position(lla)},{turned},{sigma}")
    _write(path, rows)


def write_gnss(path: Path, log: GnssLog, sigma_enu_m: FloatArray, origin: Origin) -> None:
    """Write every fix, on the navigation clock."""
    rows = ["timestamp,latitude,longitude,altitude,sigma_e,sigma_n,sigma_u"]
    sigma = ",".join(f"{value:.4g}" for value in sigma_enu_m)
    places = lla_from_enu(log.position_in_geo, origin)
    rows += [f"{_seconds(stamp)},{_position(lla)},{sigma}" for stamp, lla in zip(log.stamp_ns, places, strict=True)]
    _write(path, rows)


def write_imu(path: Path, log: ImuLog, enu_from_body: FloatArray) -> None:
    """Write every attitude (N, 3, 3), on the navigation clock: East-North-Up from the body, forward-right-down."""
    rows = ["timestamp,qx,qy,qz,qw"]
    for stamp, quat in zip(log.stamp_ns, quat_xyzw_from_matrix(enu_from_body), strict=True):
        rows.append(f"{_seconds(stamp)}," + ",".join(f"{part:.9f}" for part in quat))
    _write(path, rows)


def write_points(path: Path, targets: Sequence[SurveyedTarget], origin: Origin) -> None:
    """Write control or check points in the form of ODM's gcp_list.txt: x is the longitude."""
    rows = [POINTS_CRS]
    for target in targets:
        lat, lon, alt = lla_from_enu(target.position_in_geo, origin)
        place = f"{lon:.10f} {lat:.10f} {alt:.5f}"
        rows += [f"{place} {x:.3f} {y:.3f} {image} {target.name}" for image, x, y in target.marks]
    _write(path, rows)


def _seconds(stamp_ns: np.int64) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000 // 1000:06d}"


def _position(lla: FloatArray) -> str:
    return f"{lla[0]:.9f},{lla[1]:.9f},{lla[2]:.4f}"


def _write(path: Path, rows: Sequence[str]) -> None:
    path.write_text("\n".join(rows) + "\n", encoding="utf-8", newline="\n")
