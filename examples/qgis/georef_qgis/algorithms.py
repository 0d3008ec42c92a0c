"""Algorithms of Processing: run, export-raster, change and info. Each one is one call of the program `georef`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputString,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterVectorLayer,
    QgsProcessingUtils,
    QgsVectorFileWriter,
)

from . import styles
from .program import call

PRESETS = ("smoke", "fast", "standard", "high")
SURFACES = ("surface", "terrain")
Style = Callable[[Any], None]

# Output, file in the workspace, name in QGIS, and style (None: QGIS's own); the first lies undermost. Rasters
# that would cover the first are loaded, and not shown.
RASTERS: tuple[tuple[str, str, str, Style | None], ...] = (
    ("ORTHOPHOTO", "raster/orthophoto.tif", "Orthophoto", None),
    ("DSM", "raster/dsm.tif", "Surface model", styles.heights),
    ("DTM", "raster/dtm.tif", "Terrain model", styles.heights),
    ("SIGMA_H", "raster/sigma_h.tif", "Horizontal σ", styles.sigma),
    ("SIGMA_V", "raster/sigma_v.tif", "Vertical σ", styles.sigma),
    ("INTERPOLATED", "raster/interpolated.geojson", "Interpolated", styles.interpolated),
    ("CONTOURS", "raster/contours.gpkg", "Contour lines", styles.contours),
)
CHANGES: tuple[tuple[str, str, str, Style | None], ...] = (
    ("DIFFERENCE", "change/difference.tif", "Later minus earlier height", styles.difference),
    ("SIGMA", "change/sigma.tif", "σ of the difference", styles.sigma),
    ("SIGNIFICANT", "change/significant.tif", "Significant change", styles.significant),
    ("REGIONS", "change/regions.gpkg", "Regions of change", styles.regions),
)


class GeorefAlgorithm(QgsProcessingAlgorithm):
    """What the algorithms share: names from the class, files as outputs, layers with their styles."""

    command = ""
    title = ""
    text = ""
    outputs: tuple[tuple[str, str, str, Style | None], ...] = ()

    def name(self) -> str:
        return self.command.replace("-", "")

    def displayName(self) -> str:
        return self.title

    def shortHelpString(self) -> str:
        return self.text

    def createInstance(self) -> GeorefAlgorithm:
        return type(self)()

    def initAlgorithm(self, _configuration: Any = None) -> None:
        self.define()
        for name, file, title, _ in self.outputs:
            kind = QgsProcessingOutputRasterLayer if file.endswith(".tif") else QgsProcessingOutputVectorLayer
            self.addOutput(kind(name, title))

    def define(self) -> None:
        """Add the parameters."""
        raise NotImplementedError

    def processAlgorithm(
        self, values: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        workspace, words = self.call_of(values, context)
        call(words, feedback)
        return self.layers(workspace, context)

    def call_of(self, values: dict[str, Any], context: QgsProcessingContext) -> tuple[Path, list[str]]:
        """Return the workspace that gets the outputs, and the words of the call."""
        raise NotImplementedError

    def add_file(self, name: str, title: str, *, folder: bool = False, optional: bool = False) -> None:
        """Add a parameter that names a file or a folder."""
        kind = QgsProcessingParameterFile.Folder if folder else QgsProcessingParameterFile.File
        self.addParameter(QgsProcessingParameterFile(name, title, behavior=kind, optional=optional))

    def add_area(self) -> None:
        """Add the area of interest."""
        kinds = [QgsProcessing.TypeVectorPolygon]
        self.addParameter(QgsProcessingParameterVectorLayer("BOUNDARY", "Area of interest", kinds, optional=True))

    def given_file(self, values: dict[str, Any], name: str, flag: str, context: Any) -> list[str]:
        """Return the words of a file that may be missing."""
        path = self.parameterAsFile(values, name, context)
        return [f"{flag}={path}"] if path else []

    def given_polygons(
        self, values: dict[str, Any], name: str, flag: str, context: QgsProcessingContext
    ) -> list[str]:
        """Return the words of a layer of polygons, written as GeoPackage in its own CRS."""
        layer = self.parameterAsVectorLayer(values, name, context)
        if layer is None:
            return []
        path = QgsProcessingUtils.generateTempFilename(f"{name.lower()}.gpkg")
        options = QgsVectorFileWriter.SaveVectorOptions()
        QgsVectorFileWriter.writeAsVectorFormatV3(layer, path, context.transformContext(), options)
        return [f"{flag}={path}"]

    def layers(self, workspace: Path, context: QgsProcessingContext) -> dict[str, str]:
        """Return the outputs that exist, and let QGIS load them with their styles."""
        found = {}
        for rank, (name, file, title, style) in enumerate(self.outputs):
            path = workspace / file
            if path.exists():
                found[name] = str(path)
                is_shown = rank == 0 or not file.endswith(".tif")
                self.load(str(path), name, title, styles.Styled(style, rank, is_shown=is_shown), context)
        return found

    def load(self, path: str, name: str, title: str, styled: styles.Styled, context: QgsProcessingContext) -> None:
        """Let QGIS load a file as a layer when the algorithm has ended."""
        details = QgsProcessingContext.LayerDetails(title, context.project(), name)
        details.forceName = True  # QGIS prefers the file's
        details.setPostProcessor(styled)
        context.addLayerToLoadOnCompletion(path, details)


class Run(GeorefAlgorithm):
    """`georef run` to rasters."""

    command, title, outputs = "run", "Survey from photographs", RASTERS
    text = (
        "Photographs, and control points where there are some, become a georeferenced splat, an orthophoto and "
        "surface models with their σ. A run that was cancelled goes on where it was."
    )

    def define(self) -> None:
        self.add_file("PHOTOS", "Folder of photographs", folder=True)
        self.add_file("WORKSPACE", "Workspace, a folder for the results", folder=True)
        self.add_file("GCP", "Ground control points", optional=True)
        self.add_file("TRAJECTORY", "Positions, if the photographs have none", optional=True)
        self.addParameter(QgsProcessingParameterEnum("PRESET", "Effort", PRESETS, defaultValue=2))
        self.add_area()

    def call_of(self, values: dict[str, Any], context: QgsProcessingContext) -> tuple[Path, list[str]]:
        workspace = Path(self.parameterAsString(values, "WORKSPACE", context))
        words = ["run", str(workspace), f"--images={self.parameterAsFile(values, 'PHOTOS', context)}"]
        words += self.given_file(values, "GCP", "--gcp", context)
        words += self.given_file(values, "TRAJECTORY", "--trajectory", context)
        words += self.given_polygons(values, "BOUNDARY", "--boundary", context)
        words += [f"--preset={PRESETS[self.parameterAsEnum(values, 'PRESET', context)]}", "--deliver=raster"]
        return workspace, words


class ExportRaster(GeorefAlgorithm):
    """`georef export-raster`."""

    command, title, outputs = "export-raster", "Rasters of a survey", RASTERS
    text = (
        "Orthophoto, surface and terrain model and their σ in another CRS, with other cells or with contour lines. "
        "Parts that no photograph measures are hatched."
    )

    def define(self) -> None:
        self.add_file("WORKSPACE", "Workspace of a survey", folder=True)
        self.addParameter(QgsProcessingParameterCrs("CRS", "CRS (default: UTM zone)", optional=True))
        number = QgsProcessingParameterNumber.Double
        for name, title in (("GSD", "Width of a cell"), ("CONTOURS", "Interval of contour lines")):
            self.addParameter(QgsProcessingParameterNumber(name, title, number, optional=True, minValue=0.0))
        self.addParameter(
            QgsProcessingParameterEnum("CONTOURS_OF", "Contour lines of", SURFACES[::-1], defaultValue=0)
        )
        self.add_area()

    def call_of(self, values: dict[str, Any], context: QgsProcessingContext) -> tuple[Path, list[str]]:
        workspace = Path(self.parameterAsString(values, "WORKSPACE", context))
        words = ["export-raster", str(workspace), "--forget=all"]
        crs = self.parameterAsCrs(values, "CRS", context)
        if crs.isValid():
            words.append(f"--crs={crs.authid() or crs.toWkt()}")
        for name in ("GSD", "CONTOURS"):
            if values.get(name) is not None and (number := self.parameterAsDouble(values, name, context)) > 0:
                words.append(f"--{name.lower()}={number}")
        words.append(f"--contours-of={SURFACES[::-1][self.parameterAsEnum(values, 'CONTOURS_OF', context)]}")
        words += self.given_polygons(values, "BOUNDARY", "--boundary", context)
        return workspace, words


class Change(GeorefAlgorithm):
    """`georef change`."""

    command, title, outputs = "change", "Change between two surveys", CHANGES
    text = (
        "What has changed between two surveys of one place, by how much, and whether it is real: difference of "
        "heights, its σ, significant change, and regions with volumes. Both need rasters in one CRS."
    )

    def define(self) -> None:
        self.add_file("EARLIER", "Workspace of the earlier survey", folder=True)
        self.add_file("LATER", "Workspace of the later survey", folder=True)
        self.addParameter(QgsProcessingParameterEnum("OF", "Heights of", SURFACES, defaultValue=0))
        kinds = [QgsProcessing.TypeVectorPolygon]
        for name, title in (
            ("STABLE", "Unchanged ground"),
            ("REGIONS_OF_INTEREST", "Regions whose volumes are wanted"),
        ):
            self.addParameter(QgsProcessingParameterVectorLayer(name, title, kinds, optional=True))
        self.addParameter(QgsProcessingParameterBoolean("STABLE_AUTO", "Find unchanged ground", defaultValue=False))

    def call_of(self, values: dict[str, Any], context: QgsProcessingContext) -> tuple[Path, list[str]]:
        later = Path(self.parameterAsString(values, "LATER", context))
        words = ["change", self.parameterAsString(values, "EARLIER", context), str(later), "--forget=all"]
        words.append(f"--of={SURFACES[self.parameterAsEnum(values, 'OF', context)]}")
        words += self.given_polygons(values, "STABLE", "--stable", context)
        words += self.given_polygons(values, "REGIONS_OF_INTEREST", "--regions", context)
        words += ["--stable-auto"] if self.parameterAsBool(values, "STABLE_AUTO", context) else []
        return later, words


class Info(GeorefAlgorithm):
    """`georef info`."""

    command, title = "info", "Where a survey is, and how accurate"
    text = "The outline of the result as a layer, with all figures as attributes."

    def define(self) -> None:
        self.add_file("WORKSPACE", "Workspace of a survey", folder=True)
        self.addParameter(QgsProcessingParameterFileDestination("AREA", "Outline", "GeoJSON (*.geojson)"))
        self.addOutput(QgsProcessingOutputString("ACCURACY", "Accuracy"))

    def processAlgorithm(
        self, values: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        found = call(["info", self.parameterAsString(values, "WORKSPACE", context)], feedback)
        path = self.parameterAsFileOutput(values, "AREA", context)
        Path(path).write_text(json.dumps(found), encoding="utf-8")
        self.load(path, "AREA", "Outline", styles.Styled(styles.area, 0, is_shown=True), context)
        return {"AREA": path, "ACCURACY": json.dumps(found["properties"]["quality"]["accuracy"])}


ALGORITHMS = (Run, ExportRaster, Change, Info)
