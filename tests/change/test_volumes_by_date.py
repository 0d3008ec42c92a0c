"""Volumes by date along a chain of tied dates: a pit and a heap that grow, a date without rasters, and no chain."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.warp import transform_bounds
from rich.console import Console

from georef_cli.tables import date_volumes
from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run
from pipelines.core.products import load_json
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.survey.change_report import Change
from tests.change_pairs import CELL_M, epoch_workspace, tie, town_heights

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
GROWN = {"spring": 0.0, "summer": 0.4, "autumn": 1.0}


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Workspace], float]:
    """Return three dates, each tied to the one before, and the true volume of the heap at the last in m³."""
    root = tmp_path_factory.mktemp("chain")
    before, house = town_heights(changed=False)
    after, others = town_heights(changed=True)
    grows = np.where(house | others, 0.0, after - before)
    rng, seen = np.random.default_rng(3), np.ones(before.shape, dtype=bool)
    dates = {name: epoch_workspace(root / name, before + share * grows, seen, rng) for name, share in GROWN.items()}
    tie(dates["summer"], dates["spring"])
    tie(dates["autumn"], dates["summer"])
    return dates, float(grows.clip(min=0.0).sum() * CELL_M**2)


def compared(before: Workspace, after: Workspace, out: Path) -> tuple[Change, Summary]:
    out.mkdir()
    summary = run(StageRun(after, out), ChangeOptions(before=before.root))
    return load_json(Change, out / "change.json"), summary


@pytest.fixture(scope="module")
def ends(
    chain: tuple[dict[str, Workspace], float], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Change, Summary, Path]:
    """Return the comparison of the first and the last date, and its folder."""
    out = tmp_path_factory.mktemp("ends") / "out"
    return *compared(chain[0]["spring"], chain[0]["autumn"], out), out


def test_volumes_grow_by_date(
    chain: tuple[dict[str, Workspace], float], ends: tuple[Change, Summary, Path]
) -> None:
    _, heap_m3 = chain
    change, summary, out = ends
    assert not summary.warnings
    assert [one.name for one in change.by_date] == ["summer", "autumn"]
    names = [region.name for region in change.regions]
    heap = next(place for place, region in enumerate(change.regions) if region.net_m3 > 0)
    for one in change.by_date:
        assert [region.name for region in one.regions] == [*names, "all"]
        assert 0 < one.sigma_v_m < 0.03
        of_heap = one.regions[heap]
        assert of_heap.sigma_m3 < 0.1 * heap_m3
        assert abs(of_heap.net_m3 - GROWN[one.name] * heap_m3) < 3 * of_heap.sigma_m3
    summer, autumn = (one.regions[heap] for one in change.by_date)
    assert summer.since_previous_m3 == summer.net_m3
    assert abs(autumn.since_previous_m3 - 0.6 * heap_m3) < 3 * autumn.sigma_since_previous_m3
    # The heap is as large as the pit: together they are nothing, with a larger σ.
    together = change.by_date[1].regions[-1]
    assert abs(together.net_m3) < 3 * together.sigma_m3
    assert together.net_m3 == change.found.net_m3
    rows = list(csv.reader((out / "by_date.csv").read_text("utf-8").splitlines()))
    assert rows[0][:4] == ["date", "taken_on", "sigma_v_m", "region"]
    assert [row[0] for row in rows[1:]] == ["summer"] * (len(names) + 1) + ["autumn"] * (len(names) + 1)
    assert "Volumes by date" in (out / "change.html").read_text("utf-8")
    text = StringIO()
    Console(width=120, file=text).print(*date_volumes(summary.values["by_date"]))
    assert f"{summer.net_m3:+.1f} ± {summer.sigma_m3:.1f}" in text.getvalue()


def test_a_pair_of_the_chain_says_the_same(
    chain: tuple[dict[str, Workspace], float], ends: tuple[Change, Summary, Path], tmp_path: Path
) -> None:
    dates, _ = chain
    whole, _, out = ends
    path = out / "regions.geojson"
    (tmp_path / "part").mkdir()
    run(StageRun(dates["summer"], tmp_path / "part"), ChangeOptions(before=dates["spring"].root, regions=path))
    part = load_json(Change, tmp_path / "part/change.json")
    given = [region for region in part.regions if region.name.startswith("P")]
    for one, region in zip(whole.by_date[0].regions, given, strict=False):
        assert one.net_m3 == pytest.approx(region.net_m3, rel=1e-3)
        assert one.sigma_m3 == pytest.approx(region.sigma_m3, rel=0.02)
        assert region.known_share > 0.95
    assert not part.by_date  # two dates are one comparison


def test_a_polygon_beyond_the_rasters_says_what_part_counts(
    chain: tuple[dict[str, Workspace], float], tmp_path: Path
) -> None:
    """Of a box twice as wide as the rasters one half has heights."""
    dates, _ = chain
    with rasterio.open(dates["spring"].root / "raster/dsm.tif") as dsm:
        west, south, east, north = transform_bounds(dsm.crs, "EPSG:4326", *dsm.bounds)
    box = shapely.box(west, south, 2 * east - west, north)
    (tmp_path / "box.geojson").write_text(shapely.to_geojson(box), "utf-8")
    (tmp_path / "out").mkdir()
    options = ChangeOptions(before=dates["spring"].root, regions=tmp_path / "box.geojson")
    summary = run(StageRun(dates["autumn"], tmp_path / "out"), options)
    given = load_json(Change, tmp_path / "out/change.json").regions[0]
    # The rasters' sides are not along meridians: their bounds are a little wider than they.
    assert given.name == "P1" and 0.4 < given.known_share < 0.55
    assert "region-partly-known" in {warning.code for warning in summary.warnings}


def test_a_date_without_rasters_is_named(chain: tuple[dict[str, Workspace], float], tmp_path: Path) -> None:
    dates, _ = chain
    folder = dates["summer"].root / "raster"
    hidden = folder.rename(tmp_path / "hidden")
    try:
        change, summary = compared(dates["spring"], dates["autumn"], tmp_path / "out")
    finally:
        hidden.rename(folder)
    assert [remark.code for remark in summary.warnings] == ["date-left-out"]
    assert "summer" in summary.warnings[0].sentence
    assert change.regions and not change.by_date
    assert not (tmp_path / "out/by_date.csv").exists()
