"""Track of a scanner: its place at the time of each point of a LiDAR cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef
from pipelines.geometry.trajectory import Trajectory
from pipelines.scene.cloud_options import CloudCrs

_WGS84 = "EPSG:4979"
_MAX_GAP_S = 2.0
_LEAST_COVERED = 0.5  # of the points: with fewer, the clocks differ


@dataclass(frozen=True)
class ScannerTrack:
    """Places of a scanner by time, in geo."""

    trajectory: Trajectory

    @classmethod
    def read(cls, path: Path, stated: CloudCrs, origin: Origin) -> ScannerTrack:
        """Return the track of a CSV file: time, and latitude, longitude, altitude or x, y, z.

        Args:
            path: of the file, on the clock of the cloud's points.
            stated: CRS and vertical datum of the cloud, which those of a track without a CRS are.
            origin: of geo.

        Raises:
            InputError: an unreadable file, or one without times.
        """
        table = read_trajectory(path)
        if table.time_s is None:
            raise InputError("has no column `timestamp`", path=path, field="--lidar-trajectory")
        text = _WGS84 if table.geographic else stated.crs
        if text is None:
            raise InputError(
                "has projected coordinates: --lidar-crs states their CRS", path=path, field="--lidar-trajectory"
            )
        lla = parse_crs(text, vertical=stated.vertical, path=path).lla_from_xyz(table.xyz, path=path)
        order = np.argsort(table.time_s, kind="stable")
        time_s, first = np.unique(table.time_s[order], return_index=True)
        place = enu_from_ecef(ecef_from_lla(lla), origin)[order][first]
        return cls(Trajectory.from_samples(time_s, position=place, max_gap_s=_MAX_GAP_S))

    def at(self, gps_time_s: FloatArray) -> FloatArray:
        """Return the scanner's places (P, 3) at times (P,); NaN where the track has none.

        Raises:
            InputError: the track has none for most times.
        """
        known = np.isfinite(gps_time_s)
        place = np.full((len(gps_time_s), 3), np.nan)
        place[known] = self.trajectory.at(gps_time_s[known]).position
        covered = float(np.isfinite(place[:, 0]).mean())
        if covered < _LEAST_COVERED:
            raise InputError(
                f"has a place for the times of {covered:.0%} of the points: it counts on another clock, or belongs "
                "to another flight",
                field="--lidar-trajectory",
            )
        return place
