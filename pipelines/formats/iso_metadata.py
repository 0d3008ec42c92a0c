"""Metadata after ISO 19115 with quality elements after ISO 19157, as the XML of ISO 19139 that GIS catalogues read.

The elements stand in the order of the schema `gmd` of 2007-04-17. Numbers of measures are those of ISO 19157, annex
D (ISO/TS 19138 has the same). Lengths are in metres, latitude and longitude in degrees on WGS84.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal
from xml.etree.ElementTree import Element, indent, register_namespace, tostring

from pipelines import __version__
from pipelines.core.figures import Headline
from pipelines.core.sentences import printable

_SPACES = {
    "gmd": "http://www.isotc211.org/2005/gmd",
    "gco": "http://www.isotc211.org/2005/gco",
    "xlink": "http://www.w3.org/1999/xlink",
}
_CODES = "http://standards.iso.org/iso/19139/resources/gmxCodelists.xml#"
_EPSG = re.compile(r"EPSG:(\d+)(?:\+(\d+))?", re.IGNORECASE)
_METRE = "urn:ogc:def:uom:EPSG::9001"
# Names and numbers of measures; the last has none in the standard, whose circular σ is smaller by √2.
RMSE_PLAN, RMSE, STANDARD_ERROR = (
    ("root mean square error of planimetry", "47"),
    ("root mean square error", "39"),
    ("standard linear error", "34"),
)
PLAN_SIGMA = ("distance root mean square of predicted standard deviations", "")
PREDICTED_RMS = ("root mean square of predicted standard deviations", "")


@dataclass(frozen=True)
class QualityElement:
    """Positional accuracy of a dataset: name and number of the measure, of what it tells, and its value.

    `method` is `directExternal` for what check points measured, `directInternal` for what covariances predict.
    """

    measure: tuple[str, str]
    description: str
    value_m: float
    method: Literal["directExternal", "directInternal"] = "directInternal"


@dataclass(frozen=True)
class IsoMetadata:
    """Metadata of a file: what a catalogue asks for.

    Attributes:
        crs: as an option names it (`EPSG:32632+3855`), or any other name.
        heights: what the heights count from.
        west_south, east_north: longitude and latitude of the box around the content; None: of a local frame.
        height_range: least and largest height, in the file's vertical system; None: not recorded.
        lineage: sentences on how the file came about, and what limits its use.
    """

    title: str
    abstract: str
    crs: str
    heights: str
    west_south: tuple[float, float] | None
    east_north: tuple[float, float] | None
    height_range: tuple[float, float] | None
    lineage: Sequence[str]
    quality: Sequence[QualityElement]


def headline_quality(headline: Headline | None) -> tuple[QualityElement, ...]:
    """Return the quality elements of the accuracy of a result; none where it is not known."""
    if headline is None or headline.rmse_h_m is None:
        return ()
    measured = headline.kind == "measured"
    of_plan, upright = (RMSE_PLAN, RMSE) if measured else (PREDICTED_RMS, PREDICTED_RMS)
    method: Literal["directExternal", "directInternal"] = "directExternal" if measured else "directInternal"
    lengths = ((of_plan, "horizontal", headline.rmse_h_m), (upright, "vertical", headline.rmse_v_m))
    return tuple(
        QualityElement(kind, f"{axis} accuracy, {headline.text}", value, method)
        for kind, axis, value in lengths
        if value is not None
    )


def iso_xml(metadata: IsoMetadata) -> str:
    """Return the XML of a file's metadata, made today."""
    for prefix, space in _SPACES.items():
        register_namespace(prefix, space)
    today = datetime.now(UTC).date().isoformat()
    processor = (
        _text("organisationName", f"processed with GeoRefGS {__version__}"),
        _code("role", "CI_RoleCode", "processor"),
    )
    root = _node(
        "MD_Metadata",
        _text("fileIdentifier", metadata.title),
        _code("language", "LanguageCode", "eng"),
        _code("characterSet", "MD_CharacterSetCode", "utf8"),
        _code("hierarchyLevel", "MD_ScopeCode", "dataset"),
        _node("contact/CI_ResponsibleParty", *processor),
        _node("dateStamp/gco:Date", today),
        _text("metadataStandardName", "ISO 19115:2003/19139"),
        _text("metadataStandardVersion", "1.0"),
        *_reference_systems(metadata),
        _node(
            "identificationInfo/MD_DataIdentification",
            _node(
                "citation/CI_Citation",
                _text("title", metadata.title),
                _node(
                    "date/CI_Date",
                    _node("date/gco:Date", today),
                    _code("dateType", "CI_DateTypeCode", "creation"),
                ),
            ),
            _text("abstract", metadata.abstract),
            _node("pointOfContact/CI_ResponsibleParty", *processor),
            _code("language", "LanguageCode", "eng"),
            _node("topicCategory/MD_TopicCategoryCode", "imageryBaseMapsEarthCover"),
            _node("extent/EX_Extent", *_extent(metadata)),
        ),
        _node(
            "dataQualityInfo/DQ_DataQuality",
            _node("scope/DQ_Scope", _code("level", "MD_ScopeCode", "dataset")),
            *map(_accuracy, metadata.quality),
            _text("lineage/LI_Lineage/statement", " ".join(metadata.lineage)),
        ),
    )
    indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _extent(metadata: IsoMetadata) -> list[Element]:
    extent: list[Element] = []
    if metadata.west_south is None or metadata.east_north is None:
        extent.append(_text("description", "local metric frame, without a place on Earth"))
    else:
        (west, south), (east, north) = metadata.west_south, metadata.east_north
        sides = {"westBoundLongitude": west, "eastBoundLongitude": east}
        sides |= {"southBoundLatitude": south, "northBoundLatitude": north}
        box = [_node(f"{name}/gco:Decimal", f"{value:.8f}") for name, value in sides.items()]
        extent.append(_node("geographicElement/EX_GeographicBoundingBox", *box))
    if metadata.height_range is not None:
        low, high = metadata.height_range
        heights = [_node("minimumValue/gco:Real", repr(low)), _node("maximumValue/gco:Real", repr(high))]
        system = _node("verticalCRS", **{"xlink:title": metadata.heights})
        extent.append(_node("verticalElement/EX_VerticalExtent", *heights, system))
    return extent


