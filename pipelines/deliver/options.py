"""Options of the deliverables."""

from __future__ import annotations

from pydantic import Field

from pipelines.core.options import StageOptions


class ExportPlyOptions(StageOptions):
    """Options of the export of the splat as a 3DGS PLY with its sidecar."""

    min_opacity: float = Field(0.005, ge=0, lt=1, description="Leave out Gaussians that are less opaque.")
