"""LAZ files of georeferenced points with colour, normal and σ (LAS 1.4, point format 7).

The CRS is stated as WKT1 in GDAL's dialect: LAS 1.4 predates WKT2, which readers refuse there.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

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


class LazWriter:
    """Writer of a LAZ file in chunks; a context manager.

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

        header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
        header.scales = np.array([DEGREE_STEP, DEGREE_STEP, METRE_STEP] if angular else [METRE_STEP] * 3)
        header.offsets = np.round(np.asarray(near, dtype=np.float64))
        header.generating_software, header.system_identifier = software, "photogrammetry"
        header.creation_date = date.today()
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt1))
        header.global_encoding.wkt = True
        header.vlrs.append(laspy.VLR(*_TEXT_AREA, "Text Area Description", text.encode("utf-8") + b"\0"))
        header.add_extra_dims(
            [laspy.ExtraBytesParams(name, "f4", description=meaning) for name, meaning in _EXTRA.items()]
        )
        self._header = header
        self._writer: laspy.LasWriter = laspy.open(path, mode="w", header=header, do_compress=True)

    def __enter__(self) -> LazWriter:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file."""
        self._writer.close()

    def write(self, points: CloudPoints) -> None:
        """Append points.

        Raises:
            OverflowError: a coordinate is further from `near` than the file's integers reach (2147 km or 2.1°).
        """
        import laspy

        record = laspy.ScaleAwarePointRecord.zeros(len(points), header=self._header)
        for column, name in enumerate(("x", "y", "z")):
            setattr(record, name, points.position[:, column])
        for column, name in enumerate(("red", "green", "blue")):
            setattr(record, name, points.rgb[:, column].astype(np.uint16) * _RGB16)
        for column, name in enumerate(("nx", "ny", "nz")):
            record[name] = points.normal[:, column]
        record["sigma_h"], record["sigma_v"] = points.sigma_h_m, points.sigma_v_m
        record["return_number"][:] = 1
        record["number_of_returns"][:] = 1
        self._writer.write_points(record)
