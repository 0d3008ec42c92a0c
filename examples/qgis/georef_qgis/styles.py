"""Styles of the layers: σ and heights in colours, interpolated parts hatched, contour lines, regions of change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from qgis.core import (
    QgsCategorizedSymbolRenderer,
    QgsColorRampShader,
    QgsFillSymbol,
    QgsLineSymbol,
    QgsMapLayer,
    QgsPalettedRasterRenderer,
    QgsPalLayerSettings,
    QgsProcessingLayerPostProcessorInterface,
    QgsRasterBandStats,
    QgsRasterShader,
    QgsRendererCategory,
    QgsRuleBasedRenderer,
    QgsSingleBandPseudoColorRenderer,
    QgsSingleSymbolRenderer,
    QgsVectorLayerSimpleLabeling,
)
from qgis.PyQt.QtGui import QColor

# Colours of viridis and of a diverging ramp, which the colour-blind tell apart.
_SIGMA = ("#440154", "#31688e", "#35b779", "#fde725")
_HEIGHTS = ("#2d6a4f", "#95a66b", "#e9d8a6", "#a47148", "#f8f9fa")
_DIFFERENCE = ("#2166ac", "#f7f7f7", "#b2182b")
_LOWERED, _RAISED = _DIFFERENCE[0], _DIFFERENCE[2]
_RANK = "georef/rank"  # of a layer among those of a call: a higher one lies above
_MOST, _SAMPLE = 0.9, 250_000
_SPREAD = 2.0  # standard deviations around the mean that colours span


def _ramp(layer: Any, colours: tuple[str, ...], low: float, high: float) -> None:
    """Colour a raster's one band by a ramp."""
    shader = QgsColorRampShader(low, high)
    shader.setColorRampType(QgsColorRampShader.Interpolated)
    last = len(colours) - 1
    values = [low + (high - low) * index / last for index in range(len(colours))]
    shader.setColorRampItemList(
        [
            QgsColorRampShader.ColorRampItem(value, QColor(colour), f"{value:.3g}")
            for value, colour in zip(values, colours)  # noqa: B905 # Python 3.9, which some QGIS have
        ]
    )
    whole = QgsRasterShader()
    whole.setRasterShaderFunction(shader)
    renderer = QgsSingleBandPseudoColorRenderer(layer.dataProvider(), 1, whole)
    renderer.setClassificationMin(low)
    renderer.setClassificationMax(high)
    layer.setRenderer(renderer)


def _range(layer: Any) -> tuple[float, float]:
    """Return the mean less and plus two standard deviations, within the values of a raster."""
    found = layer.dataProvider().bandStatistics(1, QgsRasterBandStats.All, layer.extent(), _SAMPLE)
    low = max(found.minimumValue, found.mean - _SPREAD * found.stdDev)
    high = min(found.maximumValue, found.mean + _SPREAD * found.stdDev)
    return low, max(high, low + 1e-6)


def sigma(layer: Any) -> None:
    """Style σ: dark where it is small, from zero to what nine tenths of the cells stay below."""
    _, high = layer.dataProvider().cumulativeCut(1, 0.0, _MOST, layer.extent(), _SAMPLE)
    _ramp(layer, _SIGMA, 0.0, max(high, 1e-6))


def heights(layer: Any) -> None:
    """Style heights: green valleys, brown and white tops."""
    low, high = _range(layer)
    _ramp(layer, _HEIGHTS, low, high)


def difference(layer: Any) -> None:
    """Style a difference: lowered blue, raised red, white at zero."""
    low, high = _range(layer)
    most = max(abs(low), abs(high))
    _ramp(layer, _DIFFERENCE, -most, most)


