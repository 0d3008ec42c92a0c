"""Options of the deliverables."""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from pipelines.core.options import StageOptions
from pipelines.scene.crs_options import CrsOptions

# The page was tried with this version: the extensions of splats in glTF are younger than those of meshes.
CESIUM = "https://cesium.com/downloads/cesiumjs/releases/1.145/Build/Cesium/"


class SplatOptions(StageOptions):
    """Options of every file that holds the Gaussians."""

    min_opacity: float = Field(0.005, ge=0, lt=1, description="Leave out Gaussians that are less opaque.")


class ExportPlyOptions(SplatOptions):
    """Options of the export of the splat as a 3DGS PLY with its sidecar."""


class MeasurableOptions(SplatOptions):
    """Options of the export of the splat with discs on its surface, as a PLY of its own."""

    disc_spacing: float | None = Field(
        None,
        ge=0.001,
        description="With --measurable: metres between discs (default: 0.7 of the width of a pixel of the training "
        "photographs on the ground).",
    )
    repaint_passes: int = Field(
        7,
        ge=0,
        le=1000,
        description="With --measurable: how often each training view is shown to the discs, for their colours.",
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


class ExportRasterOptions(CrsOptions):
    """Options of the export of orthophoto, surface model, σ and contours."""

    gsd: float | None = Field(
        None,
        gt=0,
        description="Size of a cell in units of the CRS. Without it: the ground sample distance of the "
        "photographs.",
    )
    contours: float | None = Field(None, gt=0, description="Interval of contour lines, in the unit of the heights.")
    min_views: int = Field(4, ge=2, description="Leave out cells whose surface fewer training views show.")
    max_pixels: float = Field(1e9, gt=0, description="Refuse a raster with more cells.")
    hillshade: bool = Field(True, description="Draw hillshade.png and preview.png.")


class ExportCloudOptions(CrsOptions):
    """Options of the export of the surface as a point cloud."""

    spacing: float | None = Field(
        None,
        ge=0.001,
        description="Side of the voxels that hold one point each, in metres (default: the width of a pixel of the "
        "training photographs on the ground).",
    )
    min_views: int = Field(3, ge=2, description="Number of training views that must agree on a point.")
    ply: bool = Field(False, description="Write the same points as cloud.ply too.")


class ExportCamerasOptions(CrsOptions):
    """Options of the export of the trained cameras."""


def _cesium_folder(text: str) -> str:
    address = urlsplit(text)
    if not text.strip() or any(char.isspace() or not char.isprintable() for char in text):
        raise ValueError("an address without spaces, such as Cesium/")
    if address.query or address.fragment:
        raise ValueError("the address of a folder, such as Cesium/, without ? and #")
    if address.scheme not in ("", "http", "https") or (address.scheme and not address.netloc):
        raise ValueError("an https:// or http:// address, or a path relative to the page, such as Cesium/")
    return text if text.endswith("/") else text + "/"


class PageOptions(CrsOptions):
    """Options of the page that shows tiles in a browser."""

    crs: str | None = Field(
        None,
        description="CRS in which the page shows coordinates: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. "
        "Without it: the UTM zone of the scene.",
    )
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
