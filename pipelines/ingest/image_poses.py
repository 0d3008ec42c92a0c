"""Measured positions and attitudes of images, whatever they were read from; σ by option, by file or by receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy.enu import lla_from_ecef
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.trajectory import Trajectory
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions

PoseSource = Literal["exif", "csv", "geo.txt", "metashape", "pos", "mrk", "bag"]
SigmaSource = Literal["file", "option", "default"]
AttitudeSource = Literal["gimbal", "csv", "geo.txt", "metashape", "pos", "mrk", "bag"]


@dataclass(frozen=True)
class ImagePoses:
    """Measured poses of N images; NaN rows where nothing was measured.

    Attributes:
        position_in_ecef: (N, 3) metres.
        sigma_enu_m: (N, 3).
        sigma_source: (N,) who gave σ.
        receivers: (N,) kinds of receiver, of `RECEIVERS`, as recorded.
        enu_from_cam: (N, 3, 3) attitude against north and up at the camera.
        attitude_source: (N,).
        sigma_attitude_deg: (N,) σ that the attitudes state.
        time_s: (N,) seconds since 1970 UTC.
        source: of the positions, with their CRS and the datum that their heights counted from.
        recorded: the Earth-centred trajectory that images were matched with by time, None where it was by name.
    """

    position_in_ecef: FloatArray
    sigma_enu_m: FloatArray
    sigma_source: tuple[SigmaSource, ...]
    receivers: tuple[str, ...]
    enu_from_cam: FloatArray
    attitude_source: tuple[AttitudeSource, ...]
    sigma_attitude_deg: FloatArray
    time_s: FloatArray
    source: PoseSource
    crs_name: str
    vertical: VerticalDatum
    recorded: Trajectory | None = None

    @property
    def located(self) -> BoolArray:
        """Which images have a position (N,)."""
        return complete(self.position_in_ecef)

    @property
    def located_lla(self) -> FloatArray:
        """WGS84 latitude, longitude and ellipsoidal height of the images that have a position (K, 3)."""
        return lla_from_ecef(self.position_in_ecef[self.located])


# σ horizontal and vertical in metres where the file is silent, by kind of receiver, from the best to the worst.
RECEIVER_SIGMA_M = {
    "RTK fixed": (0.02, 0.03),
    "RTK float": (0.5, 1.0),
    "single-frequency": (2.5, 5.0),
    "unknown receiver": (5.0, 10.0),
}
RECEIVERS = tuple(RECEIVER_SIGMA_M)


def with_defaults(
    stated: FloatArray, receivers: Sequence[str], located: BoolArray, options: IngestOptions, notes: Notes
) -> tuple[FloatArray, tuple[SigmaSource, ...]]:
    """Return σ east, north, up (N, 3) by precedence, and who gave it (N,).

    σ of the file (N, 3) are NaN where it is silent. Defaults are noted but for images without a position.
    """
    from_file = complete(stated)
    defaults = np.array([RECEIVER_SIGMA_M[receiver] for receiver in receivers]).reshape(-1, 2)
    sigma = np.where(np.isfinite(stated), stated, defaults[:, [0, 0, 1]])
    if options.sigma_h is not None:
        sigma[:, :2] = options.sigma_h
    if options.sigma_v is not None:
        sigma[:, 2] = options.sigma_v
    for receiver in sorted(set(receivers)):
        rows = located & ~from_file & (np.array(receivers) == receiver)
        horizontal_m, vertical_m = RECEIVER_SIGMA_M[receiver]
        parts = [f"{horizontal_m:g} m horizontal"] if options.sigma_h is None else []
        parts += [f"{vertical_m:g} m vertical"] if options.sigma_v is None else []
        if rows.any() and parts:
            notes.assume(f"σ of positions without one ({int(rows.sum())}): {', '.join(parts)} ({receiver})")
    overridden = options.sigma_h is not None or options.sigma_v is not None
    sources: list[SigmaSource] = ["option" if overridden else "file" if row else "default" for row in from_file]
    return sigma, tuple(sources)
