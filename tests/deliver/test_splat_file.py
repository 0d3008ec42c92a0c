"""`georef inspect` of a splat: its places on Earth by the file and by its sidecar, and where the two differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.deliver.options import ExportPlyOptions, ExportSpzOptions
from pipelines.deliver.ply import run as export_ply
from pipelines.deliver.splat_file import inspect_splat
from pipelines.deliver.spz import run as export_spz
from pipelines.formats.spz import spz_georeference, write_spz
from pipelines.formats.spz_extensions import SpzGeoreference
from pipelines.geodesy.enu import ecef_from_lla
from tests.delivered_scenes import splat_arrays, true_ecef, write_trained
from tests.refusals import numbers

SPLAT = splat_arrays()
STEP_M = 2**-12  # of SPZ's positions


def exported(folder: Path) -> Path:
    """Return an SPZ that states its place itself and in its sidecar."""
    stage = write_trained(folder / "ws", SPLAT, "spz")
    export_spz(stage, ExportSpzOptions(spz_version="4", embed_georeference=True))
    return stage.out / "splat.spz"


def spread_m(place_lla: object) -> float:
    """Return the distance from a place to the median of the true places, whose axes are others."""
    return float(np.linalg.norm(ecef_from_lla(np.array(place_lla)) - np.median(true_ecef(SPLAT), axis=0)))


def test_file_and_sidecar_state_one_true_place(tmp_path: Path) -> None:
    """Medians along other axes are other places of the cloud: within a metre of its 5 m."""
    report = inspect_splat(exported(tmp_path))
    assert [place.source for place in report.places] == ["splat.spz", "splat.spz.georef.json"]
    first, second = (np.array(place.middle_lla) for place in report.places)
    np.testing.assert_allclose(ecef_from_lla(first), ecef_from_lla(second), rtol=0, atol=1e-6)
    assert spread_m(first) < 2 and not report.remarks
    assert (report.gaussians, report.sh_degree, report.format) == (len(SPLAT), 3, "SPZ")


def test_a_file_that_was_moved_without_its_sidecar_is_told(tmp_path: Path) -> None:
    path = exported(tmp_path)
    placed = spz_georeference(path.read_bytes())
    assert placed is not None
    x, y, z = placed.origin
    write_spz(path, SPLAT, 4, replace(placed, origin=(x + 0.3, y, z)))
    (remark,) = inspect_splat(path).remarks
    assert remark.code == "place-inconsistent" and 0.3 in numbers(remark.sentence)


@pytest.mark.parametrize(
    ("georeference", "codes"),
    [
        (None, ["no-place"]),
        (SpzGeoreference("IAU_2015:30100", (1.7e6, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), ["place-not-on-earth"]),
        (SpzGeoreference("EPSG:4326", (15.0, 45.0, 100.0), (0.0, 0.0, 0.0, 1.0)), ["place-not-on-earth"]),
        (SpzGeoreference("EPSG:32633", (5e5, 5e6, 100.0), (0.5, 0.5, 0.5, 0.5)), ["place-heights"]),
    ],
)
def test_files_of_others(tmp_path: Path, georeference: SpzGeoreference | None, codes: list[str]) -> None:
    """Without a place, on the moon, in degrees, and on a map: x is easting, y northing."""
    path = tmp_path / "a.spz"
    write_spz(path, SPLAT, 4, georeference)
    report = inspect_splat(path)
    assert [remark.code for remark in report.remarks] == codes
    if codes == ["place-heights"]:
        lat, lon, height_m = report.places[0].middle_lla or (0, 0, 0)
        assert (lat, lon) == pytest.approx((45.155, 15.0), abs=0.01) and height_m == pytest.approx(100, abs=20)


def test_a_ply_has_its_sidecars_place(tmp_path: Path) -> None:
    stage = write_trained(tmp_path / "ws", SPLAT, "export")
    export_ply(stage, ExportPlyOptions())
    (place,) = inspect_splat(stage.out / "splat.ply").places
    assert place.source == "splat.ply.georef.json" and spread_m(place.middle_lla) < 2
