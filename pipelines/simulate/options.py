"""Options of `georef simulate`, which belongs to no stage in a workspace."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipelines.core.options import EFFORT, PlaceOnEarth, StageOptions, Triple, listed_names

TargetKind = Literal["quarters", "aruco", "apriltag"]
CHANGES = ("excavation", "heap", "new", "demolished", "growth")


class LidarFlightOptions(StageOptions):
    """Options of the LiDAR flight, which crosses the town in two directions before the photographs are taken."""

    lidar: bool = Field(False, description="Write a LiDAR flight too: lidar.laz and lidar_trajectory.csv.")
    lidar_height: float = Field(60.0, ge=20, le=300, description="Height of the LiDAR flight in metres.")
    lidar_radius: float = Field(60.0, ge=10, le=300, description="Half side of the scanned square in metres.")
    lidar_density: float = Field(100.0, gt=0, le=2000, description="Returns per square metre of level ground.")
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


class EpochOptions(StageOptions):
    """Options of a second flight over the town of the same seed, with other noise and the same targets."""

    epoch: Literal["1", "2"] = Field("1", description="2: a later flight over the town of this --seed.")
    changes: str = Field(
        ",".join(CHANGES),
        description="Changes before the second flight, with commas: " + ", ".join(CHANGES) + ", or none.",
    )
    change_height: float = Field(
        2.0, gt=0, le=10, description="Depth of the excavation and height of the heap in metres."
    )
    light: Literal["other", "same"] = Field("other", description="Sun of the second flight.")

    @property
    def changed(self) -> tuple[str, ...]:
        """Changes of this epoch."""
        return () if self.epoch == "1" or self.changes == "none" else tuple(listed_names(self.changes, CHANGES))

    @field_validator("changes")
    @classmethod
    def _known_changes(cls, text: str) -> str:
        if text != "none":
            listed_names(text, CHANGES)
        return text


class SimulateOptions(EpochOptions, LidarFlightOptions):
    """Options of a simulated survey. Triples are written with commas: `46.02,7.75,1620`."""

    scene: Literal["city", "village"] = Field("city", description="Type of town.")
    flight: Literal["orbit", "grid", "facade"] = Field(
        "orbit", description="Circles around the complex, nadir lines, or along its facades."
    )
    images: int = Field(48, ge=3, le=5000, description="Number of photographs.")
    size: str = Field(
        "640x480", pattern=r"^\d{2,5}x\d{2,5}$", description="Size of the photographs in pixels, WxH."
    )
    seed: int = Field(0, ge=0, description="Seed of everything: scene, flight and noise.")
    origin: PlaceOnEarth = Field(
        (46.02, 7.75, 1620.0), description="Place on Earth: latitude,longitude,ellipsoidal height."
    )
    heights: tuple[float, ...] = Field(
        (),
        description="Height of a circle, grid or round above the origin in metres (default: by flight).",
        json_schema_extra={"flag": "--height"},
    )
    radius: float | None = Field(
        None,
        gt=0,
        description="Radius of the circle, half side of the grid, or distance from facades in metres.",
    )
    interval: float | None = Field(
        None,
        ge=0.2,
        le=600,
        description="Seconds between photographs (default: 2, more above 8 m/s).",
    )
    gnss: Literal["rtk", "ppk", "consumer", "outliers"] = Field(
        "rtk", description="Receiver: sets σ, slow bias and outliers, which options below set one by one."
    )
    sigma_h: float | None = Field(None, ge=0, description="White noise of the fixes, horizontal σ in metres.")
    sigma_v: float | None = Field(None, ge=0, description="White noise of the fixes, vertical σ in metres.")
    bias: float | None = Field(None, ge=0, description="RMS of the slow bias of the fixes per axis in metres.")
    bias_period: float = Field(60.0, gt=0, description="Period of the slow bias in seconds.")
    common_error: Triple = Field(
        (0.0, 0.0, 0.0),
        description="Systematic error of all fixes, as of a base station, east,north,up in metres.",
    )
    outlier_share: float | None = Field(None, ge=0, le=1, description="Share of photographs whose fixes are wrong.")
    outlier_size: float = Field(15.0, gt=0, description="Error of a wrong fix in metres.")
    sigma_attitude: float = Field(0.5, ge=0, description="White noise of the attitude per axis in degrees.")
    lever_arm: Triple = Field(
        (0.0, 0.0, 0.0),
        description="Antenna seen from the camera in the body's axes, forward,right,down in metres.",
    )
    boresight: Triple = Field(
        (0.0, 0.0, 0.0), description="Rotation vector from the true to the nominal camera axes, x,y,z in degrees."
    )
    clock_offset: float = Field(0.0, ge=-10, le=10, description="Navigation clock minus camera clock in seconds.")
    lens: Literal["pinhole", "radial", "opencv"] = Field("opencv", description="Lens model.")
    focal: float = Field(0.85, ge=0.3, le=10, description="Focal length as a multiple of the image's width.")
    k1: float = Field(-0.045, ge=-0.5, le=0.5, description="Radial distortion.")
    k2: float = Field(0.012, ge=-0.5, le=0.5, description="Radial distortion of the next order.")
    p1: float = Field(0.0004, ge=-0.02, le=0.02, description="Tangential distortion (opencv).")
    p2: float = Field(-0.0003, ge=-0.02, le=0.02, description="Tangential distortion (opencv).")
    exposure: float = Field(0.08, ge=0, le=0.5, description="Variation of the exposure (σ of its logarithm).")
    white_balance: float = Field(
        0.012, ge=0, le=0.5, description="Variation of the white balance (σ of its logarithm a channel)."
    )
    vignetting: float = Field(0.22, ge=0, le=0.9, description="Loss of light in the corners.")
    rolling_shutter: float = Field(
        0.0, ge=0, le=0.5, description="Readout time of a photograph in seconds, from its first to its last row."
    )
    noise: float = Field(1.0, ge=0, le=20, description="Sensor noise; 1 is a small sensor at base sensitivity.")
    samples: Literal["1", "4", "9", "16"] = Field("4", description="Rays per pixel (anti-aliasing).")
    quality: int = Field(95, ge=50, le=100, description="JPEG quality.")
    targets: int = Field(60, ge=0, le=500, description="Survey targets to lay out.")
    target_kind: TargetKind = Field(
        "quarters",
        description="Targets: black and white quarters, or tags, numbered as the points (DICT_4X4_250, "
        "DICT_APRILTAG_36h11).",
    )
    target_size: float | None = Field(
        None,
        gt=0.05,
        le=20,
        description="Width of a target in metres, of a tag without its white margin (default: five pixels, of "
        "tags 30).",
    )
    control: int = Field(
        8, ge=0, description="Targets to use as control points, a third at the most; the others are check points."
    )
    sigma_survey: float = Field(0.0, ge=0, description="σ of the targets' surveyed coordinates in metres.")
    sigma_mark: float = Field(0.2, ge=0, description="σ of the image marks in pixels.")
    bag: Literal["none", "mcap", "sqlite3"] = Field("none", description="Write the flight as a rosbag2 too.")
    depth: bool = Field(False, description="Write true depth maps (float32, metres).")
    exif: bool = Field(True, description="Write position, attitude and lens into the photographs.")
    threads: Annotated[int, EFFORT] = Field(-1, ge=-1, le=256, description="Threads that render (-1: all).")

    @property
    def size_px(self) -> tuple[int, int]:
        width, height = self.size.split("x")
        return int(width), int(height)

    @field_validator("size")
    @classmethod
    def _sensible_size(cls, text: str) -> str:
        sides = [int(side) for side in text.split("x")]
        if min(sides) < 32 or max(sides) > 8192:
            raise ValueError("sides from 32 to 8192 pixels")
        return text
