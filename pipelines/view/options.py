"""Options of the viewer."""

from pydantic import Field

from pipelines.core.options import StageOptions
from pipelines.splat.rasterizer.choice import Backend
from pipelines.survey.options import CrsOptions


class ViewOptions(CrsOptions):
    """Options of the viewer."""

    crs: str | None = Field(
        None,
        description="CRS of the coordinates: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. Without it: the "
        "UTM zone of the scene.",
    )
    port: int = Field(
        8080, ge=1024, le=65000, description="Port on this machine; if it is taken, the next free one."
    )
    backend: Backend = Field("auto", description="Rasteriser that draws the pictures.")


class ProposalOptions(StageOptions):
    """Options of proposed marks."""

    reach: float = Field(
        24.0, gt=0, le=200, description="How far from its expected pixel a target may be, in pixels."
    )
