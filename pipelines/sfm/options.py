"""Options of `georef sfm`, and of the adjustment with position priors."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pipelines.core.options import EFFORT, InputMarker, StageOptions
from pipelines.core.stages import SOLVED_PLACES

_DOUBLED_BELOW_PX = 1000
_SOLVED = frozenset({".bin", ".txt", ".json", ".geojson", ".opf", ".gltf", ".xml", ".csv"})
_BESIDE = (
    (".opf", ("**/*.json", "**/*.gltf", "**/*.bin")),
    (".json", ("tracks.csv",)),
    (".geojson", ("cameras.json", "../cameras.json")),
)
SolvedCamerasPath = Annotated[Path, InputMarker(_SOLVED, beside=_BESIDE)]


class SfmOptions(StageOptions):
    """Options of structure from motion with COLMAP.

    Which images are matched follows from their positions and view directions. Features and matches of a large
    survey are computed in chunks, as many at a time as cores and memory allow; a finished chunk is kept when the
    command is interrupted. The result is a COLMAP model, sfm/sparse, which COLMAP itself opens; --import takes
    the cameras that COLMAP, Metashape, PIX4Dmatic (OPF), OpenSfM, OpenDroneMap, nerfstudio or RealityScan has
    solved.

    Examples:
      georef sfm flight
      georef sfm flight --mapper global --max-image-size 1600
      georef sfm flight --import colmap/sparse/0
      georef sfm flight --import cameras.xml
      georef sfm flight --cluster tls://scheduler:8786 --certificates certificates
    """

    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="Mapper; auto: global for a large survey, incremental otherwise and where it fails."
    )
    camera_model: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"] = Field(
        "OPENCV", description="COLMAP camera model to estimate."
    )
    principal_point: bool = Field(True, description="Estimate the principal point, from 10 images on.")
    pairs: Literal["auto", "exhaustive"] = Field(
        "auto", description="Image pairs to match: from positions and view directions, or all."
    )
    max_neighbors: int = Field(16, ge=2, description="Largest number of neighbours that an image is matched with.")
    max_image_size: int = Field(1600, ge=128, description="Longest image side for features, in pixels.")
    doubled: Literal["auto", "yes", "no"] = Field(
        "auto",
        description="Detect features on photographs enlarged to twice their size, too; auto: on those below "
        f"{_DOUBLED_BELOW_PX} pixels.",
    )
    max_features: int = Field(5000, ge=200, description="Largest number of features of an image.")
    features: Literal["auto", "sift", "learned"] = Field(
        "auto",
        description="Features beside SIFT's; auto: learned ones for photographs that stay out, if installed; "
        "learned: for all pairs.",
    )
    import_model: SolvedCamerasPath | None = Field(
        None,
        description="Use the cameras that another program has solved: the folder of a COLMAP model, an OPF project "
        "(.opf), Metashape's cameras (XML), OpenSfM's or ODM's reconstruction.json, ODM's shots.geojson, "
        "nerfstudio's transforms.json, or RealityScan's CSV. Points are triangulated where the file has none.",
        json_schema_extra={"flag": "--import"},
    )
    earlier: Annotated[Path, InputMarker(first=SOLVED_PLACES)] | None = Field(
        None,
        description="Workspace of an earlier date, solved: tie this one to it by points in common, so that "
        "`georef change` needs no registration. It is only read.",
    )
    triangulate: bool = Field(
        False,
        description="Take the poses of the --import model alone, held fixed, and triangulate points from the "
        "photographs.",
    )
    adjust_imported: Literal["auto", "yes", "no"] = Field(
        "auto",
        description="Adjust the imported cameras by the tie points; auto: where that lowers their χ² by more than "
        "3 a parameter, but for COLMAP's models and with --triangulate.",
    )
    chunk_size: Annotated[int, EFFORT] = Field(
        200,
        ge=4,
        description="Photographs a chunk: features and matches of a larger survey are computed in chunks, "
        "several at a time.",
    )
    threads: Annotated[int, EFFORT] = Field(-1, ge=-1, description="Threads (-1: all).")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")

    @model_validator(mode="after")
    def _poses_to_triangulate(self) -> Self:
        if self.triangulate and self.import_model is None:
            raise ValueError("--triangulate takes the poses of --import, which is not given")
        if self.adjust_imported != "auto" and self.import_model is None:
            raise ValueError("--adjust-imported is for the cameras of --import, which is not given")
        return self

    def doubles(self, photo_px: tuple[int, int]) -> bool:
        """Return whether features are detected on photographs of this size doubled.

        Larger photographs have features enough. Without the doubling, detection takes a third of the time; up to
        a megapixel matching takes a quarter, because half as many features are found.
        """
        longest_px = min(max(photo_px), self.max_image_size)
        return self.doubled == "yes" or (self.doubled == "auto" and longest_px < _DOUBLED_BELOW_PX)

    def chunks(self, photographs: int) -> int:
        """Return the number of chunks of a survey; 1: it is worked in one process.

        It is even: two chunks of one size keep both cores of a small machine at work until the end.
        """
        return 1 if photographs <= self.chunk_size else 2 * -(-photographs // (2 * self.chunk_size))


class AdjustOptions(StageOptions):
    """Options of the bundle adjustment with the fixes as priors, the baseline of `georef compare`."""

    seed: int = Field(0, ge=0, description="Seed of every random choice.")
