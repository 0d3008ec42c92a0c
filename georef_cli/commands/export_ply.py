"""Command `georef export-ply`."""

from __future__ import annotations

from georef_cli.deliverable import DeliverableCommand

command = DeliverableCommand(
    "export-ply",
    """Write the splat as a PLY with its place on Earth.

    The PLY is in an East-North-Up frame in metres. FILE.georef.json beside it states the place of that frame on
    Earth, and its accuracy.

    \b
    Examples:
      georef export-ply flight
      georef export-ply flight --to splat.ply --min-opacity 0.02
      georef export-ply flight --measurable
    """,
)
