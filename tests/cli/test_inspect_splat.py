"""`georef inspect` of a splat, as a table and as a document."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.formats.spz import write_spz
from pipelines.formats.spz_extensions import SpzGeoreference
from tests.cli.conftest import Georef
from tests.delivered_scenes import splat_arrays


def test_a_splat_is_shown_with_its_place(georef: Georef, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write_spz(path, splat_arrays(), 4, SpzGeoreference("EPSG:32633", (5e5, 5e6, 100.0), (0.5, 0.5, 0.5, 0.5)))
    document = georef("inspect", path, "--json").document
    assert document["gaussians"] == 40 and document["remarks"][0]["code"] == "place-heights"
    assert document["places"][0]["middle_lla"][:2] == pytest.approx([45.155, 15.0], abs=0.01)
    text = georef("inspect", path).out
    assert "EPSG:32633" in text and "degree 3" in text
