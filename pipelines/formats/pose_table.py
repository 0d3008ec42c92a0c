"""Positions and attitudes of images as a table states them, row by row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class PoseTable:
    """N rows of a trajectory, all that the file has. Absent columns are None, absent cells NaN.

    Attributes:
        path: its file.
        source: kind of file.
        lines: (N,) line of each row.
        names: image of each row.
        time_s: (N,) seconds since 1970; a text without a zone is read as UTC.
        xyz: (N, 3) longitude or easting, latitude or northing, height, in the file's CRS.
        geographic: whether the columns were called latitude and longitude; None if the CRS alone decides.
        quat_xyzw: (N, 4) rotations camera → East-North-Up at the camera.
        sigma_enu_m: (N, 3) σ east, north, up.
        receiver: (N,) kind of receiver, as the solution has it: `RTK fixed`, `RTK float`, `single-frequency` or
            `unknown receiver`.
        crs_text: the CRS that the file states.
        crs_line: line of the CRS.
        assumed_crs: CRS of a file that states none, where `--crs` names none either; None: WGS84 for latitude and
            longitude, and otherwise it must be named.
        heights_above_geoid: whether the heights are above a geoid that the file does not name.
        zoneless_times: whether a time was a text without a zone.
        unknown_columns: names in the header that mean nothing here.
        header_line: line of the header.
    """

    path: Path
    source: Literal["csv", "geo.txt", "metashape", "pos", "mrk"]
    lines: IntArray
    names: tuple[str, ...] | None
    time_s: FloatArray | None
    xyz: FloatArray
    geographic: bool | None
    quat_xyzw: FloatArray | None = None
    sigma_enu_m: FloatArray | None = None
    receiver: NDArray[np.str_] | None = None
    crs_text: str | None = None
    crs_line: int = 1
    assumed_crs: str | None = None
    heights_above_geoid: bool = False
    zoneless_times: bool = False
    unknown_columns: tuple[str, ...] = ()
    header_line: int = 1

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, rows: IntArray | BoolArray) -> PoseTable:
        """Return the rows of an index (M,) or mask (N,)."""
        names = None if self.names is None else tuple(np.array(self.names, dtype=object)[rows])
        return replace(
            self,
            lines=self.lines[rows],
            names=names,
            time_s=_taken(self.time_s, rows),
            xyz=self.xyz[rows],
            quat_xyzw=_taken(self.quat_xyzw, rows),
            sigma_enu_m=_taken(self.sigma_enu_m, rows),
            receiver=None if self.receiver is None else self.receiver[rows],
        )


def complete(values: FloatArray) -> BoolArray:
    """Return which rows of (N, k) values have no NaN: (N,)."""
    return np.asarray(np.isfinite(values).all(axis=1))


def _taken(values: FloatArray | None, rows: IntArray | BoolArray) -> FloatArray | None:
    return None if values is None else values[rows]
