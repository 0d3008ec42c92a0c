"""Command `georef sfm`."""

from __future__ import annotations

from georef_cli.stage import StageCommand

command = StageCommand(
    "sfm",
    """Reconstruct cameras and points with COLMAP.

    Which images are matched follows from their positions and view directions. The result is a COLMAP model,
    sfm/sparse, which COLMAP itself opens; --import takes a model that was made elsewhere.

    \b
    Examples:
      georef sfm flight
      georef sfm flight --mapper global --max-image-size 1600
      georef sfm flight --import colmap/sparse/0
    """,
)
