"""Options of `georef train`: of Gaussians, geographic losses, LiDAR, blocks and the run, with presets of effort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from pipelines.core.errors import InputError
from pipelines.core.options import HIDDEN, WRITTEN, InputPath, StageOptions, flag_name, from_text
from pipelines.geodesy.vertical import Vertical
from pipelines.splat.rasterizer.choice import Backend
from pipelines.survey.options import AreaOptions, MapOffset, MeasuredPath, UpAxis


@dataclass(frozen=True)
class Preset:
    """Effort of a training; photographs have `max_image_size` pixels on their longest side."""

    iterations: int
    max_image_size: int
    max_gaussians: int

    def __str__(self) -> str:
        return f"{self.iterations} iterations, {self.max_image_size} px, {self.max_gaussians} Gaussians"


PRESETS = {
    "smoke": Preset(200, 320, 20_000),
    "fast": Preset(800, 480, 80_000),
    "standard": Preset(1_500, 800, 150_000),
    "high": Preset(2_000, 2_000, 300_000),
}
# Iterations and Gaussians grow with the photographs beyond this number: a place is seen as often, on a larger area.
PRESET_PHOTOGRAPHS = 100
# Iterations for each photograph at most: in wind, more of them fit the moment of each photograph, and other
# views get worse (examples/benchmarks/results/training.md, Presets at one size of picture).
MOST_LOOKS = 30


def surveys_of(photographs: int) -> float:
    """Return how many surveys of the presets' number of photographs so many photographs are, at least one."""
    return max(photographs / PRESET_PHOTOGRAPHS, 1.0)


# Of `georef run` with 48 photographs of a megapixel, kernels compiled, on 2 idle cores of an AMD EPYC
# (examples/benchmarks/results/training.md, Presets).
RUN_MINUTES = {"smoke": 1, "fast": 2, "standard": 4, "high": 10}


_EFFORTS = "; ".join(f"{name}: {preset}, about {RUN_MINUTES[name]} min" for name, preset in PRESETS.items())
LidarLoss = Literal["depth", "gaussians", "both"]


DepthAlong = Literal["axis", "ray"]
_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}


def _unit(text: str) -> float:
    if text.strip().lower() in _UNITS_M:
        return _UNITS_M[text.strip().lower()]
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is none of {', '.join(_UNITS_M)}, and no number of metres") from None


def _four(text: str) -> tuple[float, ...]:
    parts = text.split(",")
    if len(parts) != 4:
        raise ValueError(f"{text!r} is not four numbers with commas: fx,fy,cx,cy")
    return tuple(float(part) for part in parts)


