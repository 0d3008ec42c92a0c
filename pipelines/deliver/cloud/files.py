"""Files of a cloud, written part by part."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from pipelines import __version__
from pipelines.core.stages import CLOUD
from pipelines.deliver.cloud.frame import CloudFrame
from pipelines.deliver.cloud.tally import Tally
from pipelines.formats.cloud_ply import CloudPlyWriter
from pipelines.formats.cloud_points import CloudPoints
from pipelines.formats.las import LazWriter

SIGMA_COUNTS = "georeference, disagreement of the training views about the surface, intersection of their rays"


class CloudFiles:
    """Files of a cloud: LAZ, and PLY on request.

    Args:
        frame: CRS of the points.
        folder: for the files.
        ply: write the PLY too.

    Raises:
        InputError: a LAZ file cannot state this CRS.
    """

    def __init__(self, frame: CloudFrame, folder: Path, *, ply: bool) -> None:
        self.frame = frame
        self._wkt1 = frame.target.crs.wkt1
        laz = folder / CLOUD.rpartition("/")[2]
        self.paths = (laz, laz.with_suffix(".ply")) if ply else (laz,)

    def write(self, parts: Iterable[CloudPoints]) -> Tally:
        """Write points part by part, and return their figures."""
        target, tally = self.frame.target, Tally()
        place = [f"CRS: {target.crs.name}", f"heights: {target.crs.vertical.name}, {target.crs.height_unit}"]
        lines = [*place, "sigma_h, sigma_v: predicted standard deviations in metres: " + SIGMA_COUNTS]
        lines.append("cov_ee to cov_uu: their covariance in square metres, along east, north, up")
        software = f"GeoRefGS {__version__}"
        with ExitStack() as stack:
            writers: list[LazWriter | CloudPlyWriter] = [
                LazWriter(
                    self.paths[0],
                    wkt1=self._wkt1,
                    angular=target.crs.is_geographic,
                    near=self.frame.middle,
                    software=software,
                    text="\n".join(lines),
                )
            ]
            writers += [CloudPlyWriter(path, [software, *lines]) for path in self.paths[1:]]
            for writer in writers:
                stack.enter_context(writer)
            for points in parts:
                tally.add(points)
                for writer in writers:
                    writer.write(points)
        return tally
