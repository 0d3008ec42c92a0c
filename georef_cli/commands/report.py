"""Command `georef report`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "report",
    """Write the report of the survey: one page with all that is known of it, and its PDF with --pdf.

    Verdicts with their reasons, place on Earth, accuracy, control and check points with image chips, positions and
    residuals of the photographs, overlap, lenses, test views, training, options and versions. The page is one file
    and needs no network. It shows what was made: make rasters first if their previews belong into it.

    \b
    Examples:
      georef report flight
      georef report flight --pdf --crs EPSG:32632+3855
      georef report flight --to handover/report.html
    """,
    delivers="file",
)
