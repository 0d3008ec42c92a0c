"""Command `georef ingest`."""

from georef_cli.stage import StageCommand

command = StageCommand(
    "ingest",
    """Read photographs, positions, attitudes and control points into one survey.

    Positions come from the photographs' EXIF and XMP, or from a trajectory (CSV, RTKLIB, DJI, Metashape) or an ODM
    geo.txt; or photographs and positions come from a ROS bag. Photographs in a folder are referenced where they
    are, unless --copy. Check points never enter any solve. Points without marks are listed for marking later.

    \b
    Examples:
      georef ingest flight --images photos
      georef ingest flight --images photos --gcp gcp_list.txt --check P7 --check P9
      georef ingest flight --images photos --trajectory track.csv --crs EPSG:32632 --vertical EGM2008
      georef ingest flight --images photos --trajectory flight_Timestamp.MRK --gcp markers.xml
      georef ingest flight --images photos --gcp gcps.csv --gcp-crs EPSG:2056+5728 --marks marks.csv
      georef ingest flight --bag flight_bag --every 5m --camera-mount 0,-90,0
      georef ingest flight --images photos --geo geo.txt --checkpoints checkpoints.txt --test-every 10
    """,
)
