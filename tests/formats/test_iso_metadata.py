"""ISO metadata beside a file: order of the schema, and the sidecar's own values."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, parse

import numpy as np
import pytest

from pipelines.core.figures import Headline
from pipelines.core.products import Remark
from pipelines.formats.georef_sidecar import (
    ISO_SUFFIX,
    CrsSidecar,
    GeoreferenceSigma,
    GeorefSidecar,
    SceneSigma,
    write_sidecar,
)
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.vertical import VerticalDatum

GMD, GCO = "{http://www.isotc211.org/2005/gmd}", "{http://www.isotc211.org/2005/gco}"
# Children of each type in the order of the schema `gmd` of 2007-04-17 (ISO 19139); `*`: must be there.
ORDER = {
    "MD_Metadata": "fileIdentifier language characterSet parentIdentifier hierarchyLevel hierarchyLevelName "
    "*contact *dateStamp metadataStandardName metadataStandardVersion dataSetURI locale spatialRepresentationInfo "
    "referenceSystemInfo metadataExtensionInfo *identificationInfo contentInfo distributionInfo dataQualityInfo",
    "MD_DataIdentification": "*citation *abstract purpose credit status pointOfContact resourceMaintenance "
    "graphicOverview resourceFormat descriptiveKeywords resourceSpecificUsage resourceConstraints aggregationInfo "
    "spatialRepresentationType spatialResolution *language characterSet topicCategory environmentDescription "
    "extent supplementalInformation",
    "CI_Citation": "*title alternateTitle *date edition editionDate identifier citedResponsibleParty",
    "CI_Date": "*date *dateType",
    "CI_ResponsibleParty": "individualName organisationName positionName contactInfo *role",
    "MD_ReferenceSystem": "referenceSystemIdentifier",
    "RS_Identifier": "authority *code codeSpace version",
    "MD_Identifier": "authority *code",
    "EX_Extent": "description geographicElement temporalElement verticalElement",
    "EX_GeographicBoundingBox": "extentTypeCode *westBoundLongitude *eastBoundLongitude *southBoundLatitude "
    "*northBoundLatitude",
    "EX_VerticalExtent": "*minimumValue *maximumValue *verticalCRS",
    "DQ_DataQuality": "*scope report lineage",
    "DQ_Scope": "*level extent levelDescription",
    "DQ_AbsoluteExternalPositionalAccuracy": "nameOfMeasure measureIdentification measureDescription "
    "evaluationMethodType evaluationMethodDescription evaluationProcedure dateTime *result",
    "DQ_QuantitativeResult": "valueType *valueUnit errorStatistic *value",
    "LI_Lineage": "statement processStep source",
}
CODES = {"MD_TopicCategoryCode", "CI_DateTypeCode", "CI_RoleCode", "LanguageCode", "MD_CharacterSetCode"}
CODES |= {"MD_ScopeCode", "DQ_EvaluationMethodTypeCode"}
BOUNDS = ((403042.42, 5096866.72, 1618.78), (403437.54, 5097194.96, 1647.79))
SIGMA = SceneSigma(
    counts="cameras and lens",
    median_sigma_h_m=0.043,
    median_sigma_v_m=0.091,
    largest_sigma_h_m=0.25,
    largest_sigma_v_m=0.21,
)
MEASURED = Headline(kind="measured", rmse_h_m=0.0463256962904848, rmse_v_m=0.03158993008143558, check_points=52)
PREDICTED = Headline(kind="predicted", rmse_h_m=0.0251, rmse_v_m=0.0137)
UNKNOWN = Headline(kind="unknown", reason="nothing checks it")


def crs_sidecar(crs: str, accuracy: Headline | None, bounds: object = BOUNDS) -> CrsSidecar:
    parsed = parse_crs(crs)
    return CrsSidecar.model_validate({
        "crs": crs, "crs_wkt": parsed.wkt, "vertical_datum": parsed.vertical, "units": parsed.units,
        "operation": "UTM <32>", "operation_accuracy_m": None, "bounds": bounds, "accuracy": accuracy,
        "sigma": SIGMA,
        "assumed": ("the UTM zone of the scene, as nobody stated a CRS",),
        "cautions": (Remark(code="a", sentence="Half of \x1b /home/me/x.csv is <b>.", remedy="Give --gcp FILE."),),
    })  # fmt: skip


def written(sidecar: CrsSidecar | GeorefSidecar, folder: Path) -> Element:
    write_sidecar(sidecar, folder / "dsm.tif")
    return parse(folder / f"dsm.tif{ISO_SUFFIX}").getroot()


def require_order(node: Element) -> int:
    """Require the schema's order and mandatory children of a node and all below it; return the number of types."""
    assert len(node) <= 1 or node.tag.startswith(GMD)
    name, children = node.tag.removeprefix(GMD), [child.tag.removeprefix(GMD) for child in node]
    seen = 0
    if name[:1].isupper() and name not in CODES and node.tag.startswith(GMD):
        order = ORDER[name].replace("*", "").split()
        places = [order.index(child) for child in children]
        assert places == sorted(places), (name, children)
        assert {part[1:] for part in ORDER[name].split() if part.startswith("*")} <= set(children), name
        seen = 1
    return seen + sum(require_order(child) for child in node)


