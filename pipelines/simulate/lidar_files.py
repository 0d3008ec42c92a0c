"""Files of a simulated LiDAR flight: the cloud and the scanner's track."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import date
from pathlib import Path
from types import TracebackType

from pipelines.formats.lidar_las import LidarReturns, LidarWriter
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, lla_from_enu, lla_of
from pipelines.simulate.lidar import Strip

CLOUD, TRACK = "lidar.laz", "lidar_trajectory.csv"
_CRS = "EPSG:4979"
_LON_LAT_ALT = [1, 0, 2]
_WRITTEN = date(2026, 1, 1)  # the same options give the same bytes


class LidarFiles:
    """Writer of both files; a context manager.

    Args:
        folder: of the files.
        origin: of geo.
    """

    def __init__(self, folder: Path, origin: Origin) -> None:
        self._folder, self._origin = folder, origin
        self._open = ExitStack()

    def __enter__(self) -> LidarFiles:
        """Open the files."""
        crs = parse_crs(_CRS)
        near = lla_of(self._origin)[_LON_LAT_ALT]
        writer = LidarWriter(
            self._folder / CLOUD,
            wkt1=crs.wkt1,
            angular=True,
            near=near,
            software="georef simulate",
            written=_WRITTEN,
        )
        self._cloud = self._open.enter_context(writer)
        self._track = self._open.enter_context((self._folder / TRACK).open("w", encoding="utf-8"))
        self._track.write("timestamp,latitude,longitude,altitude\n")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the files."""
        self._open.close()

    def write(self, strip: Strip) -> None:
        """Append a strip."""
        position = lla_from_enu(strip.position_in_geo, self._origin)[:, _LON_LAT_ALT]
        self._cloud.write(
            LidarReturns(position, strip.classification, strip.time_s, strip.scan_angle_deg, strip.number)
        )
        for time_s, (lat, lon, alt) in zip(
            strip.track_s, lla_from_enu(strip.track_in_geo, self._origin), strict=True
        ):
            self._track.write(f"{time_s:.3f},{lat:.10f},{lon:.10f},{alt:.4f}\n")
