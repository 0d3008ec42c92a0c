"""Command `georef report`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "report",
    """Write the report of the survey for a client: one page with all that is known of it, and its PDF with --pdf.

    A cover with names, logo, pictures and the facts of the survey; verdicts with their rules; accuracy, control and
    check points with cuts of the photographs, positions, overlap, lenses and test views; in an appendix, the
    processing. Options, hashes and warnings are folded, and not in the PDF. The page is one file and needs no
    network. It shows what was made: make rasters first, whose previews are on the cover.

    \b
    Examples:
      georef report flight
      georef report flight --pdf --crs EPSG:32632+3855
      georef report flight --pdf --title "Gravel pit" --client "City of X" --author "Y Survey" --logo logo.png
      georef report flight --to handover/report.html
    """,
    delivers="file",
)
