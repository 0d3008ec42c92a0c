"""Command `georef init-sim3`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "init-sim3",
    """Estimate the similarity from the SfM model to the Earth.

    The default is robust and weighted by the covariances of the measurements; --method paper is the plain
    least-squares estimate.

    \b
    Examples:
      georef init-sim3 flight
      georef init-sim3 flight --method paper
      georef init-sim3 flight --max-residual 5
    """,
)
