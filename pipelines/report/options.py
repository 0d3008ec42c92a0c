"""Options of the report."""

from pydantic import Field

from pipelines.core.options import InputPath
from pipelines.survey.options import CrsOptions


class ReportOptions(CrsOptions):
    """Options of the report of a survey.

    A cover with names, logo, pictures and the facts of the survey; verdicts with their rules; accuracy, control and
    check points with cuts of the photographs, positions, overlap, lenses and test views; in an appendix, the
    processing. Options, hashes and warnings are folded, and not in the PDF. The page is one file and needs no
    network. It shows what was made: make rasters first, whose previews are on the cover.

    Examples:
      georef report flight
      georef report flight --pdf --crs EPSG:32632+3855
      georef report flight --pdf --title "Gravel pit" --client "City of X" --author "Y Survey" --logo logo.png
      georef report flight --to handover/report.html
    """

    crs: str | None = Field(
        None,
        description="CRS of the coordinates in the report: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. "
        "Without it: the UTM zone of the scene.",
    )
    title: str | None = Field(
        None, max_length=200, description="Title of the report. Without it: the name of the workspace's folder."
    )
    client: str = Field("", max_length=200, description="For whom the report is, on its cover.")
    author: str = Field("", max_length=200, description="Who made the survey, on the cover.")
    logo: InputPath | None = Field(None, description="PNG or JPEG file of a logo, on the cover; at most 4 MiB.")
    pdf: bool = Field(False, description="Print report.pdf too; needs Chromium or Chrome.")
    chips: int = Field(3, ge=0, le=20, description="Most image chips for each surveyed point.")
    views: int = Field(6, ge=0, le=50, description="Number of test views that are shown.")