def _accuracy(element: QualityElement) -> Element:
    name, number = element.measure
    return _node(
        "report/DQ_AbsoluteExternalPositionalAccuracy",
        _text("nameOfMeasure", name),
        *([_text("measureIdentification/MD_Identifier/code", number)] if number else []),
        _text("measureDescription", element.description),
        _code("evaluationMethodType", "DQ_EvaluationMethodTypeCode", element.method),
        _node(
            "result/DQ_QuantitativeResult",
            _node("valueUnit", **{"xlink:href": _METRE, "xlink:title": "metre"}),
            _node("value/gco:Record", repr(element.value_m)),
        ),
    )


def _reference_systems(metadata: IsoMetadata) -> list[Element]:
    """Return the horizontal reference system, or both in one, and the vertical one."""
    epsg = _EPSG.fullmatch(metadata.crs)
    codes = [metadata.crs] if epsg is None else [code for code in epsg.groups() if code is not None]
    space = [] if epsg is None else [_text("codeSpace", "EPSG")]
    systems = [[_text("code", code), *space] for code in codes]
    if len(systems) == 1:
        systems.append([_text("code", f"heights: {metadata.heights}")])
    place = "referenceSystemInfo/MD_ReferenceSystem/referenceSystemIdentifier/RS_Identifier"
    return [_node(place, *system) for system in systems]


def _node(path: str, *content: Element | str, **attributes: str) -> Element:
    """Return nested elements by their names, of `gmd` unless another is named; the innermost has the content."""
    outer, _, inner = path.partition("/")
    if inner:
        node = Element(_qualified(outer))
        node.append(_node(inner, *content, **attributes))
        return node
    node = Element(
        _qualified(outer),
        {(_qualified(name) if ":" in name else name): printable(value) for name, value in attributes.items()},
    )
    for part in content:
        if isinstance(part, str):
            node.text = printable(part)
        else:
            node.append(part)
    return node


def _qualified(name: str) -> str:
    prefix, _, local = name.rpartition(":")
    return f"{{{_SPACES[prefix or 'gmd']}}}{local}"


def _text(path: str, value: str) -> Element:
    return _node(f"{path}/gco:CharacterString", value)


def _code(tag: str, code_list: str, value: str) -> Element:
    return _node(f"{tag}/{code_list}", value, codeList=_CODES + code_list, codeListValue=value)
