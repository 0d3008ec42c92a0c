"""Metadata after ISO 19115 with quality elements after ISO 19157, as the XML of ISO 19139 that GIS catalogues read.

The elements stand in the order of the schema `gmd` of 2007-04-17. Numbers of measures are those of ISO 19157, annex
D (ISO/TS 19138 has the same). Lengths are in metres, latitude and longitude in degrees on WGS84.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
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
        west_south, east_north: longitude and latitude of the box around the content.
        height_range: least and largest height, in the file's vertical system; None: not recorded.
        lineage: sentences on how the file came about, and what limits its use.
    """

    title: str
    abstract: str
    crs: str
    heights: str
    west_south: tuple[float, float]
    east_north: tuple[float, float]
    height_range: tuple[float, float] | None
    lineage: Sequence[str]
    quality: Sequence[QualityElement]


def headline_quality(headline: Headline | None) -> tuple[QualityElement, ...]:
    """Return the quality elements of the accuracy of a result; none where it is not known."""
    if headline is None or headline.rmse_h_m is None or headline.rmse_v_m is None:
        return ()
    measured = headline.kind == "measured"
    of_plan, upright = (RMSE_PLAN, RMSE) if measured else (PREDICTED_RMS, PREDICTED_RMS)
    method: Literal["directExternal", "directInternal"] = "directExternal" if measured else "directInternal"
    return (
        QualityElement(of_plan, f"horizontal accuracy, {headline.text}", headline.rmse_h_m, method),
        QualityElement(upright, f"vertical accuracy, {headline.text}", headline.rmse_v_m, method),
    )


def iso_xml(metadata: IsoMetadata, made: date | None = None) -> str:
    """Return the XML of a file's metadata, made today unless a date is given."""
    for prefix, space in _SPACES.items():
        register_namespace(prefix, space)
    today = (made or datetime.now(UTC).date()).isoformat()
    root = _node(
        "gmd:MD_Metadata",
        _text("gmd:fileIdentifier", metadata.title),
        _code("gmd:language", "LanguageCode", "eng"),
        _code("gmd:characterSet", "MD_CharacterSetCode", "utf8"),
        _code("gmd:hierarchyLevel", "MD_ScopeCode", "dataset"),
        _processor("gmd:contact"),
        _node("gmd:dateStamp", _node("gco:Date", today)),
        _text("gmd:metadataStandardName", "ISO 19115:2003/19139"),
        _text("gmd:metadataStandardVersion", "1.0"),
        *(_reference_system(*parts) for parts in _reference_systems(metadata)),
        _node("gmd:identificationInfo", _identification(metadata, today)),
        _node("gmd:dataQualityInfo", _quality(metadata)),
    )
    indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _identification(metadata: IsoMetadata, today: str) -> Element:
    (west, south), (east, north) = metadata.west_south, metadata.east_north
    sides = {"westBoundLongitude": west, "eastBoundLongitude": east}
    sides |= {"southBoundLatitude": south, "northBoundLatitude": north}
    box = [_node(f"gmd:{name}", _node("gco:Decimal", f"{value:.8f}")) for name, value in sides.items()]
    extent = [_node("gmd:geographicElement", _node("gmd:EX_GeographicBoundingBox", *box))]
    if metadata.height_range is not None:
        low, high = (_node("gco:Real", repr(value)) for value in metadata.height_range)
        system = _node("gmd:verticalCRS", **{"xlink:title": metadata.heights})
        heights = (_node("gmd:minimumValue", low), _node("gmd:maximumValue", high), system)
        extent.append(_node("gmd:verticalElement", _node("gmd:EX_VerticalExtent", *heights)))
    made = _node("gmd:date", _node("gco:Date", today))
    date_of = _node("gmd:CI_Date", made, _code("gmd:dateType", "CI_DateTypeCode", "creation"))
    citation = _node("gmd:CI_Citation", _text("gmd:title", metadata.title), _node("gmd:date", date_of))
    return _node(
        "gmd:MD_DataIdentification",
        _node("gmd:citation", citation),
        _text("gmd:abstract", metadata.abstract),
        _processor("gmd:pointOfContact"),
        _code("gmd:language", "LanguageCode", "eng"),
        _node("gmd:topicCategory", _node("gmd:MD_TopicCategoryCode", "imageryBaseMapsEarthCover")),
        _node("gmd:extent", _node("gmd:EX_Extent", *extent)),
    )


def _quality(metadata: IsoMetadata) -> Element:
    reports = [_node("gmd:report", _accuracy(element)) for element in metadata.quality]
    statement = _text("gmd:statement", " ".join(metadata.lineage))
    return _node(
        "gmd:DQ_DataQuality",
        _node("gmd:scope", _node("gmd:DQ_Scope", _code("gmd:level", "MD_ScopeCode", "dataset"))),
        *reports,
        _node("gmd:lineage", _node("gmd:LI_Lineage", statement)),
    )


def _accuracy(element: QualityElement) -> Element:
    name, number = element.measure
    code = _node("gmd:MD_Identifier", _text("gmd:code", number))
    unit = _node("gmd:valueUnit", **{"xlink:href": _METRE, "xlink:title": "metre"})
    value = _node("gmd:value", _node("gco:Record", repr(element.value_m)))
    return _node(
        "gmd:DQ_AbsoluteExternalPositionalAccuracy",
        _text("gmd:nameOfMeasure", name),
        *([_node("gmd:measureIdentification", code)] if number else []),
        _text("gmd:measureDescription", element.description),
        _code("gmd:evaluationMethodType", "DQ_EvaluationMethodTypeCode", element.method),
        _node("gmd:result", _node("gmd:DQ_QuantitativeResult", unit, value)),
    )


def _reference_systems(metadata: IsoMetadata) -> list[tuple[str, str]]:
    """Return code and name space of the reference systems: horizontal, or both in one, then vertical."""
    epsg = _EPSG.fullmatch(metadata.crs)
    if epsg is None:
        return [(metadata.crs, ""), (f"heights: {metadata.heights}", "")]
    found = [(code, "EPSG") for code in epsg.groups() if code is not None]
    return found if len(found) == 2 else [*found, (f"heights: {metadata.heights}", "")]


def _reference_system(code: str, space: str) -> Element:
    named = [_text("gmd:codeSpace", space)] if space else []
    identifier = _node("gmd:RS_Identifier", _text("gmd:code", code), *named)
    system = _node("gmd:MD_ReferenceSystem", _node("gmd:referenceSystemIdentifier", identifier))
    return _node("gmd:referenceSystemInfo", system)


def _processor(tag: str) -> Element:
    program = _text("gmd:organisationName", f"processed with GeoRefGS {__version__}")
    return _node(tag, _node("gmd:CI_ResponsibleParty", program, _code("gmd:role", "CI_RoleCode", "processor")))


def _node(tag: str, *content: Element | str, **attributes: str) -> Element:
    """Return an element of its prefixed name, with texts or elements in it."""
    node = Element(_qualified(tag), {_qualified(name): printable(value) for name, value in attributes.items()})
    for part in content:
        if isinstance(part, str):
            node.text = printable(part)
        else:
            node.append(part)
    return node


def _qualified(name: str) -> str:
    prefix, _, local = name.rpartition(":")
    return f"{{{_SPACES[prefix]}}}{local}" if prefix else local


def _text(tag: str, value: str) -> Element:
    return _node(tag, _node("gco:CharacterString", value))


def _code(tag: str, code_list: str, value: str) -> Element:
    return _node(tag, _node(f"gmd:{code_list}", value, codeList=_CODES + code_list, codeListValue=value))
