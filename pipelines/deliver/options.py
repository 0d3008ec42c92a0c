"""Options of the deliverables."""

from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from pipelines.core.extras import require
from pipelines.core.options import ExtraMarker, NeedMarker
from pipelines.survey.options import CropOptions, CrsOptions, FilledAreaOptions

# The page was tried with this version: the extensions of splats in glTF are younger than those of meshes.
CESIUM = "https://cesium.com/downloads/cesiumjs/releases/1.145/Build/Cesium/"

# Of the contents of tiles.
Compression = Literal["spz", "none"]


class SplatOptions(CropOptions):
    """Options of every file that holds the Gaussians of the model, cleaned or as trained."""

    trained: bool = Field(
        False,
        description="Take the trained model, even if `georef clean` has made another of it, which the files of the "
        "splat take otherwise.",
    )


class PlyOptions(CropOptions):
    """Options of every PLY of the splat."""

    up: Literal["z", "y", "-y"] = Field(
        "z",
        description="Axis of the file that points up; x points east. z: East-North-Up; y: as in glTF and three.js; "
        "-y: as SuperSplat takes a PLY.",
    )


class ExportPlyOptions(PlyOptions, SplatOptions):
    """Options of the export of the splat as a 3DGS PLY with its sidecar.

    The PLY is in an East-North-Up frame in metres; --up turns it for viewers whose y axis points up or down.
    FILE.georef.json beside it states the place of the file's frame on Earth, and its accuracy.

    --measurable writes a second file beside the first, measurable/splat.measurable.ply, for viewers that measure by
    the centres of Gaussians: small discs on the surface replace the Gaussians about it. It is several times larger
    and looks a little worse. Its options in georef.toml are those of [export-measurable].

    Examples:
      georef export-ply flight
      georef export-ply flight --to splat.ply --min-opacity 0.02
      georef export-ply flight --up -y --to supersplat.ply
      georef export-ply flight --measurable
    """


class MeasurableOptions(PlyOptions):
    """Options of the export of the splat with discs on its surface, as a PLY of its own."""

    disc_spacing: float | None = Field(
        None,
        ge=0.001,
        description="With --measurable: metres between discs (default: 0.7 of the width of a pixel of the training "
        "photographs on the ground).",
    )
    appearance_passes: int | None = Field(
        None,
        ge=0,
        le=1000,
        description="With --measurable: passes over the training views of the appearance refinement, which fits "
        "the colours of the discs (default: as many as show a disc 150 times, from 1 to 7).",
    )


class WebSplatOptions(SplatOptions):
    """Options of the compressed forms of the splat."""

    sh_degree: int | None = Field(
        None,
        ge=0,
        le=3,
        description="Degree of the spherical harmonics in the file: a lower one makes it smaller. Without it: that "
        "of the model.",
    )


class ExportSpzOptions(WebSplatOptions):
    """Options of the export of the splat as SPZ with its sidecar.

    An SPZ file is a tenth of the PLY. Its axes are east, up and south in metres. FILE.georef.json beside it states
    the place of that frame on Earth, and its accuracy.

    Examples:
      georef export-spz flight
      georef export-spz flight --to splat.spz --spz-version 4
    """

    spz_version: Literal["3", "4"] = Field(
        "3", description="Version of the format: CesiumJS and Spark read 3, PlayCanvas reads 4 only."
    )
    embed_georeference: bool = Field(
        False,
        description="With --spz-version 4, experimental: write the place on Earth into the file itself too, in the "
        "form that the authors of SPZ propose. It may change until they have decided.",
    )


class ExportSogOptions(WebSplatOptions):
    """Options of the export of the splat as streamed SOG with its sidecar.

    The folder is ready for a web server: lod-meta.json and the pictures of each level of detail, as viewers of
    PlayCanvas stream them. Its axes are east, down and north in metres. lod-meta.json.georef.json states the place
    of that frame on Earth, and its accuracy.

    Examples:
      georef export-sog flight
      georef export-sog flight --to www/flight --sh-degree 1
    """

    up: Literal["-y", "y"] = Field(
        "-y",
        description="Axis of the files that points up; x points east. -y: as SuperSplat and the PlayCanvas viewer "
        "take SOG; y: for programs that do not turn it.",
    )


def _require_copc(copc: bool) -> None:
    if copc:
        require("copc")


class TerrainOptions(FilledAreaOptions):
    """Options of everything that tells the ground from what stands on it, in the area of interest."""

    terrain: bool = Field(
        True, description="Tell the ground from what stands on it (dtm.tif, contours, classes of the cloud)."
    )


