"""Command `georef export-raster`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-raster",
    """Write orthophoto, surface model (DSM) and their predicted σ as Cloud Optimized GeoTIFF in a CRS.

    The orthophoto is a true one: walls do not lean, because the Gaussians are rendered from straight above. Cells
    that the training views do not show have no value. FILE.georef.json beside each raster states CRS, datum of the
    heights and accuracy. hillshade.png and preview.png show surface and orthophoto.

    \b
    Examples:
      georef export-raster flight
      georef export-raster flight --crs EPSG:32632+3855 --gsd 0.05 --contours 1
      georef export-raster flight --to delivery/raster
    """,
    delivers="folder",
)
