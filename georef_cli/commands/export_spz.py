"""Command `georef export-spz`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-spz",
    """Write the splat as SPZ, for viewers on the web.

    An SPZ file is a tenth of the PLY. Its axes are east, up and south in metres. FILE.georef.json beside it states
    the place of that frame on Earth, and its accuracy.

    \b
    Examples:
      georef export-spz flight
      georef export-spz flight --to splat.spz --spz-version 4
    """,
    delivers="file",
)
