"""The options of every stage, each with its default, range and meaning, in one place.

Precedence: default < the workspace's `georef.toml` (one table a stage) < command-line flag. The command line
derives its flags from these classes, so that a default exists once. Unknown keys and values out of range are
errors that name the key.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic.fields import FieldInfo

from pipelines.errors import InputError

CONFIG_FILE = "georef.toml"
AUTO = "auto"
RIG_PARAMETERS = ("time-offset", "boresight", "lever-arm")


class InputMarker:
    """Marks a path whose content decides the stage's result: its fingerprint enters the manifest."""


InputPath = Annotated[Path, InputMarker()]


class StageConfig(BaseModel):
    """Base of all stage options: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class IngestConfig(StageConfig):
    """What `georef ingest` reads, and what it assumes where the files are silent."""

    images: InputPath | None = Field(None, description="Folder of photographs.")
    bag: InputPath | None = Field(
        None, description="ROS bag with photographs and navigation: rosbag2 folder, .mcap, .db3 or ROS 1 .bag."
    )
    image_topic: str | None = Field(None, description="Topic of the photographs in the bag (default: by rule).")
    fix_topic: str | None = Field(None, description="Topic of the positions in the bag (default: by rule).")
    attitude_topic: str | None = Field(None, description="Topic of the attitudes in the bag (default: by rule).")
    every: str | None = Field(
        None, description="Take a frame of the bag every 2s, or every 5m flown (default: all)."
    )
    skip_blurred: bool = Field(False, description="Pass over blurred frames of the bag.")
    origin: str | None = Field(
        None,
        description="Zero of a bag's local frame (odometry, poses): latitude,longitude,ellipsoidal height.",
    )
    time_offset: str = Field(
        "0", description="Navigation clock minus camera clock in seconds; auto: by `georef calibrate` after sfm."
    )
    lever_arm: str | None = Field(
        None,
        description="Antenna seen from the camera in the body's axes, forward,right,down in metres (default: /tf).",
    )
    camera_mount: str | None = Field(
        None,
        description="How the camera is turned in the body, yaw,pitch,roll in degrees; 0,-90,0 looks down "
        "(default: /tf).",
    )
    boresight: str = Field(
        "0,0,0", description="Rotation vector from the true to the nominal camera axes, x,y,z in degrees."
    )
    trajectory: InputPath | None = Field(None, description="CSV with a header: image and/or timestamp, position …")
    geo: InputPath | None = Field(None, description="ODM geo.txt with the image positions.")
    gcp: InputPath | None = Field(None, description="ODM gcp_list.txt: ground control points and their marks.")
    checkpoints: InputPath | None = Field(None, description="Check points, in the form of gcp_list.txt.")
    check: tuple[str, ...] = Field((), description="Name of a control point to use as a check point instead.")
    test_every: int = Field(8, ge=0, description="Hold out every N-th image for testing (0: none).")
    crs: str | None = Field(None, description="CRS of x,y,z columns in the trajectory, e.g. EPSG:32632+5773.")
    vertical: str | None = Field(
        None, description="Vertical datum of the heights: ellipsoidal, EGM96, EGM2008 or EPSG:n."
    )
    sigma_h: float | None = Field(None, gt=0, description="Horizontal σ of every position in metres.")
    sigma_v: float | None = Field(None, gt=0, description="Vertical σ of every position in metres.")
    sigma_attitude: float | None = Field(None, gt=0, description="σ of the attitude in degrees.")
    sigma_gcp_h: float = Field(0.02, gt=0, description="Horizontal σ of surveyed points in metres.")
    sigma_gcp_v: float = Field(0.03, gt=0, description="Vertical σ of surveyed points in metres.")
    sigma_mark: float = Field(0.5, gt=0, description="σ of an image mark in pixels.")
    max_gap: float = Field(1.0, gt=0, description="Longest gap to interpolate over in the trajectory, in seconds.")
    focal_px: float | None = Field(None, gt=0, description="Focal length in pixels, instead of the one from EXIF.")
    copy_images: bool = Field(
        False, description="Copy the photographs into the workspace.", json_schema_extra={"flag": "--copy"}
    )

    @property
    def time_offset_s(self) -> float:
        """Seconds; zero while it is still to be estimated."""
        return 0.0 if self.time_offset == AUTO else float(self.time_offset)

    @field_validator("time_offset")
    @classmethod
    def _is_offset(cls, text: str) -> str:
        if text != AUTO and not abs(float(text)) < 1e6:
            raise ValueError("a number of seconds, or auto")
        return text

    @field_validator("lever_arm", "camera_mount", "boresight")
    @classmethod
    def _is_triple(cls, text: str | None) -> str | None:
        if text is not None:
            triple(text)
        return text

    @field_validator("origin")
    @classmethod
    def _is_on_earth(cls, text: str | None) -> str | None:
        return text if text is None else on_earth(text)


class SfmConfig(StageConfig):
    """Structure from motion with COLMAP."""

    mapper: Literal["incremental", "global"] = Field("incremental", description="Mapper.")
    camera_model: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"] = Field(
        "OPENCV", description="COLMAP camera model to estimate."
    )
    pairs: Literal["auto", "exhaustive"] = Field(
        "auto", description="Image pairs to match: from positions and view directions, or all."
    )
    max_neighbors: int = Field(16, ge=2, description="Neighbours that an image is matched with at the most.")
    max_image_size: int = Field(1200, ge=128, description="Longest image side for features, in pixels.")
    max_features: int = Field(5000, ge=200, description="Features an image at the most.")
    import_model: InputPath | None = Field(
        None,
        description="Use this COLMAP model instead of reconstructing.",
        json_schema_extra={"flag": "--import"},
    )
    threads: int = Field(-1, ge=-1, description="Threads (-1: all cores).")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")


class GeolocateConfig(StageConfig):
    """Multi-view intersection of every SfM point in the geo frame."""

    attitude: Literal["auto", "recorded", "sfm"] = Field(
        "auto", description="Rotations of the rays: recorded with the images, or SfM's aligned to geo."
    )
    sigma_px: float = Field(0.7, gt=0, description="σ of an image observation in pixels.")
    min_angle: float = Field(1.0, gt=0, lt=90, description="Least intersection angle of an inlier in degrees.")
    max_sigma: float | None = Field(
        None, gt=0, description="Largest σ along any axis of an inlier, in metres (default: no limit)."
    )


class InitSim3Config(StageConfig):
    """The similarity from the SfM model into the geo frame."""

    method: Literal["robust", "paper"] = Field(
        "robust", description="robust: RANSAC and weights from covariances; paper: plain least squares."
    )
    max_residual: float | None = Field(
        None, gt=0, description="Fail if the RMS residual of the camera centres is larger, in metres."
    )
    seed: int = Field(0, ge=0, description="Seed of the RANSAC.")


class TrainConfig(StageConfig):
    """Joint optimisation of Gaussians, similarity and camera corrections."""

    preset: Literal["smoke", "fast", "standard", "high"] = Field("standard", description="Effort.")
    iterations: int | None = Field(None, ge=1, description="Iterations (default: the preset's).")
    max_image_size: int | None = Field(
        None, ge=32, description="Longest image side for training in pixels (default: the preset's)."
    )
    max_gaussians: int | None = Field(None, ge=100, description="Limit of Gaussians (default: the preset's).")
    backend: Literal["auto", "cpu", "cuda"] = Field("auto", description="Rasteriser.")
    sh_degree: int = Field(3, ge=0, le=3, description="Degree of the spherical harmonics.")
    strategy: Literal["default", "mcmc", "fast"] = Field(
        "default", description="Where Gaussians are added and removed: as 3DGS, by MCMC, or as several views agree."
    )
    coarse_to_fine: bool = Field(True, description="Start with shrunken photographs.")
    exposure: bool = Field(True, description="Fit the exposure of each training photograph.")
    dense: bool = Field(True, description="Find the scene's surface by multi-view stereo first, to start from.")
    faithful_surface: bool = Field(True, description="Hold the Gaussians to the surface, for depths to measure in.")
    geo_loss: bool = Field(True, description="Use the geographic losses.")
    weighting: Literal["whitened", "paper"] = Field(
        "whitened", description="Residuals divided by their σ, or plain mean squares as in the paper."
    )
    geo_weight: float = Field(0.05, gt=0, description="Final weight w_max of the geographic losses (eq. 27).")
    optimize_cameras: bool = Field(True, description="Correct the training cameras while training.")
    checkpoint_every: int = Field(500, ge=1, description="Iterations between checkpoints.")
    log_every: int = Field(10, ge=1, description="Iterations between lines of metrics.jsonl.")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")


class EvaluateConfig(StageConfig):
    """Test views and check points."""

    backend: Literal["auto", "cpu", "cuda"] = Field("auto", description="Rasteriser.")
    renders: int = Field(8, ge=0, description="Side-by-side renders to write at the most.")
    lpips_weights: InputPath | None = Field(
        None, description="NPZ file of LPIPS (VGG) weights; without it LPIPS is null."
    )


class ExportPlyConfig(StageConfig):
    """The splat as a 3DGS PLY with its sidecar."""

    min_opacity: float = Field(0.005, ge=0, lt=1, description="Leave out Gaussians that are less opaque.")


class CalibrateConfig(StageConfig):
    """What `georef calibrate` estimates from the SfM cameras and the recorded navigation."""

    estimate: str = Field(
        "time-offset,boresight", description="Any of time-offset, boresight and lever-arm, with commas."
    )
    max_offset: float = Field(
        2.0, gt=0, le=60, description="Search the time offset so many seconds on either side of the present one."
    )

    @property
    def wanted(self) -> tuple[str, ...]:
        """The parameters, in their usual order."""
        return tuple(name for name in RIG_PARAMETERS if name in self.estimate.split(","))

    @field_validator("estimate")
    @classmethod
    def _are_parameters(cls, text: str) -> str:
        unknown = [name for name in text.split(",") if name not in RIG_PARAMETERS]
        if unknown:
            raise ValueError(f"{unknown[0]!r} is none of {', '.join(RIG_PARAMETERS)}")
        return text


class SimulateConfig(StageConfig):
    """A survey to simulate. Triples are written with commas: `46.02,7.75,1620`."""

    scene: Literal["city", "village"] = Field("city", description="What stands there.")
    flight: Literal["orbit", "grid", "facade"] = Field(
        "orbit", description="Circles around the complex, nadir lines, or along its facades."
    )
    images: int = Field(48, ge=3, le=5000, description="Photographs.")
    size: str = Field("640x480", pattern=r"^\d{2,5}x\d{2,5}$", description="Their size in pixels, WxH.")
    seed: int = Field(0, ge=0, description="Seed of everything: scene, flight and noise.")
    origin: str = Field("46.02,7.75,1620", description="Where on Earth: latitude,longitude,ellipsoidal height.")
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
        "rtk", description="Receiver: sets σ, slow bias and outliers, each of which can be set by itself."
    )
    sigma_h: float | None = Field(None, ge=0, description="White noise of the fixes, horizontal σ in metres.")
    sigma_v: float | None = Field(None, ge=0, description="White noise of the fixes, vertical σ in metres.")
    bias: float | None = Field(None, ge=0, description="RMS of the slow bias of the fixes per axis in metres.")
    bias_period: float = Field(60.0, gt=0, description="Period of the slow bias in seconds.")
    outlier_share: float | None = Field(None, ge=0, le=1, description="Share of photographs whose fixes are wrong.")
    outlier_size: float = Field(15.0, gt=0, description="How far a wrong fix is off, in metres.")
    sigma_attitude: float = Field(0.5, ge=0, description="White noise of the attitude per axis in degrees.")
    lever_arm: str = Field(
        "0,0,0", description="Antenna seen from the camera in the body's axes, forward,right,down in metres."
    )
    boresight: str = Field(
        "0,0,0", description="Rotation vector from the true to the nominal camera axes, x,y,z in degrees."
    )
    clock_offset: float = Field(0.0, ge=-10, le=10, description="Navigation clock minus camera clock in seconds.")
    lens: Literal["pinhole", "radial", "opencv"] = Field("opencv", description="Lens model.")
    focal: float = Field(0.85, ge=0.3, le=10, description="Focal length as a multiple of the image's width.")
    k1: float = Field(-0.045, ge=-0.5, le=0.5, description="Radial distortion.")
    k2: float = Field(0.012, ge=-0.5, le=0.5, description="Radial distortion of the next order.")
    p1: float = Field(0.0004, ge=-0.02, le=0.02, description="Tangential distortion (opencv).")
    p2: float = Field(-0.0003, ge=-0.02, le=0.02, description="Tangential distortion (opencv).")
    exposure: float = Field(0.08, ge=0, le=0.5, description="Variation of the exposure (σ of its logarithm).")
    noise: float = Field(1.0, ge=0, le=20, description="Sensor noise; 1 is a small sensor at base sensitivity.")
    samples: Literal["1", "4", "9", "16"] = Field("4", description="Rays for a pixel (anti-aliasing).")
    quality: int = Field(95, ge=50, le=100, description="JPEG quality.")
    targets: int = Field(60, ge=0, le=500, description="Survey targets to lay out.")
    target_size: float | None = Field(
        None, gt=0.05, le=20, description="Width of a target in metres (default: five pixels)."
    )
    control: int = Field(
        8, ge=0, description="Targets to use as control points, a third at the most; the others are check points."
    )
    sigma_survey: float = Field(0.0, ge=0, description="σ of the targets' surveyed coordinates in metres.")
    sigma_mark: float = Field(0.2, ge=0, description="σ of the image marks in pixels.")
    bag: Literal["none", "mcap", "sqlite3"] = Field("none", description="Write the flight as a rosbag2 too.")
    depth: bool = Field(False, description="Write true depth maps (float32, metres).")
    exif: bool = Field(True, description="Write position, attitude and lens into the photographs.")
    threads: int = Field(-1, ge=-1, le=256, description="Threads that render (-1: all cores).")

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self.size.split("x")
        return int(width), int(height)

    @field_validator("size")
    @classmethod
    def _sensible_size(cls, text: str) -> str:
        sides = [int(side) for side in text.split("x")]
        if min(sides) < 32 or max(sides) > 8192:
            raise ValueError("sides from 32 to 8192 pixels")
        return text

    @field_validator("origin")
    @classmethod
    def _on_earth(cls, text: str) -> str:
        return on_earth(text)

    @field_validator("lever_arm", "boresight")
    @classmethod
    def _is_triple(cls, text: str) -> str:
        triple(text)
        return text


def on_earth(text: str) -> str:
    """The text, if it is latitude,longitude,height of a place on Earth.

    Raises:
        ValueError: it is not.
    """
    lat, lon, alt = triple(text)
    if abs(lat) > 90 or abs(lon) > 180 or not -1000 <= alt <= 10000:
        raise ValueError("latitude −90 … 90, longitude −180 … 180, height −1000 … 10000")
    return text


def triple(text: str) -> tuple[float, float, float]:
    """Three finite numbers written with commas.

    Raises:
        ValueError: anything else.
    """
    parts = text.split(",")
    if len(parts) != 3:
        raise ValueError("three numbers with commas, like 46.02,7.75,1620")
    x, y, z = (float(part) for part in parts)
    if not all(abs(number) < 1e6 for number in (x, y, z)):
        raise ValueError("three finite numbers")
    return x, y, z


ConfigT = TypeVar("ConfigT", bound=StageConfig)


def flag_name(config_type: type[StageConfig], name: str) -> str:
    """The command-line flag of a field: its name with dashes, or what the field says."""
    info = config_type.model_fields.get(name)
    extra = info.json_schema_extra if info is not None else None
    stated = extra.get("flag") if isinstance(extra, dict) else None
    return str(stated) if stated else "--" + name.replace("_", "-")


def input_paths(config: StageConfig) -> dict[str, Path]:
    """The paths among a config's values whose content decides the stage's result, by field."""
    fields = type(config).model_fields
    return {
        name: Path(value)
        for name, info in fields.items()
        if _is_input(info) and (value := getattr(config, name)) is not None
    }


def resolve(config_type: type[ConfigT], table: Mapping[str, Any], flags: Mapping[str, Any], toml: Path) -> ConfigT:
    """Merge default < `table` of `toml` < `flags` into a validated config.

    Relative paths in the table are relative to the folder of `toml`.

    Raises:
        InputError: an unknown key or a value out of range; names the file (or flag) and the key.
    """
    merged = {**_anchored(config_type, table, toml.parent), **flags}
    try:
        return config_type.model_validate(merged)
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else "?"
        from_file = key in table and key not in flags
        known = ", ".join(sorted(config_type.model_fields))
        hint = f"unknown key; known keys: {known}" if first["type"] == "extra_forbidden" else first["msg"]
        name = key if from_file else flag_name(config_type, key)
        raise InputError(hint, path=toml if from_file else None, field=name) from error


def load_toml(path: Path, stages: Mapping[str, type[StageConfig]]) -> dict[str, dict[str, Any]]:
    """Read `georef.toml` into a table for each stage; a missing file is an empty one.

    Raises:
        InputError: not TOML, or a table that names no stage.
    """
    if not path.exists():
        return {}
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"not valid TOML: {error}", path=path) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    for name, table in document.items():
        if name not in stages:
            raise InputError(f"unknown table; the stages are {', '.join(stages)}", path=path, field=name)
        if not isinstance(table, dict):
            raise InputError("expected a table of options", path=path, field=name)
    return document


def _is_input(info: FieldInfo) -> bool:
    """Whether a field is an `InputPath`, also where `InputPath | None` hides the marker in a union's member."""
    members = getattr(info.annotation, "__args__", ())
    marks = [*info.metadata, *(mark for member in members for mark in getattr(member, "__metadata__", ()))]
    return any(isinstance(mark, InputMarker) for mark in marks)


def _anchored(config_type: type[StageConfig], table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The table with its input paths made absolute."""
    fields = config_type.model_fields
    return {
        key: str(folder / value) if isinstance(value, str) and key in fields and _is_input(fields[key]) else value
        for key, value in table.items()
    }
