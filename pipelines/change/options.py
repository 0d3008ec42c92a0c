"""Options of `georef change`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from pipelines.core.options import ExtraMarker, InputMarker, StageOptions
from pipelines.core.stages import CHANGE, MEASURED
from pipelines.survey.options import BOUNDARY_SUFFIXES

# Of the earlier epoch, the same products decide as of the later one.
COMPARED = frozenset(part.product for part in CHANGE.reads if part is not MEASURED)
PolygonFile = Annotated[Path, InputMarker(BOUNDARY_SUFFIXES), ExtraMarker("vectors")]


class ChangeOptions(StageOptions):
    """Options of the comparison of two epochs. `before` is the workspace of the earlier one.

    WS1 is the earlier epoch, WS2 the later one, which gets the folder change/: rasters of the difference of
    heights, its σ, its level of detection at 95 % and the significant change; regions with cut, fill and net volume
    ± σ as GeoJSON, GeoPackage and table; change.json. Both need the rasters of georef export-raster, in one --crs.

    Without registration, the σ of both adjustments counts, less what they share: control points of one name and
    place, and the base with --same-base. --stable FILE or --stable-auto registers the later epoch on unchanged
    ground; the shift is stated with its σ. Dates that were adjusted onto each other (--earlier of sfm) need none;
    of a chain of them, the volumes are stated at each date between both.

    Examples:
      georef change spring autumn
      georef change spring autumn --stable roads.geojson --regions stockpiles.gpkg
      georef change spring autumn --stable-auto --of terrain
    """

    before: Annotated[Path, InputMarker(only=COMPARED)] = Field(
        Path(), description="Workspace of the earlier epoch."
    )
    of: Literal["surface", "terrain"] = Field(
        "surface",
        description="Compare surface models (DSM), or the ground alone (DTM, --terrain of export-raster).",
    )
    stable: PolygonFile | None = Field(
        None,
        description="Polygons of unchanged ground, on which the later epoch is registered. Without registration, "
        "the datum's σ of both adjustments counts.",
    )
    stable_auto: bool = Field(
        False, description="Register on the ground that most cells agree on, where it is not known."
    )
    tilt: bool = Field(False, description="Estimate a tilt too, with --stable or --stable-auto.")
    same_base: bool = Field(
        False, description="One base station with the same coordinates served both flights: its error cancels."
    )
    boundary: PolygonFile | None = Field(
        None, description="Polygon of the area to compare. Without it: all that both epochs measure."
    )
    regions: PolygonFile | None = Field(
        None, description="Polygons whose volumes are wanted, beside the regions that are found."
    )
    polygons_crs: str | None = Field(
        None, description="CRS of the polygons, as a DXF needs one: EPSG:32632 or another. It overrules the file's."
    )
    along_normals: bool = Field(
        False,
        description="Measure change along the normals too, for walls and slopes (M3C2), from the clouds of both.",
    )
    reach: float = Field(1.0, gt=0, le=50, description="Largest change along a normal that is found, in metres.")
    min_area: float = Field(1.0, gt=0, description="Area of the smallest region in square metres.")

    @property
    def is_registered(self) -> bool:
        """Whether the later epoch is registered on unchanged ground."""
        return self.stable is not None or self.stable_auto
