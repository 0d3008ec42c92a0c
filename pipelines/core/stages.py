"""Table of the stages: their modules, options, inputs and products.

`georef status` and `--help` read this table without importing a stage.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipelines.core.errors import GeorefError
from pipelines.core.product_parts import ProductPart, whole_products

if TYPE_CHECKING:
    from pipelines.core.options import StageOptions

SURVEY = "ingest/survey.json"
RIG_MODEL = "sfm/rig"  # the whole model, where the survey has companions
MASKS = "ingest/masks"  # of the photographs that have one
TRACK = "ingest/track.npz"  # only for surveys with a trajectory
SPARSE = "sfm/sparse"
COMMON_POINTS = "sfm/sparse/common_points.npz"  # only of a survey that is tied to an earlier one
RIG = "calibrate/rig.json"
POINTS = "geolocate/points.npz"
SIM3 = "sim3/geo_from_local.json"  # the similarity of the solution alone, for other programs
ADJUSTMENT, SIM3_POSTERIOR = "sim3/adjustment.json", "sim3/adjustment.npz"
MODEL = "train/model.json"
TRAIN_POSTERIOR = "train/adjustment.npz"
METRICS = "train/metrics.jsonl"
GAUSSIANS = "train/gaussians.ply"
REPORT = "evaluate/report.json"
RENDERS = "evaluate/renders"
REFERENCE_MAP, REFERENCE_HISTOGRAM = "evaluate/reference_map.png", "evaluate/reference_histogram.png"
ACCURACY_MAP = "evaluate/accuracy.png"  # only where the measurements determine the scene
CLEANED, CLEANING = "clean/gaussians.ply", "clean/clean.json"
REMOVED = "clean/removed.ply"  # only if floaters were removed
SPLAT = "export/splat.ply"
ORTHOPHOTO_PREVIEW = "raster/preview.png"
HILLSHADE = "raster/hillshade.png"
CLOUD = "cloud/cloud.laz"
MESH, MESH_GLB = "mesh/mesh.ply", "mesh/mesh.glb"
MEASURABLE_SPLAT = "measurable/splat.measurable.ply"
SPZ = "spz/splat.spz"
SOG = "sog/lod-meta.json"
TILES = "tiles/tileset.json"
TILES_GLB = "tiles/splat.glb"
HTML = "html/splat.html"
OPF = "opf/project.opf"
REPORT_PAGE = "report/report.html"
CHANGE_FIGURES, CHANGE_PAGE = "change/change.json", "change/change.html"
LIDAR, LIDAR_MAP = "train/lidar.json", "train/lidar.png"  # only of a training with LiDAR
HELD_OUT = "train/held_out.npz"  # measured points that it was not given
BLOCK_RECORD = "train/blocks.json"  # only of a model that was trained in blocks
BLOCK_PLAN = "plan/plan.json"
SOLUTION = "solution/solution.json"
SCAFFOLD = "scaffold/gaussians.ply"
BLOCK_GAUSSIANS = "block/gaussians.ply"
BLOCK_TRAINING = "block/record.json"
FIRST_CELL = "seams/0.ply"
SAVED_MEASUREMENTS = "view/measurements.geojson"
OF_NO_STAGE = frozenset({SAVED_MEASUREMENTS})  # products that the user makes, in the viewer


# Photographs count by content, wherever their folder lies; their originals are those of their copies. Messages to
# the user change no result, and points without marks enter none.
MEASURED = ProductPart(
    SURVEY, without=("image_dir", "original_dir", "originals", "assumptions", "warnings", "unmarked_points")
)
# The photographs, positions and attitudes, by which `sfm` chooses the pairs to match, and velocities, by which it
# corrects a rolling shutter. Control points, σ and the split of a survey do not make an SfM model stale.
PHOTOGRAPHS = ProductPart(
    SURVEY,
    fields=(
        "cameras",
        "images.name",
        "images.camera_id",
        "images.sha256",
        "images.fix.position_in_geo",
        "images.attitude.quat_xyzw",
        "images.velocity_in_geo",
        "images.mask_sha256",
    ),
    if_any=("companions.name", "companions.camera_id", "companions.sha256", "companions.beside"),
)
# The estimates that are applied to the survey when the survey is read, and the navigation that they are applied to.
APPLIED_RIG = ProductPart(
    RIG, fields=("applied.name", "applied.value", "applied.start", "fix_lag"), optional=True, brings=(TRACK,)
)

# The solution with its covariances, which is init-sim3's until training goes on from it.
SOLVED = (
    *whole_products(SPARSE),
    *whole_products(ADJUSTMENT, SIM3_POSTERIOR, MODEL, TRAIN_POSTERIOR, GAUSSIANS, optional=True),
)

# Where a solution has put cameras and points; a training that keeps the cameras keeps all of it.
_PLACES = (
    "geo_from_model",
    "model_from_local",
    "cameras.name",
    "cameras.quat_xyzw",
    "cameras.translation",
    "lenses",
)
SOLVED_PLACES = ProductPart(MODEL, fields=_PLACES, optional=True), ProductPart(ADJUSTMENT, fields=_PLACES)

# The area of interest, to which splats are cropped on request.
CROPPED_BY = whole_products(SPARSE, ADJUSTMENT, optional=True)

# The Gaussians that `georef clean` has left, which files of the splat take in place of the trained ones.
TAKEN = whole_products(CLEANED, optional=True)

# The accuracy of the result, which every file to hand over states.
HEADLINE = ProductPart(REPORT, fields=("headline",), optional=True)

# What each file of the splat is made from.
DELIVERED_SPLAT = (MEASURED, *whole_products(MODEL, GAUSSIANS), *TAKEN, *CROPPED_BY, APPLIED_RIG, HEADLINE)


@dataclass(frozen=True)
class StageSpec:
    """Row of the table: one stage.

    Attributes:
        name: the subcommand; in tables, `georef.toml` and logs, also where `called` is another.
        module: module that defines `run(stage, options) -> Summary`. Each `run` raises a MissingProductError if a
            product that it reads does not exist, and an InputError if a product, a photograph or an option cannot
            be used, or the disk is too small. Its docstring names its other errors.
        options_place: `module:class` of its options.
        reads: products, or parts of them, that decide its result.
        product: workspace path of its main product, whose first part is the stage's folder.
        title: what its command does, in one sentence; empty without a command of its own.
        files: use of each file for people, by workspace path, in the order in which they look for them; a path
            without a suffix is a folder.
        resumable: whether a partial product can be continued.
        growing: options of which a larger value continues the finished product.
        also: further products in its folder, besides those that the stages of the pipeline read.
        working: files and folders in its folder that no hash guards: other programs may change them, or the survey
            has hashes of its own.
        in_parts: module that makes the same product in parts, with the same `run`. `made_in_parts(workspace,
            options)` of `module` decides; without it, `module` makes all products.
        called: words of its command, where they are not its name.
        product_version: of the form of its product; one of another form is made again.
        delivers: what its command copies out of the workspace: its whole folder, or one file with its sidecars.
    """

    name: str
    module: str
    options_place: str
    reads: tuple[ProductPart, ...]
    product: str
    title: str = ""
    files: Mapping[str, str] = field(default_factory=dict, hash=False)
    resumable: bool = False
    growing: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    working: tuple[str, ...] = ()
    in_parts: str = ""
    called: str = ""
    product_version: int = 1
    delivers: Literal["", "file", "folder"] = ""

    @property
    def folder(self) -> str:
        return self.product.partition("/")[0]

    def command(self, workspace: Path) -> str:
        """Return the command that makes its product in a workspace."""
        return f"georef {self.called or self.name} {workspace}"

    @property
    def options(self) -> type[StageOptions]:
        """Class of its options; the module is imported on access."""
        module, _, name = self.options_place.partition(":")
        options: type[StageOptions] = getattr(importlib.import_module(module), name)
        return options


PIPELINE: tuple[StageSpec, ...] = (
    StageSpec(
        name="ingest",
        module="pipelines.ingest.stage",
        options_place="pipelines.ingest.options:IngestOptions",
        reads=(),
        product=SURVEY,
        title="Read photographs, positions and control points into one survey.",
        working=("images", "masks"),
        product_version=2,  # as `Survey.format_version`
    ),
    StageSpec(
        name="sfm",
        module="pipelines.sfm.stage",
        options_place="pipelines.sfm.options:SfmOptions",
        reads=(PHOTOGRAPHS,),
        product=SPARSE,
        title="Reconstruct cameras and points with COLMAP.",
        resumable=True,
        working=("database.db",),
    ),
    StageSpec(
        name="calibrate",
        module="pipelines.adjust.calibrate",
        options_place="pipelines.adjust.options:CalibrateOptions",
        reads=(MEASURED, *whole_products(SPARSE), ProductPart(TRACK, optional=True)),
        product=RIG,
        title="Find the time offset, and starts of boresight and lever arm.",
        product_version=2,  # with the lag of positions by photograph
    ),
    StageSpec(
        name="geolocate",
        module="pipelines.adjust.geolocate",
        options_place="pipelines.adjust.options:GeolocateOptions",
        reads=(MEASURED, *whole_products(SPARSE), APPLIED_RIG),
        product=POINTS,
        title="Intersect every SfM point on Earth.",
    ),
    StageSpec(
        name="init-sim3",
        module="pipelines.adjust.init_sim3",
        options_place="pipelines.adjust.options:InitSim3Options",
        reads=(MEASURED, *whole_products(SPARSE, POINTS), APPLIED_RIG),
        product=ADJUSTMENT,
        title="Estimate the similarity from the SfM model to the Earth.",
        product_version=3,  # one document
        also=(SIM3_POSTERIOR, SIM3),
    ),
    StageSpec(
        name="train",
        module="pipelines.train.stage",
        options_place="pipelines.train.options:TrainOptions",
        reads=(MEASURED, *whole_products(SPARSE, ADJUSTMENT, SIM3_POSTERIOR, POINTS), APPLIED_RIG),
        product=MODEL,
        title="Train the Gaussians with the similarity and the cameras.",
        product_version=3,  # of Gaussians on the surface that the solved cameras see
        resumable=True,
        growing=("iterations",),
        also=(TRAIN_POSTERIOR,),
        working=("checkpoint.npz",),
        in_parts="pipelines.train.blocks.stage",
    ),
    StageSpec(
        name="evaluate",
        module="pipelines.evaluate.stage",
        options_place="pipelines.evaluate.options:EvaluateOptions",
        reads=(MEASURED, *SOLVED, *whole_products(HELD_OUT, optional=True), APPLIED_RIG),
        product=REPORT,
        title="Measure test views and check points.",
        files={
            "evaluate/report.json": "measured and predicted accuracy, for the record",
            "evaluate/cameras.csv": "σ of every photograph",
            "evaluate/points.csv": "error of each check and control point",
            "evaluate/accuracy.png": "map of the predicted accuracy, with the errors of the points",
            "evaluate/accuracy.csv": "the same map as a table",
        },
        product_version=4,  # with the area that is measured
    ),
    StageSpec(
        name="export-ply",
        module="pipelines.deliver.ply",
        options_place="pipelines.deliver.options:ExportPlyOptions",
        reads=DELIVERED_SPLAT,
        product=SPLAT,
        title="Write the splat as a PLY with its place on Earth.",
        files={
            "export/splat.ply": "the splat as trained, to look at and to edit (SuperSplat, Blender)",
        },
        delivers="file",
    ),
)

# Makes another model from the trained one, on request.
CLEAN = StageSpec(
    name="clean",
    module="pipelines.clean.stage",
    options_place="pipelines.clean.options:CleanOptions",
    reads=(MEASURED, *whole_products(SPARSE, ADJUSTMENT, MODEL, GAUSSIANS), APPLIED_RIG),
    product=CLEANED,
    title="Remove floaters from the trained model, and make it smaller.",
    files={
        "clean/gaussians.ply": "the cleaned model, which files of the splat take; in the frame of the training",
        "clean/removed.ply": "the floaters that were removed, to look at; in the same frame",
    },
    also=(CLEANING,),
)

# What a survey hands over besides the PLY: each is made on request, and none is read by another stage.
# Files that the report lists, with their hashes.
DELIVERED = (
    SPLAT,
    MEASURABLE_SPLAT,
    "raster/dsm.tif",
    CLOUD,
    MESH,
    SPZ,
    SOG,
    TILES,
    HTML,
    "cameras/cameras.csv",
    OPF,
)
DELIVERABLES: tuple[StageSpec, ...] = (
    StageSpec(
        name="export-measurable",
        module="pipelines.deliver.measurable",
        options_place="pipelines.deliver.options:MeasurableOptions",
        reads=(MEASURED, *whole_products(SPARSE, MODEL, GAUSSIANS), APPLIED_RIG, HEADLINE),
        product=MEASURABLE_SPLAT,
        title="Write a second PLY whose centres lie on the surface, for viewers that measure by them.",
        files={
            "measurable/splat.measurable.ply": "the splat to measure in, for viewers that pick centres; larger",
        },
        delivers="file",
        resumable=True,
        called="export-ply --measurable",
    ),
    StageSpec(
        name="export-raster",
        module="pipelines.deliver.raster",
        options_place="pipelines.deliver.options:ExportRasterOptions",
        reads=(MEASURED, *whole_products(SPARSE, MODEL, TRAIN_POSTERIOR, GAUSSIANS), APPLIED_RIG, HEADLINE),
        product="raster/orthophoto.tif",
        title="Write orthophoto, surface model and σ as rasters.",
        files={
            "raster/orthophoto.tif": "orthophoto, for GIS and CAD",
            "raster/bands.tif": "bands of a multispectral rig, or temperatures, for GIS",
            "raster/dsm.tif": "surface model, for volumes, profiles and GIS",
            "raster/dtm.tif": "terrain model: the ground without houses, trees and cars",
            "raster/sigma_dtm.tif": "vertical σ of the terrain model",
            "raster/measured.tif": "which cells are measured, and which interpolated",
            "raster/interpolated.geojson": "outlines of the interpolated parts, for maps",
            "raster/sigma_h.tif": "horizontal σ of each cell",
            "raster/sigma_v.tif": "vertical σ of each cell",
            "raster/contours.gpkg": "contour lines, for GIS",
            "raster/contours.dxf": "contour lines, for CAD",
            "raster/hillshade.png": "picture of the surface model",
            "raster/preview.png": "picture of the orthophoto",
        },
        delivers="folder",
        resumable=True,
        also=("raster/dsm.tif", "raster/measured.tif", "raster/sigma_h.tif", "raster/sigma_v.tif"),
        product_version=3,  # level ground by whole Gaussians
    ),
    StageSpec(
        name="export-cloud",
        module="pipelines.deliver.cloud",
        options_place="pipelines.deliver.options:ExportCloudOptions",
        reads=(MEASURED, *whole_products(SPARSE, MODEL, TRAIN_POSTERIOR, GAUSSIANS), APPLIED_RIG, HEADLINE),
        product=CLOUD,
        title="Write the surface as a georeferenced point cloud (LAZ).",
        files={
            "cloud/cloud.laz": "point cloud with σ, for surveying software (CloudCompare, QGIS, PDAL)",
            "cloud/cloud.copc.laz": "the same point cloud in levels of detail, for viewers on the web (COPC)",
            "cloud/cloud.ply": "the same point cloud, for viewers without LAZ",
        },
        delivers="file",
        resumable=True,
    ),
    StageSpec(
        name="export-mesh",
        module="pipelines.deliver.mesh",
        options_place="pipelines.deliver.options:ExportMeshOptions",
        reads=(MEASURED, *whole_products(SPARSE, MODEL, GAUSSIANS), APPLIED_RIG, HEADLINE),
        product=MESH,
        title="Write the surface as a triangle mesh with texture.",
        files={
            "mesh/mesh.ply": "triangle mesh with coloured vertices, to measure and edit (CloudCompare, MeshLab)",
            "mesh/mesh.glb": "the mesh with texture, for viewers and engines (Blender, Unity, web)",
            "mesh/mesh.obj": "the mesh with texture, for programs without glTF",
            "mesh/mesh_crs.ply": "the mesh in a CRS, with double coordinates, for surveying software",
        },
        delivers="file",
        resumable=True,
        also=(MESH_GLB,),
    ),
    StageSpec(
        name="export-spz",
        module="pipelines.deliver.spz",
        options_place="pipelines.deliver.options:ExportSpzOptions",
        reads=DELIVERED_SPLAT,
        product=SPZ,
        title="Write the splat as SPZ, for viewers on the web.",
        files={
            "spz/splat.spz": "the splat compressed, for viewers on the web",
        },
        delivers="file",
    ),
    StageSpec(
        name="export-sog",
        module="pipelines.deliver.sog",
        options_place="pipelines.deliver.options:ExportSogOptions",
        reads=DELIVERED_SPLAT,
        product=SOG,
        title="Write the splat as streamed SOG, in levels of detail.",
        files={
            "sog/lod-meta.json": "the splat in levels of detail, for PlayCanvas' viewers on the web (streamed SOG)",
        },
        delivers="folder",
    ),
    StageSpec(
        name="export-tiles",
        module="pipelines.deliver.tiles",
        options_place="pipelines.deliver.options:ExportTilesOptions",
        reads=DELIVERED_SPLAT,
        product=TILES,
        title="Write the splat as 3D Tiles, for web globes.",
        files={
            "tiles/tileset.json": "the splat as 3D Tiles, for web globes (CesiumJS)",
            "tiles/index.html": "page that shows the tiles on the globe",
            "tiles/tiles.3tz": "the same 3D Tiles in one file, for desktop GIS",
            "tiles/splat.glb": "the splat in one glTF file",
        },
        delivers="folder",
        also=(TILES_GLB,),
    ),
    StageSpec(
        name="export-html",
        module="pipelines.deliver.html",
        options_place="pipelines.deliver.options:ExportHtmlOptions",
        reads=(
            MEASURED,
            *whole_products(SPARSE, MODEL, GAUSSIANS),
            *TAKEN,
            *whole_products(SAVED_MEASUREMENTS, optional=True),
            APPLIED_RIG,
            HEADLINE,
        ),
        product=HTML,
        title="Write the splat with its viewer as one HTML file.",
        files={
            "html/splat.html": "the splat with its viewer in one file, to send by mail: opens without a network",
        },
        delivers="file",
    ),
    StageSpec(
        name="export-cameras",
        module="pipelines.deliver.cameras",
        options_place="pipelines.deliver.options:ExportCamerasOptions",
        reads=(MEASURED, *SOLVED, APPLIED_RIG, HEADLINE),
        product="cameras/cameras.csv",
        title="Write the trained cameras for other programs.",
        files={
            "cameras/cameras.csv": "positions, angles and σ of the photographs, for photogrammetry",
            "cameras/camera_covariances.csv": "full covariance of every photograph, for weighted solutions",
            "cameras/covariances.npz": "the same as arrays, and the covariance of every tie point",
            "cameras/colmap": "adjusted cameras and points as a COLMAP model, for other trainers",
            "cameras/undistorted": "photographs without distortion with their COLMAP model, for trainers of splats",
            "cameras/transforms.json": "adjusted cameras for nerfstudio",
            "cameras/sparse_pc.ply": "points for nerfstudio",
            "cameras/footprints.geojson": "ground that each photograph shows, for maps",
        },
        delivers="folder",
        also=(
            "cameras/colmap",
            "cameras/transforms.json",
            "cameras/sparse_pc.ply",
            "cameras/footprints.geojson",
            "cameras/covariances.npz",
            "cameras/camera_covariances.csv",
        ),
    ),
    StageSpec(
        name="export-opf",
        module="pipelines.deliver.opf",
        options_place="pipelines.deliver.options:ExportOpfOptions",
        reads=(MEASURED, *SOLVED, *TAKEN, APPLIED_RIG, HEADLINE),
        product=OPF,
        title="Write cameras, points, marks and splat as an OPF project.",
        files={
            "opf/project.opf": "cameras, tie and marked points, cloud and splat as OPF, for photogrammetry (PIX4D)",
        },
        delivers="folder",
    ),
    StageSpec(
        name="report",
        module="pipelines.report.stage",
        options_place="pipelines.report.options:ReportOptions",
        reads=(
            *whole_products(SURVEY, REPORT),
            *SOLVED,
            APPLIED_RIG,
            *whole_products(RENDERS, ACCURACY_MAP, REFERENCE_MAP, REFERENCE_HISTOGRAM, optional=True),
            *whole_products(*DELIVERED, optional=True),
            *whole_products(
                METRICS, LIDAR, LIDAR_MAP, ORTHOPHOTO_PREVIEW, HILLSHADE, CHANGE_FIGURES, optional=True
            ),
        ),
        product=REPORT_PAGE,
        title="Write the report: one page, and its PDF.",
        files={
            "report/report.html": "report to hand in: one page with accuracy, points, photographs and processing",
            "report/report.pdf": "the same report, for printing",
        },
        delivers="file",
    ),
)

# Compares the workspace with another, the earlier epoch, on request.
CHANGE = StageSpec(
    name="change",
    module="pipelines.change.stage",
    options_place="pipelines.change.options:ChangeOptions",
    reads=(
        MEASURED,
        *SOLVED,
        *whole_products("raster/dsm.tif", "raster/sigma_v.tif", "raster/measured.tif"),
        *whole_products(*("raster/dtm.tif", "raster/sigma_dtm.tif", "raster/orthophoto.tif", CLOUD), optional=True),
    ),
    product=CHANGE_FIGURES,
    title="Compare two surveys: what changed, by how much, is it real.",
    delivers="folder",
    also=(
        "change/difference.tif",
        "change/sigma.tif",
        "change/lod.tif",
        "change/significant.tif",
        "change/regions.gpkg",
        "change/regions.geojson",
        "change/regions.csv",
        CHANGE_PAGE,
    ),
    product_version=6,  # no region at the rim alone, no volume of a polygon that is hardly known
)

# No part of the pipeline: `georef compare` runs this stage for the baseline, whose later stages read its folder in
# place of those of sfm and init-sim3.
ADJUST = StageSpec(
    name="adjust",
    module="pipelines.sfm.prior_adjustment",
    options_place="pipelines.sfm.options:AdjustOptions",
    reads=(MEASURED, *whole_products(SPARSE), APPLIED_RIG),
    product="adjust/sparse",
    also=("adjust/adjustment.json", "adjust/adjustment.npz"),
    product_version=2,  # one document of the solution
)

# Parts of a training in blocks, in variants of the workspace: all once, but for those of each block.
PLAN_BLOCKS = StageSpec(
    name="plan",
    module="pipelines.train.blocks.plan",
    options_place="pipelines.train.options:PlanOptions",
    reads=(MEASURED, *whole_products(SPARSE, ADJUSTMENT), APPLIED_RIG),
    product=BLOCK_PLAN,
)
SOLVE = StageSpec(
    name="solve",
    module="pipelines.train.blocks.solution",
    options_place="pipelines.train.options:SolutionOptions",
    reads=(MEASURED, *whole_products(SPARSE, ADJUSTMENT), APPLIED_RIG),
    product=SOLUTION,
)
TRAIN_SCAFFOLD = StageSpec(
    name="scaffold",
    module="pipelines.train.blocks.scaffold",
    options_place="pipelines.train.options:TrainOptions",
    reads=(MEASURED, *whole_products(SPARSE, SOLUTION), APPLIED_RIG),
    product=SCAFFOLD,
    resumable=True,
    working=("checkpoint.npz",),
)
TRAIN_BLOCK = StageSpec(
    name="block",
    module="pipelines.train.blocks.block",
    options_place="pipelines.train.options:BlockTrainOptions",
    reads=(MEASURED, *whole_products(SPARSE, BLOCK_PLAN, SOLUTION, SCAFFOLD), APPLIED_RIG),
    product=BLOCK_GAUSSIANS,
    resumable=True,
    growing=("iterations",),
    also=(BLOCK_TRAINING,),
    working=("checkpoint.npz",),
)
TRAIN_SEAMS = StageSpec(
    name="seams",
    module="pipelines.train.blocks.seams",
    options_place="pipelines.train.options:SeamOptions",
    reads=(MEASURED, *whole_products(SPARSE, BLOCK_PLAN, SOLUTION, SCAFFOLD), APPLIED_RIG),
    product=FIRST_CELL,
    resumable=True,
)
BLOCK_PARTS = (PLAN_BLOCKS, SOLVE, TRAIN_SCAFFOLD, TRAIN_BLOCK, TRAIN_SEAMS)

STAGES = (*PIPELINE, CLEAN, *DELIVERABLES, CHANGE, ADJUST, *BLOCK_PARTS)
BY_NAME = {spec.name: spec for spec in (*PIPELINE, CLEAN, *DELIVERABLES, CHANGE)}

# Use of each file of a result, for `georef info` and for the report's list of what was delivered.
DESCRIPTIONS = {
    path: use
    for spec in (CLEAN, BY_NAME["export-ply"], *DELIVERABLES, BY_NAME["evaluate"])
    for path, use in spec.files.items()
}


def producer_of(path: str) -> StageSpec:
    """Return the stage whose folder a path within a workspace begins with.

    Raises:
        StopIteration: no stage has the folder.
    """
    folder = path.split("/", maxsplit=1)[0]
    return next(spec for spec in STAGES if spec.folder == folder)


def products_of(spec: StageSpec) -> tuple[str, ...]:
    """Return the products of a stage: its main product, its further ones, and those that other stages require."""
    needed = (part.product for other in PIPELINE for part in other.reads if not part.optional)
    required = (product for product in needed if producer_of(product) is spec)
    return tuple(dict.fromkeys((spec.product, *spec.also, *required)))


def named_deliverables(names: str | None) -> tuple[StageSpec, ...]:
    """Return the stages of the deliverables in a text (`raster,cloud`, `all`); a ValueError: one is unknown."""
    from pipelines.core.options import listed_names  # and the validation library, which the help does without

    by_name = {spec.name.removeprefix("export-"): spec for spec in DELIVERABLES}
    listed = () if names is None else listed_names(names, (*by_name, "all"))
    return tuple(spec for name, spec in by_name.items() if name in listed or "all" in listed)


def stage_slice(first: str | None, last: str | None) -> tuple[StageSpec, ...]:
    """Return the stages from `first` to `last`, both included; a GeorefError: `first` comes after `last`."""
    names = [spec.name for spec in PIPELINE]
    begin = names.index(first) if first else 0
    end = names.index(last) if last else len(names) - 1
    if begin > end:
        message = f"--from {first} comes after --to {last}. The order is {', '.join(names)}."
        raise GeorefError("stage-order", message)
    return PIPELINE[begin : end + 1]
