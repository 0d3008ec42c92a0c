"""Command `georef export-tiles`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-tiles",
    """Write the splat as 3D Tiles, for web globes such as CesiumJS.

    The folder is ready for a web server: tileset.json with levels of detail in Earth-centred coordinates, its
    contents, splat.glb, the whole splat in one file, and index.html, which shows the tiles in CesiumJS. The files
    *.georef.json state the place on Earth and its accuracy.

    \b
    Examples:
      georef export-tiles flight
      georef export-tiles flight --to www/flight --max-tile-gaussians 100000
      georef export-tiles flight --compression none --archive --to plain
      georef export-tiles flight --crs EPSG:2056 --cesium Cesium/
    """,
    delivers="folder",
)
