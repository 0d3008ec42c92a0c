"""PLY files of georeferenced points: full coordinates as doubles, so that no offset can be lost.

CloudCompare reads them and offers a shift for its display. Programs that keep float32 coordinates need the LAZ.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np

from pipelines.formats.cloud_points import CloudPoints

_VERTEX = [
    ("x", "<f8"), ("y", "<f8"), ("z", "<f8"),
    ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    ("sigma_h", "<f4"), ("sigma_v", "<f4"),
]  # fmt: skip
_NAMES = {"<f8": "double", "<f4": "float", "u1": "uchar"}
_COUNT_DIGITS = 20


class CloudPlyWriter:
    """Writer of a binary PLY file in chunks; a context manager.

    Args:
        path: of the file.
        comments: lines for people, such as the CRS; ASCII alone is kept.
    """

    def __init__(self, path: Path, comments: list[str]) -> None:
        self._comments = [" ".join(line.split()).encode("ascii", "ignore").decode() for line in comments]
        self._count = 0
        self._file = path.open("wb")
        self._file.write(self._header())

    def __enter__(self) -> CloudPlyWriter:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the number of points into the header, and close the file."""
        try:
            self._file.seek(0)
            self._file.write(self._header())
        finally:
            self._file.close()

    def write(self, points: CloudPoints) -> None:
        """Append points."""
        vertex = np.empty(len(points), dtype=_VERTEX)
        for column, axis in enumerate("xyz"):
            vertex[axis] = points.position[:, column]
            vertex["n" + axis] = points.normal[:, column]
        for column, colour in enumerate(("red", "green", "blue")):
            vertex[colour] = points.rgb[:, column]
        vertex["sigma_h"], vertex["sigma_v"] = points.sigma_h_m, points.sigma_v_m
        self._file.write(vertex.tobytes())
        self._count += len(points)

    def _header(self) -> bytes:
        """Return the header, of a length that does not depend on the number of points."""
        padding = "-" * (_COUNT_DIGITS - len(str(self._count)))
        lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in self._comments)]
        lines += [f"comment {padding}", f"element vertex {self._count}"]
        lines += [f"property {_NAMES[kind]} {name}" for name, kind in _VERTEX]
        return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
