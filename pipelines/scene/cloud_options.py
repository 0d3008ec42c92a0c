"""Options of clouds of other instruments: path, CRS and datum of the heights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pipelines.core.options import InputMarker
from pipelines.geodesy.vertical import VerticalChoice

CLOUD_SUFFIXES = frozenset({".las", ".laz", ".ply"})
NOT_IN_BLOCKS = (
    "a training in blocks does not use LiDAR: its shift is estimated against the depth maps of all photographs. "
    "Omit --lidar, or train in one run: `--blocks 1`, with a smaller --max-gaussians or --max-image-size where "
    "memory is short"
)
CloudPath = Annotated[Path, InputMarker(CLOUD_SUFFIXES)]


@dataclass(frozen=True)
class CloudCrs:
    """CRS of clouds as the user states it; what the files say themselves counts first.

    Attributes:
        crs: text of the CRS, for files without one.
        vertical: datum of the heights, where the CRS has no vertical part.
        flag: option that named the clouds, for errors: `--lidar` has `--lidar-crs` and `--lidar-vertical`.
    """

    crs: str | None = None
    vertical: VerticalChoice | None = None
    flag: str = "--lidar"
