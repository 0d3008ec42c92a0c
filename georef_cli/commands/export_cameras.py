"""Command `georef export-cameras`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-cameras",
    """Write the trained cameras and lenses, placed on Earth.

    colmap/ and transforms.json (nerfstudio) are in the frame of splat.ply, as is undistorted/: photographs without
    lens distortion and their COLMAP model, for other trainers. cameras.csv has positions in the CRS of the
    contract, angles (omega phi kappa against grid north, yaw pitch roll against true north) and sigma.
    footprints.geojson shows on a map what each photograph shows.

    \b
    Examples:
      georef export-cameras flight
      georef export-cameras flight --crs EPSG:32632 --to handover/cameras
      georef export-cameras flight --undistorted --to trainer
    """,
    delivers="folder",
)
