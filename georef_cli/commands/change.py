"""Command `georef change`."""

import click

from georef_cli.options import FOLDER
from georef_cli.stage import StageCommand

command = StageCommand(
    "change",
    """Compare two surveys of one place: what changed, by how much, and whether it is real.

    WS1 is the earlier epoch, WS2 the later one, which gets the folder change/: rasters of the difference of
    heights, its σ, its level of detection at 95 % and the significant change; regions with cut, fill and net volume
    ± σ as GeoJSON, GeoPackage and table; change.json. Both need the rasters of georef export-raster, in one --crs.

    Without registration, the σ of both adjustments counts, less what they share: control points of one name and
    place, and the base with --same-base. --stable FILE or --stable-auto registers the later epoch on unchanged
    ground; the shift is stated with its σ.

    \b
    Examples:
      georef change spring autumn
      georef change spring autumn --stable roads.geojson --regions stockpiles.gpkg
      georef change spring autumn --stable-auto --of terrain
    """,
    before=click.Argument(["before"], type=FOLDER, metavar="WS1"),
    delivers="folder",
)
