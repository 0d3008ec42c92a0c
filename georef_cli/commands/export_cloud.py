"""Command `georef export-cloud`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-cloud",
    """Write the surface as a georeferenced point cloud (LAZ).

    The points come from the depths of the trained model that several training views agree on, one in each voxel,
    with colour, normal, and predicted horizontal and vertical σ. FILE.georef.json beside the cloud states its CRS,
    vertical datum and accuracy.

    \b
    Examples:
      georef export-cloud flight
      georef export-cloud flight --crs EPSG:32632+3855 --spacing 0.1 --to flight.laz
      georef export-cloud flight --crs EPSG:25832 --vertical EPSG:7837 --ply
    """,
    delivers="file",
)