def _positive_focal(camera: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if not (camera[0] > 0 and camera[1] > 0):
        raise ValueError("fx and fy must be positive")
    return camera


DepthUnit = Annotated[float, from_text(_unit), Field(gt=0, le=1000), WRITTEN]
DepthCamera = Annotated[
    tuple[float, float, float, float], from_text(_four), AfterValidator(_positive_focal), WRITTEN
]


# Options that belong to one kind of measured geometry.
_OF_CLOUDS = ("lidar_crs", "lidar_vertical", "lidar_offset", "lidar_up", "lidar_trajectory", "lidar_register")
_OF_DEPTHS = ("depth_unit", "depth_along", "depth_camera")
_OF_LIDAR = (*_OF_CLOUDS, *_OF_DEPTHS)


def _flags(names: Sequence[str]) -> str:
    return ", ".join(flag_name(LidarOptions, name) for name in names)


class LidarOptions(StageOptions):
    """Options of a LiDAR cloud: where it lies, how accurate it is, and how training uses it."""

    lidar: MeasuredPath | None = Field(
        None,
        description="Measured geometry of the same place, for the surface: a cloud (LAS, LAZ, E57, PLY) or a mesh "
        "(PLY, OBJ, GLB), or a folder of such files; or a folder of depth maps of the photographs (PNG, TIFF, "
        "EXR).",
    )
    lidar_offset: MapOffset | None = Field(
        None,
        description="Easting, northing and height that are added to the coordinates of the LiDAR's files, in their "
        "unit. It overrules what files beside a mesh state.",
    )
    lidar_up: UpAxis | None = Field(
        None,
        description="Axis of a mesh's file that points up. Without it: y of GLB, as its standard says, z of "
        "PLY and OBJ.",
    )
    lidar_crs: str | None = Field(None, description="CRS of the LiDAR. It overrules what its files state.")
    lidar_vertical: Vertical | None = Field(
        None, description="Datum of the LiDAR's heights. It overrules what its files state."
    )
    lidar_trajectory: InputPath | None = Field(
        None,
        description="Trajectory of the LiDAR's scanner, on the clock of its points: CSV with timestamp, latitude, "
        "longitude, altitude.",
    )
    lidar_sigma: float = Field(0.03, gt=0, le=10, description="Stated σ of the LiDAR's points in metres.")
    lidar_loss: LidarLoss = Field(
        "both",
        description="Losses of the LiDAR: on rendered depth, on distances of Gaussians from its planes, or both.",
    )
    lidar_register: bool = Field(False, description="Estimate a shift of the LiDAR and remove it.")
    lidar_held_out: float = Field(
        0.05,
        ge=0,
        le=0.5,
        description="Share of the LiDAR that is held out of the training, in whole squares of the plan, always the "
        "same: by it `georef evaluate` measures the surface. 0: none.",
    )
    depth_unit: DepthUnit | None = Field(
        None,
        description="Unit of depth maps, which need it: m, cm, mm, ft, or the metres of a value of 1, such as "
        "0.0002.",
    )
    depth_along: DepthAlong | None = Field(
        None,
        description="Whether depths of depth maps count along the optical axis or along the ray of each pixel. "
        "Without it: what fits the depths of stereo.",
    )
    depth_camera: DepthCamera | None = Field(
        None,
        description="Camera of the depth maps where they do not show the photographs' own pixels: fx,fy,cx,cy in "
        "pixels of the maps, whose first has its centre at 0.5,0.5. Place and axes are the photograph's.",
    )

    @model_validator(mode="after")
    def _used(self) -> LidarOptions:
        given = [flag for flag in _OF_LIDAR if getattr(self, flag)]
        if self.lidar is None and given:
            raise ValueError(f"{_flags(given)} {'belong' if len(given) > 1 else 'belongs'} to --lidar")
        return self

    def require_kind(self, *, depths: bool) -> None:
        """Raise an InputError for options that do not belong to depth maps, or to clouds and meshes."""
        wrong = [flag for flag in (_OF_CLOUDS if depths else _OF_DEPTHS) if getattr(self, flag)]
        if wrong:
            what = "depth maps, which lie in the frame of the photographs" if depths else "clouds and meshes"
            raise InputError("option-of-another-kind", f"{_flags(wrong)}: not for {what}.", field=_flags(wrong[:1]))
        if depths and self.depth_unit is None:
            message = (
                "Depth maps have no unit of their own: give --depth-unit mm, m, or the metres of a value of 1."
            )
            raise InputError("depth-unit-unknown", message, path=self.lidar, field="--depth-unit")


class GeographicOptions(StageOptions):
    """Options of the geographic losses."""

    georeference: Literal["frozen", "joint", "paper"] = Field(
        "frozen",
        description="Similarity and cameras: frozen at the solution of init-sim3; refined with the Gaussians and "
        "held to that solution by its covariance; or refined with the plain mean squares of the paper.",
    )
    gcp_mode: Literal["triangulated", "depth"] = Field(
        "triangulated",
        description="Position of control points: triangulated from marks, or from the rendered depth.",
    )
    gcp_loss: Annotated[bool, HIDDEN] = Field(True, description="Use the control points.")
    distance_loss: Annotated[bool, HIDDEN] = Field(
        True, description="Use the loss of distances between pairs of points, L_rel."
    )

    def refined_cameras(self, cameras: int) -> int:
        """Return how many of that many cameras are refined together with the Gaussians: all or none."""
        return 0 if self.georeference == "frozen" else cameras


class LossOptions(StageOptions):
    """Weights of the losses that the user decides."""

    geo_weight: float = Field(0.05, gt=0, description="Final weight of the geographic losses (w_max of eq. 27).")
    geo_schedule: Annotated[Literal["rising", "constant"], HIDDEN] = Field(
        "rising", description="Weight of the geographic losses: rising as in eq. 27, or constant."
    )


class GaussianOptions(StageOptions):
    """Options of the Gaussians: effort, backend, density control, exposure and surface."""

    preset: Literal["smoke", "fast", "standard", "high"] = Field(
        "standard",
        description=f"Effort. {_EFFORTS} (for 48 photographs on 2 cores). Beyond {PRESET_PHOTOGRAPHS} photographs "
        f"iterations and Gaussians grow in proportion; no photograph has more than {MOST_LOOKS} iterations.",
    )
    iterations: int | None = Field(None, ge=1, description="Iterations (default: by preset and photographs).")
    max_image_size: int | None = Field(
        None, ge=32, description="Longest image side for training in pixels (default: the preset's)."
    )
    crop_size: int = Field(
        1400,
        ge=32,
        description="Side of crops in pixels: a photograph with more pixels than such a square is trained in "
        "crops of its area.",
    )
    max_gaussians: int | None = Field(None, ge=100, description="Limit of Gaussians (default: likewise).")
    backend: Backend = Field("auto", description="Rasteriser.")
    sh_degree: int = Field(3, ge=0, le=3, description="Degree of the spherical harmonics.")
    strategy: Literal["default", "mcmc", "fast"] = Field(
        "default", description="Densification: as in 3DGS, by MCMC, or by errors in several views (fast)."
    )
    mip_filter: bool = Field(
        False,
        description="Let opacities make up for the dilation of small Gaussians, so that the model keeps its look "
        "zoomed out; viewers must know it.",
    )
    coarse_to_fine: bool = Field(True, description="Start with photographs of lower resolution.")
    exposure: bool = Field(True, description="Fit the exposure of each training photograph.")
    robust_photometric: bool = Field(
        False, description="Mask outliers of the photometric loss: moving cars, shadows."
    )
    dense: bool = Field(True, description="Initialise the Gaussians from dense multi-view stereo.")
    geometry_regularisation: bool = Field(
        True,
        description="Use depth and normal losses, for a surface to measure on.",
    )

    @property
    def effort(self) -> Preset:
        """Effort of the preset, with the values that the user set instead."""
        preset = PRESETS[self.preset]
        return Preset(
            self.iterations or preset.iterations,
            self.max_image_size or preset.max_image_size,
            self.max_gaussians or preset.max_gaussians,
        )


class BlockOptions(StageOptions):
    """Options of a training in blocks."""

    blocks: int | None = Field(
        None,
        ge=1,
        description="Train in so many blocks (default: one run, or as many blocks as needed to fit into memory). "
        "Iterations are those of each block, the limit of Gaussians is that of the whole.",
    )
    block_overlap: float = Field(
        0.15, ge=0, le=1, description="Overlap of blocks on each side, as a share of a block's width."
    )
    block_memory: float | None = Field(
        None, gt=0, description="Memory of a worker in GiB, for the number of blocks (default: what is free here)."
    )


class PlanOptions(BlockOptions):
    """Options of the plan of the blocks, with the effort that a preset stands for."""

    max_gaussians: int = Field(ge=1)
    max_image_size: int = Field(ge=1)
    sh_degree: int = Field(ge=0, le=3)


class TrainOptions(LossOptions, GeographicOptions, GaussianOptions, BlockOptions, LidarOptions, AreaOptions):
    """Options of the training of Gaussians, and on request of similarity and cameras with them.

    Interrupted with Ctrl-C, training writes a checkpoint, and the next `georef train` goes on from there. Options
    that would drop an interrupted training are refused without --force. A finished training is extended by more
    --iterations.

    A survey that does not fit into memory, or with --blocks, is trained in blocks: processes of their own, as many
    at a time as memory and cores allow, or on the workers of --cluster. Finished blocks are kept, and their models
    become one. `--part plan` only divides the survey, and shows the blocks.

    Examples:
      georef train flight --preset fast
      georef train flight --resume
      georef train flight --iterations 4000
      georef train flight --iterations 5000 --max-image-size 800 --backend cpu
      georef train town --part plan --preset high --max-gaussians 20000000 --block-memory 16
      georef train town --blocks 16 --cluster tls://10.0.0.1:8786 --certificates certificates
    """

    checkpoint_every: int = Field(500, ge=1, description="Iterations between checkpoints.")
    log_every: int = Field(10, ge=1, description="Iterations between lines of metrics.jsonl.")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")

    @model_validator(mode="after")
    def _depth_needs_cameras_that_move(self) -> TrainOptions:
        if self.gcp_mode == "depth" and self.georeference == "frozen":
            raise ValueError("--gcp-mode depth moves the cameras: it needs --georeference joint or paper")
        return self

    @model_validator(mode="after")
    def _lidar_needs_a_surface(self) -> TrainOptions:
        if self.lidar is not None and not (self.dense and self.geometry_regularisation):
            raise ValueError(
                "--lidar needs the surface of the photographs: use --dense and --geometry-regularisation"
            )
        return self


class SolutionOptions(StageOptions):
    """Options of the solution that all blocks share; photographs of `max_image_size` pixels give the exposures."""

    max_image_size: int = Field(ge=1)
    exposure: bool = True


class SeamOptions(TrainOptions):
    """Options of the training across the seams of blocks whose Gaussians have these SHA-256, by their numbers."""

    trained: tuple[str, ...] = ()


class BlockTrainOptions(TrainOptions):
    """Options of the training of the block with a number in the plan."""

    id: int = Field(ge=0)
