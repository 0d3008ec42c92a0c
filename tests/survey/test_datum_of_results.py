"""Datum of a result's heights: stated only where the survey's is, whatever the result is asked for in."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum, parse_vertical
from pipelines.survey.options import CrsOptions
from pipelines.survey.target_crs import TargetCrs, target_crs, usable_crs

ORIGIN = Origin(lat_deg=46.02, lon_deg=7.75, alt_m=1620.0)
STATED = VerticalDatum(name="ellipsoidal", stated=True, note="--vertical")
ASSUMED = VerticalDatum(name="ellipsoidal", stated=False, note="nobody said")
DEFINED = VerticalDatum(name="ellipsoidal", stated=False, note="NavSatFix", by_definition=True)
ASKED = {
    "nothing": CrsOptions(),
    "a map": CrsOptions(crs="EPSG:32632"),
    "a datum": CrsOptions(vertical=parse_vertical("ellipsoidal")),
    "three dimensions": CrsOptions(crs="EPSG:4979"),
}


def target(asked: str, heights: VerticalDatum) -> TargetCrs:
    return target_crs(ASKED[asked], ORIGIN, np.zeros((1, 3)), heights)


@pytest.mark.parametrize("asked", ASKED)
def test_an_assumption_stays_one(asked: str) -> None:
    result = target(asked, ASSUMED)
    assert result.crs.vertical.is_assumed and "assumed" in result.crs.vertical.described
    # Also where the user names what the file shall have, the product says what it was made from.
    assert any("assumed" in text for text in result.assumed)
    assert not any("as stated" in text for text in result.assumed)


@pytest.mark.parametrize("asked", ASKED)
def test_what_was_stated_is_stated(asked: str) -> None:
    result = target(asked, STATED)
    assert result.crs.vertical.stated and not any("heights were assumed" in text for text in result.assumed)


@pytest.mark.parametrize("asked", ["nothing", "a map"])
def test_a_definition_is_named(asked: str) -> None:
    datum = target(asked, DEFINED).crs.vertical
    assert not datum.stated and not datum.is_assumed and "NavSatFix" in datum.described


def test_a_missing_grid_is_told_as_such() -> None:
    """Without a grid of EGM84, heights fall back to the ellipsoid, and nobody is said to have asked for it."""
    of_geoid = VerticalDatum(name="EGM84", stated=True, note="--vertical")
    result = usable_crs(CrsOptions(), ORIGIN, np.zeros((1, 3)), of_geoid)
    if result.crs.vertical.name == "ellipsoidal":
        assert "EGM84" in result.crs.vertical.note
