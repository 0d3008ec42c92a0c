"""LAZ files of a laser scanner: class, time, strip and angle of each beam (LAS 1.4, point format 6)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from pipelines.core.types import ByteArray, FloatArray
from pipelines.formats.las import LazFile, laz_header

_POINT_FORMAT = 6
_ANGLE_STEP_DEG = 0.006


@dataclass(frozen=True)
class LidarReturns:
    """P returns of one strip.

    Attributes:
        position: (P, 3) in the CRS, easting or longitude first.
        classification: (P,) class of LAS.
        gps_time_s: (P,) time.
        scan_angle_deg: (P,) of the beam across the strip.
        strip: number of the strip, from 1.
    """

    position: FloatArray
    classification: ByteArray
    gps_time_s: FloatArray
    scan_angle_deg: FloatArray
    strip: int


class LidarWriter(LazFile):
    """Writer of a LAZ file of a scanner.

    Args:
        path: of the file.
        wkt1: CRS as WKT1.
        angular: whether the first two coordinates are angles.
        near: (3,) coordinates near the points; the file counts from these, rounded to integers.
        software: program that writes.
        written: date in the header.
    """

    def __init__(
        self, path: Path, *, wkt1: str, angular: bool, near: FloatArray, software: str, written: date
    ) -> None:
        header = laz_header(
            _POINT_FORMAT,
            wkt1=wkt1,
            angular=angular,
            near=near,
            software=software,
            system="simulated",
            written=written,
        )
        super().__init__(path, header)

    def write(self, returns: LidarReturns) -> None:
        """Append the returns."""
        record = self._record(returns.position)
        record["classification"] = returns.classification
        record["gps_time"] = returns.gps_time_s
        record["scan_angle"] = np.round(returns.scan_angle_deg / _ANGLE_STEP_DEG).astype(np.int16)
        record["point_source_id"] = np.full(len(returns.position), returns.strip, dtype=np.uint16)
        self._writer.write_points(record)