class ExportRasterOptions(CrsOptions, TerrainOptions):
    """Options of the export of orthophoto, surface model, σ and contours.

    Cloud Optimized GeoTIFF in a CRS. The orthophoto is a true one, of the photographs themselves: walls do not
    lean. Cells that were not measured have no value, but for narrow holes. FILE.georef.json beside each raster
    states CRS, datum of the heights and accuracy. hillshade.png and preview.png show surface and orthophoto.

    Examples:
      georef export-raster flight
      georef export-raster flight --crs EPSG:32632+3855 --gsd 0.05 --contours 1
      georef export-raster flight --to delivery/raster
    """

    gsd: float | None = Field(
        None,
        gt=0,
        description="Size of a cell in units of the CRS. Without it: the ground sample distance of the "
        "photographs.",
    )
    contours: Annotated[float, ExtraMarker("vectors")] | None = Field(
        None, gt=0, description="Interval of contour lines, in the unit of the heights."
    )
    contours_of: Literal["terrain", "surface"] = Field(
        "terrain", description="Draw the contour lines of the ground, or of everything that stands on it."
    )
    min_views: int = Field(
        3, ge=2, description="Number of training views that must show a cell's surface; others are interpolated."
    )
    colours: Literal["photographs", "splat"] = Field(
        "photographs",
        description="Colours of the orthophoto: of the photographs, at their own resolution, or of the splat. What "
        "no photograph sees has the splat's.",
    )
    source: bool = Field(False, description="Write source.tif: which photograph the detail of each cell is from.")
    bands: bool = Field(
        False,
        description="Write bands.tif: a band of each lens of a multispectral rig (`ingest --sensor all`), or the "
        "temperatures of a thermal camera, from its own photographs in full depth.",
    )
    max_pixels: float = Field(1e9, gt=0, description="Refuse a raster with more cells.")
    hillshade: bool = Field(True, description="Draw hillshade.png and preview.png.")


class ExportCloudOptions(CrsOptions, TerrainOptions):
    """Options of the export of the surface as a point cloud.

    The points come from the depths of the trained model that several training views agree on, one in each voxel,
    with colour, normal, and predicted horizontal and vertical σ. FILE.georef.json beside the cloud states its CRS,
    vertical datum and accuracy.

    Examples:
      georef export-cloud flight
      georef export-cloud flight --crs EPSG:32632+3855 --spacing 0.1 --to flight.laz
      georef export-cloud flight --crs EPSG:25832 --vertical EPSG:7837 --ply
    """

    spacing: float | None = Field(
        None,
        ge=0.001,
        description="Side of the voxels that hold one point each, in metres (default: the width of a pixel of the "
        "training photographs on the ground).",
    )
    min_views: int = Field(3, ge=2, description="Number of training views that must agree on a point.")
    ply: bool = Field(False, description="Write the same points as cloud.ply too.")
    copc: Annotated[bool, NeedMarker(_require_copc)] = Field(
        False,
        description="Write the same points as cloud.copc.laz too: a Cloud Optimized Point Cloud, of which viewers "
        "on the web load what they show. Its making holds all points in memory.",
    )


class ExportMeshOptions(CrsOptions, FilledAreaOptions):
    """Options of the export of the surface as a mesh.

    The surface goes through the points of the cloud and closes narrow gaps between them. Colours are those of the
    photographs: mesh.ply has coloured vertices with their σ, mesh.glb a texture. FILE.georef.json beside each
    states its place on Earth, its accuracy, the error of the simplification and the holes.

    Examples:
      georef export-mesh flight
      georef export-mesh flight --voxel 0.1 --watertight --to flight.ply
      georef export-mesh flight --crs EPSG:25832 --vertical EPSG:7837 --obj
    """

    crs: str | None = Field(
        None,
        description="Write mesh_crs.ply too, in this CRS: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT.",
    )
    voxel: float | None = Field(
        None,
        ge=0.001,
        description="Spacing in metres of the measured points that the surface goes through, and of its octree's "
        "finest cells, within a factor of two (default: the width of a pixel of the training photographs on the "
        "ground).",
    )
    min_views: int = Field(3, ge=2, description="Number of training views that must agree on a measured point.")
    simplify_error: float | None = Field(
        None,
        ge=0,
        description="Metres by which the simplification may move the surface; 0: none (default: half a voxel).",
    )
    least_part: float | None = Field(
        None,
        ge=0,
        description="Leave out unconnected parts with less area, in m² (default: 4, or 100 squares of a voxel).",
    )
    watertight: bool = Field(
        False, description="Close the mesh: holes by fans, outer rims by plumb walls down to a common base."
    )
    obj: bool = Field(False, description="Write the textured mesh as mesh.obj too, with .mtl and .png.")


