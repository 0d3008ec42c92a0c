"""Options of `georef evaluate`."""

from typing import Annotated, Literal

from pydantic import Field

from pipelines.core.options import ExtraMarker, InputPath
from pipelines.geodesy.vertical import Vertical
from pipelines.splat.rasterizer.choice import Backend
from pipelines.survey.options import CloudPath, FilledAreaOptions, MapOffset, UpAxis
from pipelines.survey.reference_comparison import Alignment


class EvaluateOptions(FilledAreaOptions):
    """Options of the evaluation with test views and check points.

    Without training, the cameras of init-sim3 are evaluated alone. Check points are triangulated (their marks
    intersected) and measured on the rendered surface (the depth of the Gaussians at the marks, not their
    centres), and stated as the ASPRS standard asks. The predicted accuracy over the scene is drawn in
    evaluate/accuracy.png. A survey without check points has --cross-validate: every control point measured by a
    solution that does not know it. The report is evaluate/report.json; evaluate/points.csv has the error of every
    point, and --points prints them.

    Examples:
      georef evaluate flight
      georef evaluate flight --renders 2 --json
      georef evaluate flight --points --crs EPSG:32632
      georef evaluate flight --cross-validate
      georef evaluate flight --reference scan.laz --reference-sigma 0.02
    """

    backend: Backend = Field("auto", description="Rasteriser.")
    renders: int = Field(8, ge=0, description="Largest number of side-by-side renders to write.")
    similarity: Literal["trained", "initial"] = Field(
        "trained", description="Similarity of the model: that of the training, or that of init-sim3."
    )
    crs: str | None = Field(
        None, description="List the check points in this CRS too, e.g. EPSG:32632, or EPSG:32632+5773 for heights."
    )
    tolerance_h: float | None = Field(
        None,
        gt=0,
        description="Required horizontal accuracy, as RMSE in metres: the report says whether it is met.",
    )
    tolerance_v: float | None = Field(
        None,
        gt=0,
        description="Required vertical accuracy, as RMSE in metres, of triangulated points and of the surface.",
    )
    lpips_weights: InputPath | None = Field(
        None, description="NPZ file of LPIPS (VGG) weights; without it LPIPS is null."
    )
    cross_validate: bool = Field(
        False, description="Leave out each control point in turn and measure it by a solution without it."
    )
    reference: Annotated[CloudPath, ExtraMarker("reference")] | None = Field(
        None,
        description="Compare the surface with this cloud (LAS, LAZ, E57, PLY) or mesh (PLY, OBJ, GLB), or a folder "
        "of them, where photographs saw it.",
    )
    reference_offset: MapOffset | None = Field(
        None,
        description="Easting, northing and height that are added to the coordinates of the reference's files, in "
        "their unit. It overrules what files beside a mesh state.",
    )
    reference_up: UpAxis | None = Field(
        None,
        description="Axis of a mesh's file that points up. Without it: y of GLB, as its standard says, z of "
        "PLY and OBJ.",
    )
    reference_crs: str | None = Field(
        None,
        description="CRS of the reference: EPSG:32632, or EPSG:32632+5773 for heights. It overrules the file's.",
    )
    reference_vertical: Vertical | None = Field(
        None,
        description="Datum of the reference's heights: ellipsoidal, EGM96 or EPSG:n. It overrules the file's.",
    )
    reference_sigma: float = Field(
        0.0,
        ge=0,
        le=100,
        description="σ of the reference's position in metres, part of the level of detection.",
    )
    reference_align: Alignment = Field(
        "none",
        description="Move the model onto the reference first, to compare the shape alone. The shift "
        "is stated in any case.",
    )
