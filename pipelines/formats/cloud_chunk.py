"""Points of a cloud as its file holds them, a part at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipelines.core.types import BoolArray, ByteArray, FloatArray

UNCLASSIFIED, GROUND, BUILDING = 1, 2, 6  # classes of LAS


@dataclass(frozen=True)
class CloudChunk:
    """P points of a file.

    Attributes:
        position: (P, 3) in the file's CRS, easting or longitude first.
        classification: (P,) class of LAS; 0: never classified.
        overlap: (P,) whether another strip covers the place better.
        withheld: (P,) whether the producer has withdrawn the point.
        gps_time_s: (P,) time as the file has it; None: the file has none.
    """

    position: FloatArray
    classification: ByteArray
    overlap: BoolArray
    withheld: BoolArray
    gps_time_s: FloatArray | None

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position)


class CloudFile(Protocol):
    """File of points whose header has been checked.

    Attributes:
        path: of the file.
        count: number of points.
        crs: of the file as a text; None: the file states none.
    """

    @property
    def path(self) -> Path: ...
    @property
    def count(self) -> int: ...
    @property
    def crs(self) -> str | None: ...

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield all points in chunks of at most `size`."""
        ...
