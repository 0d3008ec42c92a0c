"""Command `georef export-mesh`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-mesh",
    """Write the surface as a triangle mesh with texture (PLY, glTF, OBJ).

    The depth maps of the training views are averaged on a grid of voxels, and colours are those of the photographs.
    mesh.ply has coloured vertices, mesh.glb a texture. FILE.georef.json beside each states its place on Earth, its
    accuracy, and the error of the simplification.

    \b
    Examples:
      georef export-mesh flight
      georef export-mesh flight --voxel 0.1 --watertight --to flight.ply
      georef export-mesh flight --crs EPSG:25832 --vertical EPSG:7837 --obj
    """,
    delivers="file",
)
