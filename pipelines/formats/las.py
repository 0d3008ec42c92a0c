"""LAZ files of georeferenced points with colour, normal and σ (LAS 1.4, point format 7).

The CRS is stated as WKT1 in GDAL's dialect: LAS 1.4 predates WKT2, which readers refuse there.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats.cloud_points import CloudPoints

if TYPE_CHECKING:
    import laspy

_POINT_FORMAT = 7  # RGB and time of LAS 1.4
_TEXT_AREA = ("LASF_Spec", 3)  # record for plain text
_RGB16 = 257  # 255 becomes 65535
DEGREE_STEP, METRE_STEP = 1e-9, 1e-3  # 0.1 mm on the ground, and 1 mm
_EXTRA = {
    "nx": "normal, first coordinate",
    "ny": "normal, second coordinate",
    "nz": "normal, third coordinate",
    "sigma_h": "horizontal sigma in metres",
    "sigma_v": "vertical sigma in metres",
}
_AXES = "enu"
_COVARIANCE = {  # name of each element of the upper triangle, with its row and column
    f"cov_{first}{second}": (row, column)
    for row, first in enumerate(_AXES)
    for column, second in enumerate(_AXES)
    if row <= column
}


def laz_header(
    point_format: int, *, wkt1: str, angular: bool, near: Any, software: str, system: str, written: date
) -> laspy.LasHeader:
    """Return the header of a LAZ file (LAS 1.4).

    Args:
        point_format: number of the format of its points.
        wkt1: CRS as WKT1.
        angular: whether the first two coordinates are angles.
        near: (3,) coordinates near the points; the file counts from these, rounded to integers.
        software: program that writes.
        system: origin of the points.
        written: date.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales = np.array([DEGREE_STEP, DEGREE_STEP, METRE_STEP] if angular else [METRE_STEP] * 3)
    header.offsets = np.round(np.asarray(near, dtype=np.float64))
    header.generating_software, header.system_identifier = software, system
    header.creation_date = written
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt1))
    header.global_encoding.wkt = True
    return header


class LazFile:
    """LAZ file of single returns that is written in chunks; a context manager."""

    def __init__(self, path: Path, header: laspy.LasHeader) -> None:
        import laspy

        self._header = header
        self._writer: laspy.LasWriter = laspy.open(path, mode="w", header=header, do_compress=True)

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file."""
        self._writer.close()

    def _record(self, position: FloatArray) -> laspy.ScaleAwarePointRecord:
        """Return a record of points (P, 3), each of them the only return of its beam."""
        import laspy

        record = laspy.ScaleAwarePointRecord.zeros(len(position), header=self._header)
        for column, name in enumerate(("x", "y", "z")):
            setattr(record, name, position[:, column])
        record["return_number"][:] = 1
        record["number_of_returns"][:] = 1
        return record


class LazWriter(LazFile):
    """Writer of a LAZ file of a surface.

    Args:
        path: of the file.
        wkt1: CRS as WKT1.
        angular: whether the first two coordinates are angles.
        near: (3,) coordinates near the points; the file counts from these, rounded to integers.
        software: program that writes.
        text: description for people, in English: vertical datum, meaning of σ.
    """

    def __init__(self, path: Path, *, wkt1: str, angular: bool, near: Any, software: str, text: str) -> None:
        import laspy

        system, today = "photogrammetry", date.today()
        header = laz_header(
            _POINT_FORMAT, wkt1=wkt1, angular=angular, near=near, software=software, system=system, written=today
        )
        header.vlrs.append(laspy.VLR(*_TEXT_AREA, "Text Area Description", text.encode("utf-8") + b"\0"))
        header.add_extra_dims(
            [
                laspy.ExtraBytesParams(name, "f4", description=meaning)
                for name, meaning in (_EXTRA | dict.fromkeys(_COVARIANCE, "covariance in square metres")).items()
            ]
        )
        super().__init__(path, header)

    def write(self, points: CloudPoints) -> None:
        """Append points.

        Raises:
            OverflowError: a coordinate is further from `near` than the file's integers reach (2147 km or 2.1°).
        """
        record = self._record(points.position)
        for column, name in enumerate(("red", "green", "blue")):
            setattr(record, name, points.rgb[:, column].astype(np.uint16) * _RGB16)
        for column, name in enumerate(("nx", "ny", "nz")):
            record[name] = points.normal[:, column]
        record["sigma_h"], record["sigma_v"] = points.sigma_h_m, points.sigma_v_m
        for name, (row, column) in _COVARIANCE.items():
            record[name] = points.cov_m2[:, row, column]
        self._writer.write_points(record)
