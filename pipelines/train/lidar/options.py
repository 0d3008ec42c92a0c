"""Options of the LiDAR that training takes its surface from."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipelines.core.options import InputPath, StageOptions
from pipelines.geodesy.vertical import Vertical
from pipelines.scene.cloud_options import CloudCrs, CloudPath

LidarPull = Literal["depth", "gaussians", "both"]


class LidarOptions(StageOptions):
    """Options of a LiDAR cloud: where it lies, how accurate it is, and how training uses it."""

    lidar: CloudPath | None = Field(
        None, description="LiDAR of the same place to hold the surface to: LAS, LAZ or PLY, or a folder of tiles."
    )
    lidar_crs: str | None = Field(None, description="CRS of the LiDAR, for files that state none.")
    lidar_vertical: Vertical | None = Field(
        None, description="Datum of the LiDAR's heights, where its CRS has no vertical part."
    )
    lidar_trajectory: InputPath | None = Field(
        None,
        description="Track of the LiDAR's scanner, on the clock of its points: CSV with timestamp, latitude, "
        "longitude, altitude.",
    )
    lidar_sigma: float = Field(0.03, gt=0, le=10, description="Stated σ of the LiDAR's points in metres.")
    lidar_pull: LidarPull = Field(
        "both",
        description="Hold rendered depths to the LiDAR, Gaussians, each with a confidence of its own, or both.",
    )
    lidar_register: bool = Field(False, description="Estimate a shift of the LiDAR, and take it out.")

    @model_validator(mode="after")
    def _used(self) -> LidarOptions:
        if self.lidar is None and (
            self.lidar_crs or self.lidar_vertical or self.lidar_trajectory or self.lidar_register
        ):
            raise ValueError(
                "--lidar-crs, --lidar-vertical, --lidar-trajectory and --lidar-register belong to --lidar"
            )
        return self

    @property
    def lidar_stated(self) -> CloudCrs:
        """CRS of the LiDAR as the user states it."""
        return CloudCrs(self.lidar_crs, self.lidar_vertical)
