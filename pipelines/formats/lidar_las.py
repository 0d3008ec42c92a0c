"""LAZ files of a laser scanner: class, time, strip and angle of each beam (LAS 1.4, point format 6)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from pipelines.core.types import ByteArray, FloatArray
from pipelines.formats.las import DEGREE_STEP, METRE_STEP

if TYPE_CHECKING:
    import laspy

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


class LidarWriter:
    """Writer of a LAZ file in chunks; a context manager.

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
        import laspy

        header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
        header.scales = np.array([DEGREE_STEP, DEGREE_STEP, METRE_STEP] if angular else [METRE_STEP] * 3)
        header.offsets = np.round(np.asarray(near, dtype=np.float64))
        header.generating_software, header.system_identifier = software, "simulated"
        header.creation_date = written
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt1))
        header.global_encoding.wkt = True
        self._header = header
        self._writer: laspy.LasWriter = laspy.open(path, mode="w", header=header, do_compress=True)

    def __enter__(self) -> LidarWriter:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file."""
        self._writer.close()

    def write(self, returns: LidarReturns) -> None:
        """Append the returns."""
        import laspy

        record = laspy.ScaleAwarePointRecord.zeros(len(returns.position), header=self._header)
        for column, name in enumerate(("x", "y", "z")):
            setattr(record, name, returns.position[:, column])
        record["classification"] = returns.classification
        record["gps_time"] = returns.gps_time_s
        record["scan_angle"] = np.round(returns.scan_angle_deg / _ANGLE_STEP_DEG).astype(np.int16)
        record["return_number"][:] = 1
        record["number_of_returns"][:] = 1
        record["point_source_id"] = np.full(len(returns.position), returns.strip, dtype=np.uint16)
        self._writer.write_points(record)
