"""Options of the report."""

from __future__ import annotations

from pydantic import Field

from pipelines.survey.options import CrsOptions


class ReportOptions(CrsOptions):
    """Options of the report of a survey."""

    crs: str | None = Field(
        None,
        description="CRS of the coordinates in the report: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. "
        "Without it: the UTM zone of the scene.",
    )
    pdf: bool = Field(False, description="Print report.pdf too; needs Chromium or Chrome.")
    chips: int = Field(4, ge=0, le=20, description="Number of image chips for each surveyed point.")
    views: int = Field(6, ge=0, le=50, description="Number of test views that are shown.")
