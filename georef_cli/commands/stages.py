"""Commands of the stages that need no more than their options: what `--help` says of each below its title."""

from typing import Literal

import click

from georef_cli.command import Command
from georef_cli.options import FOLDER, flag
from georef_cli.stage import StageCommand

_HELP = {
    "ingest": """
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
    "geolocate": """
    Each point gets its own position, covariance, number of rays and intersection angle.

    \b
    Examples:
      georef geolocate flight
      georef geolocate flight --attitude sfm --min-angle 2
    """,
    "init-sim3": """
    The default is robust and weighted by the covariances of the measurements; --method paper is the plain
    least-squares estimate.

    \b
    Examples:
      georef init-sim3 flight
      georef init-sim3 flight --method paper
      georef init-sim3 flight --max-residual 5
    """,
    "train": """
    Interrupted with Ctrl-C it writes a checkpoint, and the next `georef train` goes on from there. Options that
    would drop an interrupted training are refused without --force. A finished training is extended by more
    --iterations.

    \b
    Examples:
      georef train flight --preset fast
      georef train flight --resume
      georef train flight --iterations 4000
      georef train flight --iterations 5000 --max-image-size 800 --backend cpu
    """,
    "clean": """
    Gaussians go that are too transparent, float before the surface or far from everything, or lie outside a crop.
    --gaussians keeps those that show most, merges the others into them, and fits them to the renders of the
    trained model. The PSNR of the test views is stated before and after. The files of the splat (PLY, SPZ, tiles)
    then take the cleaned model, as long as it was made from the trained one as it is; rasters, cloud and mesh keep
    the trained one.

    \b
    Examples:
      georef clean flight
      georef clean flight --gaussians 1500000
      georef clean flight --crop --sh-degree 1 --gaussians 500000
    """,
    "export-raster": """
    Cloud Optimized GeoTIFF in a CRS. The orthophoto is a true one, of the photographs themselves: walls do not
    lean. Cells that were not measured have no value, but for narrow holes. FILE.georef.json beside each raster
    states CRS, datum of the heights and accuracy. hillshade.png and preview.png show surface and orthophoto.

    \b
    Examples:
      georef export-raster flight
      georef export-raster flight --crs EPSG:32632+3855 --gsd 0.05 --contours 1
      georef export-raster flight --to delivery/raster
    """,
    "export-cloud": """
    The points come from the depths of the trained model that several training views agree on, one in each voxel,
    with colour, normal, and predicted horizontal and vertical σ. FILE.georef.json beside the cloud states its CRS,
    vertical datum and accuracy.

    \b
    Examples:
      georef export-cloud flight
      georef export-cloud flight --crs EPSG:32632+3855 --spacing 0.1 --to flight.laz
      georef export-cloud flight --crs EPSG:25832 --vertical EPSG:7837 --ply
    """,
    "export-mesh": """
    The surface goes through the points of the cloud and closes narrow gaps between them. Colours are those of the
    photographs: mesh.ply has coloured vertices with their σ, mesh.glb a texture. FILE.georef.json beside each
    states its place on Earth, its accuracy, the error of the simplification and the holes.

    \b
    Examples:
      georef export-mesh flight
      georef export-mesh flight --voxel 0.1 --watertight --to flight.ply
      georef export-mesh flight --crs EPSG:25832 --vertical EPSG:7837 --obj
    """,
    "export-spz": """
    An SPZ file is a tenth of the PLY. Its axes are east, up and south in metres. FILE.georef.json beside it states
    the place of that frame on Earth, and its accuracy.

    \b
    Examples:
      georef export-spz flight
      georef export-spz flight --to splat.spz --spz-version 4
    """,
    "export-tiles": """
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
    "export-html": """
    One file that any browser opens from the disk or from a mail, without a server and without a network: the splat,
    the cameras, control and check points, the measurements saved in `georef view`, accuracy and cautions. A splat
    too large for --max-megabytes is reduced, and the page says by how much.

    \b
    Examples:
      georef export-html flight
      georef export-html flight --to flight.html --max-megabytes 10
      georef export-html flight --crs EPSG:2056 --sh-degree 1
    """,
    "export-cameras": """
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
    "export-opf": """
    Open Photogrammetry Format 1.0: adjusted cameras and lenses, tie points, measured positions, control and check
    points with their marks. Put it beside the photographs, whose names it lists. Without --crs, its map is a
    projection around the scene that is true to scale there.

    \b
    Examples:
      georef export-opf flight
      georef export-opf flight --to handover/opf
      georef export-opf flight --crs EPSG:32632+3855
    """,
    "report": """
    A cover with names, logo, pictures and the facts of the survey; verdicts with their rules; accuracy, control and
    check points with cuts of the photographs, positions, overlap, lenses and test views; in an appendix, the
    processing. Options, hashes and warnings are folded, and not in the PDF. The page is one file and needs no
    network. It shows what was made: make rasters first, whose previews are on the cover.

    \b
    Examples:
      georef report flight
      georef report flight --pdf --crs EPSG:32632+3855
      georef report flight --pdf --title "Gravel pit" --client "City of X" --author "Y Survey" --logo logo.png
      georef report flight --to handover/report.html
    """,
    "change": """
    WS1 is the earlier epoch, WS2 the later one, which gets the folder change/: rasters of the difference of
    heights, its σ, its level of detection at 95 % and the significant change; regions with cut, fill and net volume
    ± σ as GeoJSON, GeoPackage and table; change.json. Both need the rasters of georef export-raster, in one --crs.

    Without registration, the σ of both adjustments counts, less what they share: control points of one name and
    place, and the base with --same-base. --stable FILE or --stable-auto registers the later epoch on unchanged
    ground; the shift is stated with its σ.

    \b
    Examples:
      georef change spring autumn
      georef change spring autumn --stable roads.geojson --regions stockpiles.gpkg
      georef change spring autumn --stable-auto --of terrain
    """,
}
_EXTRA = {"train": [flag("--resume", text="Continue the interrupted run; refuse other options.")]}
_BEFORE = {"change": click.Argument(["before"], type=FOLDER, metavar="WS1")}
_DELIVERS: dict[str, Literal["file", "folder"]] = {
    "export-raster": "folder",
    "export-cloud": "file",
    "export-mesh": "file",
    "export-spz": "file",
    "export-tiles": "folder",
    "export-html": "file",
    "export-cameras": "folder",
    "export-opf": "folder",
    "report": "file",
    "change": "folder",
}


def command(name: str) -> Command:
    """Return the command of a stage."""
    return StageCommand(
        name, _HELP[name], _EXTRA.get(name, ()), before=_BEFORE.get(name), delivers=_DELIVERS.get(name)
    )