class ExportCamerasOptions(CrsOptions):
    """Options of the export of the trained cameras.

    colmap/ and transforms.json (nerfstudio) are in the frame of splat.ply, as is undistorted/: photographs without
    lens distortion and their COLMAP model, for other trainers. cameras.csv has positions in the CRS of the
    contract, angles (omega phi kappa against grid north, yaw pitch roll against true north) and sigma.
    footprints.geojson shows on a map what each photograph shows.

    Examples:
      georef export-cameras flight
      georef export-cameras flight --crs EPSG:32632 --to handover/cameras
      georef export-cameras flight --undistorted --to trainer
    """

    undistorted: bool = Field(
        False,
        description="Write the photographs without lens distortion too, with a COLMAP model of pinhole cameras: "
        "input of other trainers of splats.",
    )


class ExportOpfOptions(CrsOptions, SplatOptions):
    """Options of the export as an OPF project.

    Open Photogrammetry Format 1.0: adjusted cameras and lenses, tie points, measured positions, control and check
    points with their marks; of a trained model, the surface as a point cloud, and the splat as an extension of OPF.
    Put it beside the photographs, whose names it lists. Without --crs, its map is a projection around the scene
    that is true to scale there.

    Examples:
      georef export-opf flight
      georef export-opf flight --no-cloud
      georef export-opf flight --to handover/opf
      georef export-opf flight --crs EPSG:32632+3855
    """

    crs: str | None = Field(
        None,
        description="CRS of the project, that of a map: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. Without "
        "it: a transverse Mercator projection around the scene, with heights above the ellipsoid.",
    )
    cloud: bool = Field(
        True, description="Write the surface as a point cloud too, as long as a `georef export-cloud` takes."
    )


def _cesium_folder(text: str) -> str:
    address = urlsplit(text)
    if not text.strip() or any(char.isspace() or not char.isprintable() for char in text):
        raise ValueError("an address without spaces, such as Cesium/")
    if address.query or address.fragment:
        raise ValueError("the address of a folder, such as Cesium/, without ? and #")
    if address.scheme not in ("", "http", "https") or (address.scheme and not address.netloc):
        raise ValueError("an https:// or http:// address, or a path relative to the page, such as Cesium/")
    return text if text.endswith("/") else text + "/"


class ShownCrsOptions(CrsOptions):
    """Options of the coordinates that a page shows."""

    crs: str | None = Field(
        None,
        description="CRS in which the page shows coordinates: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. "
        "Without it: the UTM zone of the scene.",
    )


class ExportHtmlOptions(WebSplatOptions, ShownCrsOptions):
    """Options of the page in one file.

    One file that any browser opens from the disk or from a mail, without a server and without a network: the splat,
    the cameras, control and check points, the measurements saved in `georef view`, accuracy and cautions. A splat
    too large for --max-megabytes is reduced, and the page says by how much.

    Examples:
      georef export-html flight
      georef export-html flight --to flight.html --max-megabytes 10
      georef export-html flight --crs EPSG:2056 --sh-degree 1
    """

    max_megabytes: float = Field(
        20.0,
        ge=4,
        le=1000,
        description="Largest size of the page in MB, as mail takes it. A larger splat loses degrees of its "
        "harmonics, then Gaussians; the page and the command say what, and how many dB it costs.",
    )


class PageOptions(ShownCrsOptions):
    """Options of the page that shows tiles in a browser."""

    cesium: Annotated[str, AfterValidator(_cesium_folder)] = Field(
        CESIUM,
        description="Address of the folder that holds Cesium.js: https://…, or a path relative to the page, such "
        "as Cesium/.",
    )


class ExportTilesOptions(WebSplatOptions, PageOptions):
    """Options of the export of the splat as 3D Tiles with their page, and as glb.

    The folder is ready for a web server: tileset.json with levels of detail in Earth-centred coordinates, its
    contents, splat.glb, the whole splat in one file, and index.html, which shows the tiles in CesiumJS. The files
    *.georef.json state the place on Earth and its accuracy.

    Examples:
      georef export-tiles flight
      georef export-tiles flight --to www/flight --max-tile-gaussians 100000
      georef export-tiles flight --compression none --archive --to plain
      georef export-tiles flight --crs EPSG:2056 --cesium Cesium/
    """

    max_tile_gaussians: int = Field(
        200_000, ge=1000, le=3_000_000, description="Largest number of Gaussians in a tile."
    )
    budget: int = Field(
        8_000_000,
        ge=1000,
        description="Largest number of Gaussians in all levels of the tileset together; the finest tiles are left "
        "out where they would exceed it. CesiumJS keeps the tiles that it has loaded, with some 500 bytes a "
        "Gaussian: the default is 4 GB.",
    )
    compression: Compression = Field(
        "spz",
        description="Content of the tiles: SPZ, or plain arrays of the ratified KHR_gaussian_splatting, exact and "
        "several times larger. CesiumJS reads SPZ alone, or plain arrays by the program in index.html.",
    )
    archive: bool = Field(False, description="Write the tileset as one file too: tiles.3tz.")