def significant(layer: Any) -> None:
    """Style classes of change: 1 none, 2 lowered, 3 raised, 4 doubtful."""
    classes = {
        1: ("#00000000", "no significant change"),
        2: (_LOWERED, "lowered"),
        3: (_RAISED, "raised"),
        4: ("#9a9a9a", "doubtful"),
    }
    entries = [
        QgsPalettedRasterRenderer.Class(value, QColor(colour), text) for value, (colour, text) in classes.items()
    ]
    layer.setRenderer(QgsPalettedRasterRenderer(layer.dataProvider(), 1, entries))


def interpolated(layer: Any) -> None:
    """Style interpolated parts: hatched, so that the orthophoto shows between the lines."""
    form = {"color": "#d00000", "style": "b_diagonal", "outline_color": "#d00000", "outline_width": "0.2"}
    layer.setRenderer(QgsSingleSymbolRenderer(QgsFillSymbol.createSimple(form)))


def contours(layer: Any) -> None:
    """Style contour lines: every fifth one broad, with its height."""
    root = QgsRuleBasedRenderer.Rule(None)
    for text, rule, width in (("major", '"major"', "0.5"), ("minor", 'not "major"', "0.15")):
        symbol = QgsLineSymbol.createSimple({"line_color": "#7f4f24", "line_width": width})
        root.appendChild(QgsRuleBasedRenderer.Rule(symbol, filterExp=rule, label=text))
    layer.setRenderer(QgsRuleBasedRenderer(root))
    labels = QgsPalLayerSettings()
    labels.fieldName = """if("major", round("height", 2), '')"""
    labels.isExpression = True
    labels.placement = QgsPalLayerSettings.Line
    layer.setLabeling(QgsVectorLayerSimpleLabeling(labels))
    layer.setLabelsEnabled(True)


def regions(layer: Any) -> None:
    """Style regions of change by the sign of their volume: lowered blue, raised red."""
    categories = []
    for value, colour, text in ((True, _DIFFERENCE[2], "raised"), (False, _DIFFERENCE[0], "lowered")):
        form = {"color": f"{colour}40", "outline_color": colour, "outline_width": "0.5"}
        categories.append(QgsRendererCategory(value, QgsFillSymbol.createSimple(form), text))
    layer.setRenderer(QgsCategorizedSymbolRenderer('"net_m3" > 0', categories))


def area(layer: Any) -> None:
    """Style the outline of a result."""
    form = {"style": "no", "outline_color": "#d00000", "outline_width": "0.6"}
    layer.setRenderer(QgsSingleSymbolRenderer(QgsFillSymbol.createSimple(form)))


class Styled(QgsProcessingLayerPostProcessorInterface):
    """Post-processor that styles a layer when it has been loaded, and puts it in its place among the layers.

    Processing loads layers in the order of their files' names, and the last would cover the others.
    """

    _kept: ClassVar[list[Styled]] = []  # QGIS does not keep them

    def __init__(self, style: Callable[[QgsMapLayer], None] | None, rank: int, *, is_shown: bool) -> None:
        super().__init__()
        self._style, self._rank, self._is_shown = style, rank, is_shown
        self._kept.append(self)

    def postProcessLayer(self, layer: Any, context: Any, _feedback: Any) -> None:
        if self._style is not None:
            self._style(layer)
            layer.triggerRepaint()
        layer.setCustomProperty(_RANK, self._rank)
        node = context.project().layerTreeRoot().findLayer(layer.id())
        if node is not None:
            _place(node, self._rank).setItemVisibilityChecked(self._is_shown)


def _place(node: Any, rank: int) -> Any:
    """Move a layer's node above those of lower rank beside it, and return the moved one."""
    parent, moved = node.parent(), node.clone()
    below: list[int] = []
    above: list[int] = []
    for index, other in enumerate(parent.children()):
        value = other.layer().customProperty(_RANK) if hasattr(other, "layer") and other is not node else None
        if value is not None:
            (below if int(value) <= rank else above).append(index)
    # QGIS removes a layer from the project if no node has it: the new node comes first.
    parent.insertChildNode(below[0] if below else above[-1] + 1 if above else 0, moved)
    parent.removeChildNode(node)
    return moved
