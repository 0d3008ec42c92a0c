"""Command `georef geolocate`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "geolocate",
    """Intersect every SfM point on Earth from the measured positions and attitudes.

    Each point gets its own position, covariance, number of rays and intersection angle.

    \b
    Examples:
      georef geolocate flight
      georef geolocate flight --attitude sfm --min-angle 2
    """,
)
