"""Options of the deliverables, and a description of each file of a workspace for those who receive it."""

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
    """Options of the export of the splat as a 3DGS PLY with its sidecar."""


class MeasurableOptions(PlyOptions):
    """Options of the export of the splat with discs on its surface, as a PLY of its own."""

    disc_spacing: float | None = Field(
        None,
        ge=0.001,
        description="With --measurable: metres between discs (default: 0.7 of the width of a pixel of the training "
        "photographs on the ground).",
    )
    appearance_passes: int = Field(
        7,
        ge=0,
        le=1000,
        description="With --measurable: passes over the training views of the appearance refinement, which fits "
        "the colours of the discs.",
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
    """Options of the export of the splat as SPZ with its sidecar."""

    spz_version: Literal["3", "4"] = Field(
        "3", description="Version of the format: CesiumJS and Spark read 3, PlayCanvas reads 4 only."
    )
    embed_georeference: bool = Field(
        False,
        description="With --spz-version 4, experimental: write the place on Earth into the file itself too, in the "
        "form that the authors of SPZ propose. It may change until they have decided.",
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
    """Options of the export of orthophoto, surface model, σ and contours."""

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
    max_pixels: float = Field(1e9, gt=0, description="Refuse a raster with more cells.")
    hillshade: bool = Field(True, description="Draw hillshade.png and preview.png.")


class ExportCloudOptions(CrsOptions, TerrainOptions):
    """Options of the export of the surface as a point cloud."""

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
    """Options of the export of the surface as a mesh."""

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
    """Options of the export of the trained cameras."""

    undistorted: bool = Field(
        False,
        description="Write the photographs without lens distortion too, with a COLMAP model of pinhole cameras: "
        "input of other trainers of splats.",
    )


class ExportOpfOptions(CrsOptions):
    """Options of the export as an OPF project."""

    crs: str | None = Field(
        None,
        description="CRS of the project, that of a map: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. Without "
        "it: a transverse Mercator projection around the scene, with heights above the ellipsoid.",
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
    """Options of the page in one file."""

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
    """Options of the export of the splat as 3D Tiles with their page, and as glb."""

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
