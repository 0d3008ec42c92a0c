"""Run algorithms in QGIS without windows, as its toolbox does, and print the layers that arrive. Not a test.

    python3 driver.py PLUGINS CALLS.json

This runs in QGIS's own Python, which has neither pytest nor georef. CALLS is a list of algorithm and parameters.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsApplication,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProject,
    QgsRenderContext,
    QgsVectorLayer,
)

application = QgsApplication([], False)
application.initQgis()
sys.path[:0] = [str(Path(QgsApplication.pkgDataPath()) / "python/plugins"), sys.argv[1]]

import georef_qgis  # noqa: E402
import processing  # noqa: E402
from processing.core.Processing import Processing  # noqa: E402
from qgis.utils import iface  # noqa: E402

assert iface is None


def legend(layer: Any) -> list[str]:
    """Return what the legend of a layer says."""
    if isinstance(layer, QgsVectorLayer):
        return [item.label() for item in layer.renderer().legendSymbolItems()]
    return [text for text, _ in layer.renderer().legendSymbologyItems()]


def described(layer: Any) -> dict[str, Any]:
    """Return what a test can ask of a layer."""
    found = {"name": layer.name(), "valid": layer.isValid(), "crs": layer.crs().authid(), "legend": legend(layer)}
    found["renderer"] = layer.renderer().type()
    if isinstance(layer, QgsVectorLayer):
        symbols = layer.renderer().symbols(QgsRenderContext())
        found["features"] = layer.featureCount()
        found["symbols"] = [dict(symbol.symbolLayer(0).properties()) for symbol in symbols]
        found["labelled"] = layer.labelsEnabled()
    return found


def main() -> None:
    """Print one document a call: results, layers from the uppermost, messages."""
    Processing.initialize()
    plugin = georef_qgis.classFactory(None)  # which QGIS keeps as long as it is enabled
    plugin.initProcessing()
    project = QgsProject.instance()
    done = []
    for name, values in json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")):
        project.clear()
        feedback, context = QgsProcessingFeedback(False), QgsProcessingContext()
        context.setProject(project)
        document: dict[str, Any] = {"progress": []}
        feedback.progressChanged.connect(document["progress"].append)
        try:
            document["results"] = processing.runAndLoadResults(name, values, feedback, context)
        except Exception as error:
            document["error"] = str(error)
        document["log"] = feedback.textLog()
        application.processEvents()  # QGIS puts off the removal of layers that have left the tree
        nodes = project.layerTreeRoot().findLayers()
        document["layers"] = [{**described(node.layer()), "shown": node.isVisible()} for node in nodes]
        done.append(document)
    print(json.dumps(done))


main()
application.exitQgis()