def accuracies(root: Element) -> list[tuple[str, str | None, str, float]]:
    """Return name, number, method and value of each quality element."""
    found = []
    for element in root.iter(f"{GMD}DQ_AbsoluteExternalPositionalAccuracy"):
        number = element.find(f".//{GMD}code/{GCO}CharacterString")
        method = element.find(f".//{GMD}DQ_EvaluationMethodTypeCode")
        name, value = element.find(f"{GMD}nameOfMeasure/*"), element.find(f".//{GCO}Record")
        assert name is not None and value is not None and method is not None
        of = None if number is None else number.text
        found.append((str(name.text), of, str(method.get("codeListValue")), float(str(value.text))))
    return found


def texts(root: Element, path: str) -> list[str]:
    return [
        str(node.text) for node in root.findall(".//" + "/".join(GMD + part for part in path.split("/")) + "/*")
    ]


def test_elements_stand_in_the_order_of_the_schema(tmp_path: Path) -> None:
    assert require_order(written(crs_sidecar("EPSG:32632", MEASURED), tmp_path)) > 20


def test_values_are_those_of_the_sidecar(tmp_path: Path) -> None:
    root = written(crs_sidecar("EPSG:32632", MEASURED), tmp_path)
    internal = "directInternal"
    drms = "distance root mean square of predicted standard deviations"
    assert accuracies(root) == [
        ("root mean square error of planimetry", "47", "directExternal", MEASURED.rmse_h_m),
        ("root mean square error", "39", "directExternal", MEASURED.rmse_v_m),
        (drms, None, internal, 0.043),
        ("standard linear error", "34", internal, 0.091),
        (drms, None, internal, 0.25),
        ("standard linear error", "34", internal, 0.21),
    ]
    assert texts(root, "RS_Identifier/code") == ["32632", "heights: ellipsoidal (assumed: nobody stated the datum)"]
    sides = [f"{side}Bound{angle}" for side, angle in (("west", "Longitude"), ("south", "Latitude"))]
    corner = [float(texts(root, side)[0]) for side in sides]
    south_west = parse_crs("EPSG:32632").lla_from_xyz([BOUNDS[0]])[0, :2]
    # The box is that of all corners: grid north turns by 0.9°, which moves a side by 6 m, 8e-5°.
    np.testing.assert_allclose(corner, south_west[::-1], atol=1e-4)
    heights = [float(texts(root, f"{end}Value")[0]) for end in ("minimum", "maximum")]
    assert heights == [BOUNDS[0][2], BOUNDS[1][2]]
    (lineage,) = texts(root, "LI_Lineage/statement")
    assert lineage == (
        "Coordinates by the operation UTM <32>. Assumed: the UTM zone of the scene, as nobody stated a CRS. "
        "Half of \\x1b x.csv is <b>."
    )
    assert MEASURED.text in texts(root, "abstract")[0]


@pytest.mark.parametrize(
    ("accuracy", "expected"),
    [
        (PREDICTED, [("root mean square of predicted standard deviations", None, "directInternal")] * 2),
        (UNKNOWN, []),
        (None, []),
    ],
)
def test_what_nobody_measured_is_not_called_measured(
    tmp_path: Path, accuracy: Headline | None, expected: list[tuple[str, None, str]]
) -> None:
    root = written(crs_sidecar("EPSG:32632", accuracy), tmp_path)
    assert [row[:3] for row in accuracies(root)[:-4]] == expected
    require_order(root)


def test_compound_and_geocentric_systems(tmp_path: Path) -> None:
    assert texts(written(crs_sidecar("EPSG:4326", None, ((7.7, 46.0, 1.0), (7.8, 46.1, 2.0))), tmp_path),
                 "westBoundLongitude") == ["7.70000000"]  # fmt: skip
    ecef = ((4397200.0, 598300.0, 4567900.0), (4397400.0, 598600.0, 4568000.0))
    root = written(crs_sidecar("EPSG:4978", None, ecef), tmp_path)
    require_order(root)
    assert not list(root.iter(f"{GMD}EX_VerticalExtent"))  # Z is no height
    assert abs(float(texts(root, "southBoundLatitude")[0]) - 46.02) < 0.01


def test_file_in_a_frame_is_where_its_origin_is(tmp_path: Path) -> None:
    sigma = GeoreferenceSigma(
        at=(0, 0, 0),
        sigma_e_m=0.01,
        sigma_n_m=0.02,
        sigma_u_m=0.03,
        sigma_h_m=0.0223,
        sigma_v_m=0.03,
        sigma_3d_m=0.04,
    )
    sidecar = GeorefSidecar(
        origin=(4397309.9, 598448.1, 4567958.2),
        rotation=(0.0, 0.0, 0.0, 1.0),
        scale=1.0,
        origin_lla=(46.020006, 7.750006, 1620.7),
        vertical_datum=VerticalDatum(name="ellipsoidal", stated=True),
        crs_wkt="",
        covariance=None,
        accuracy=MEASURED,
        georeference_sigma=sigma,
    )
    root = written(sidecar, tmp_path)
    require_order(root)
    assert texts(root, "westBoundLongitude") == texts(root, "eastBoundLongitude") == ["7.75000600"]
    assert [row[3] for row in accuracies(root)] == [MEASURED.rmse_h_m, MEASURED.rmse_v_m, 0.0223, 0.03]
