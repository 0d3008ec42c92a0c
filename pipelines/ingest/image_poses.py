"""Measured positions and attitudes of images, with σ, whatever they were read from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.pose_table import complete
from pipelines.geodesy.enu import lla_from_ecef
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.trajectory import Trajectory

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
        receivers: (N,) kinds of receiver, of `position_sigma.RECEIVERS`, as recorded.
        enu_from_cam: (N, 3, 3) attitude against north and up at the camera.
        attitude_source: (N,) where it is from.
        sigma_attitude_deg: (N,) σ that the attitudes state.
        time_s: (N,) seconds since 1970 UTC.
        source: where positions are from.
        crs_name: their CRS.
        vertical: the datum that their heights counted from.
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
