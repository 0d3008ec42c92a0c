"""Command `georef export-mesh`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "export-mesh",
    """Write the surface as a triangle mesh with texture (PLY, glTF, OBJ).

    The surface goes through the points of the cloud and closes narrow gaps between them. Colours are those of the
    photographs: mesh.ply has coloured vertices with their σ, mesh.glb a texture. FILE.georef.json beside each
    states its place on Earth, its accuracy, the error of the simplification and the holes.

    \b
    Examples:
      georef export-mesh flight
      georef export-mesh flight --voxel 0.1 --watertight --to flight.ply
      georef export-mesh flight --crs EPSG:25832 --vertical EPSG:7837 --obj
    """,
    delivers="file",
)
