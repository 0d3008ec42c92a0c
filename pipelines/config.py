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

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from pipelines.errors import InputError

CONFIG_FILE = "georef.toml"


class InputMarker:
    """Marks a path whose content decides the stage's result: its fingerprint enters the manifest."""


InputPath = Annotated[Path, InputMarker()]


class StageConfig(BaseModel):
    """Base of all stage options: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class IngestConfig(StageConfig):
    """What `georef ingest` reads, and what it assumes where the files are silent."""

    images: InputPath | None = Field(None, description="Folder of photographs.")
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
        None, description="TorchScript file of LPIPS weights (without it LPIPS is null)."
    )


class ExportPlyConfig(StageConfig):
    """The splat as a 3DGS PLY with its sidecar."""

    min_opacity: float = Field(0.005, ge=0, lt=1, description="Leave out Gaussians that are less opaque.")


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
