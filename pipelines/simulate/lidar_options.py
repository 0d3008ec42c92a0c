"""Options of the simulated flight of a laser scanner."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.options import StageOptions, Triple


class LidarFlightOptions(StageOptions):
    """Options of the LiDAR flight, which crosses the town in two directions before the photographs are taken."""

    lidar: bool = Field(False, description="Write a LiDAR flight too: lidar.laz and lidar_trajectory.csv.")
    lidar_height: float = Field(60.0, ge=20, le=300, description="Height of the LiDAR flight in metres.")
    lidar_radius: float = Field(60.0, ge=10, le=300, description="Half side of the scanned square in metres.")
    lidar_density: float = Field(100.0, gt=0, le=2000, description="Returns for a square metre of level ground.")
    lidar_fov: float = Field(40.0, ge=5, le=75, description="Largest angle of a beam from the vertical in degrees.")
    lidar_sigma: float = Field(0.02, ge=0, le=1, description="White noise of the ranges in metres.")
    lidar_drift: float = Field(0.0, ge=0, le=1, description="RMS of a slow drift of each strip per axis in metres.")
    lidar_shift: Triple = Field((0.0, 0.0, 0.0), description="Shift of the whole cloud, east,north,up in metres.")
    lidar_arm: Triple = Field(
        (0.0, 0.0, 0.0),
        description="Part of the scanner's lever arm that the cloud lacks, forward,right,down in metres.",
    )
    lidar_missed: float = Field(0.03, ge=0, lt=1, description="Share of the beams that do not return.")
    lidar_change: Literal["none", "removed", "added"] = Field(
        "none", description="A building removed, or added, between the LiDAR flight and the photographs."
    )
