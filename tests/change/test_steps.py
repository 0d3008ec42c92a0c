"""Walls, rims and interpolated cells: no change by themselves, and in a volume with their σ."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from pipelines.change.grid import step_variance
from pipelines.change.options import ChangeOptions
from pipelines.change.regions import is_real
from pipelines.change.stage import run
from pipelines.core.fingerprints import fingerprints
from pipelines.core.products import load_json
from pipelines.core.stages import CHANGE, CLOUD
from pipelines.core.staleness import StageState, changed_inputs
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.geotiff import read_cells
from pipelines.survey.change_report import Change
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_solution
from pipelines.view.page_scene import changed_regions
from pipelines.view.pictures import frame_of
from tests.change_pairs import CELL_M, TownPair, town_pair


def compared(pair: TownPair, out: Path) -> tuple[NDArray[np.uint8], Change]:
    """Classes (H, W) and product of a comparison that is registered on unchanged ground."""
    out.mkdir()
    before, after = pair.workspaces
    run(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=True))
    return read_cells(out / "significant.tif")[0], load_json(Change, out / "change.json")


def test_displaced_walls_are_no_change(tmp_path: Path) -> None:
    """Walls half a cell apart, as far as a raster can tell them: every second of their cells differs by metres."""
    pair = town_pair(tmp_path, changed=False)
    classes, change = compared(pair, tmp_path / "out")
    assert (classes > 1).mean() <= 0.05
    assert change.regions == ()
    assert (classes == 0).mean() < 0.03  # the interpolated cells


def test_changes_are_found_between_displaced_walls(tmp_path: Path) -> None:
    pair = town_pair(tmp_path, changed=True)
    classes, change = compared(pair, tmp_path / "out")
    changed, marked = np.abs(pair.risen_m), classes > 1
    assert (changed[marked] > 0.05).mean() >= 0.95
    assert marked[(changed > 0.2) & (classes > 0)].mean() >= 0.9
    # A house gone, a new one, a pit and a heap, of which each is one region with its volume.
    risen = pair.risen_m * CELL_M**2
    sides = np.split(np.arange(risen.shape[0]), [180, 325])
    house_gone, house_new = risen[sides[0]].sum(), risen[sides[1]].sum()
    pit, heap = (risen[sides[2]][:, columns].sum() for columns in (slice(None, 155), slice(155, None)))
    found = sorted(region.net_m3 for region in change.regions)
    assert found == pytest.approx(sorted([house_gone, house_new, pit, heap]), rel=0.05)
    for region, true in zip(
        sorted(change.regions, key=lambda one: one.net_m3), sorted([house_gone, house_new, pit, heap]), strict=True
    ):
        assert abs(region.net_m3 - true) < 2.5 * region.sigma_m3


def test_a_wall_beside_unknown_ground_is_in_no_volume(tmp_path: Path) -> None:
    """Of a house that was pulled down, the earlier date has measured no roof, and its wall a cell too far outside.

    Those cells are metres lower later, which neither of them is: nothing shows the wall that they belong to. A
    polygon of the roof alone has no volume, and the others keep their names.
    """
    pair = town_pair(tmp_path, changed=True)
    before, after = pair.workspaces
    house = pair.risen_m < -2.0
    wall = binary_dilation(house) & ~house
    with rasterio.open(before.root / "raster/dsm.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as raster:
        heights = raster.read(1)
        roof = heights[house].max()
        raster.write(np.select([house, wall], [raster.nodata, roof], heights).astype(heights.dtype), 1)
        row, column = np.nonzero(binary_dilation(house, iterations=8))
        (west, south), (east, north) = (
            raster.transform * (column.min(), row.max() + 1),
            raster.transform * (column.max() + 1, row.min()),
        )
    polygons = tmp_path / "house.geojson"
    wide = shapely.box(west, south, east, north)
    roof_alone = wide.buffer(-8 * CELL_M, join_style="mitre")
    rings = [shapely.geometry.mapping(one)["coordinates"] for one in (roof_alone, wide)]
    polygons.write_text(json.dumps({"type": "MultiPolygon", "coordinates": rings}), "utf-8")
    (out := tmp_path / "out").mkdir()
    options = {"before": before.root, "stable_auto": True, "regions": polygons, "polygons_crs": "EPSG:32632"}
    summary = run(StageRun(after, out), ChangeOptions.model_validate(options))
    change = load_json(Change, out / "change.json")
    assert change.unmeasured == {"P1": 0.0}
    assert "region-not-measured" in {warning.code for warning in summary.warnings}
    region = change.regions[0]
    assert region.name == "P2"
    assert 0.25 < region.known_share < 0.9
    assert wall.sum() * CELL_M**2 * 4.0 > 30.0  # what the wall's cells would say
    assert abs(region.net_m3) < 2.5 * region.sigma_m3 < 10.0


def test_the_rim_of_what_is_measured_tells_no_change(tmp_path: Path) -> None:
    """Around a hole the later surface errs by 0.6 m, as surfaces do where few photographs see the ground.

    So far from the hole as errors are one there is nothing more to see. A heap of that height is found elsewhere.
    """
    pair = town_pair(tmp_path, changed=False)
    before, after = pair.workspaces
    level = [
        (row, column)
        for row in range(20, pair.after.shape[0] - 20, 5)
        for column in range(20, pair.after.shape[1] - 20, 5)
        if np.ptp(pair.after[row - 20 : row + 20, column - 20 : column + 20]) < 0.5
    ]
    places = np.array(level)
    (first_row, first_column), (row, column) = (
        level[0],
        level[int(np.argmax(np.linalg.norm(places - places[0], axis=1)))],
    )
    hole, heap = (np.zeros(pair.after.shape, dtype=bool) for _ in range(2))
    hole[first_row - 8 : first_row + 8, first_column - 8 : first_column + 8] = True
    heap[row - 8 : row + 8, column - 8 : column + 8] = True
    with rasterio.open(after.root / "raster/dsm.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as raster:
        heights = raster.read(1)
        heights[heap | binary_dilation(hole, iterations=6)] += 0.6
        raster.write(np.where(hole, raster.nodata, heights).astype(heights.dtype), 1)
    (out := tmp_path / "out").mkdir()
    run(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=True))
    found = load_json(Change, out / "change.json").regions
    assert [region.name for region in found] == ["R1"]
    assert found[0].net_m3 == pytest.approx(0.6 * heap.sum() * CELL_M**2, rel=0.1)


@pytest.mark.slow
def test_the_viewer_draws_regions_on_the_surface(tmp_path: Path) -> None:
    pair = town_pair(tmp_path, changed=True)
    before, after = pair.workspaces
    (after.root / "change").mkdir()
    run(StageRun(after, after.root / "change"), ChangeOptions(before=before.root, stable_auto=True))
    change = load_json(Change, after.root / "change" / "change.json")
    solution, survey = read_solution(after), load_survey(after)
    frame = frame_of(solution, read_sfm(after, solution))
    drawn = changed_regions(after, survey, frame)
    assert [each["text"].partition(":")[0] for each in drawn] == [region.name for region in change.regions]
    for each, region in zip(drawn, change.regions, strict=True):
        assert each["raised"] == (region.net_m3 > 0)
        plan = np.array(each["at"])[:, :2]
        assert shapely.Polygon(plan).area == pytest.approx(region.area_m2, rel=0.3)  # between the cells that count
    height = np.concatenate([np.array(each["at"])[:, 2] for each in drawn]) + frame.middle_in_geo[2]
    lowest, highest = pair.after.min() - survey.origin.alt_m, pair.after.max() - survey.origin.alt_m
    assert ((height > lowest - 1) & (height < highest + 1)).all()


def test_a_wall_has_the_variance_of_its_relief() -> None:
    """A wall of 6 m between two cells: both may be of either height. A slope of 30° and noise are no relief."""
    row, column = np.indices((40, 60), dtype=np.float64)
    wall = np.where(column >= 30, 6.0, 0.0)
    sigma = np.full(wall.shape, 0.02)
    variance = step_variance(wall, sigma, 0.25, 1)
    assert variance[:, 29:31] == pytest.approx((6.0 - 0.12) ** 2 / 3)
    assert not variance[:, :29].any()
    assert not variance[:, 31:].any()
    slope = np.tan(np.radians(30)) * 0.25 * (0.8 * column + 0.6 * row)
    noisy = slope + np.random.default_rng(0).normal(0, 0.02, slope.shape)
    assert (step_variance(noisy, sigma, 0.25, 1) > 0.06**2)[1:-1, 1:-1].mean() < 0.1
    assert not step_variance(np.full(wall.shape, np.nan), sigma, 0.25, 1).any()


def test_noise_makes_a_region_in_one_of_twenty_scenes() -> None:
    places, rng = 200, np.random.default_rng(0)
    scenes = [is_real(rng.normal(0, 2.0, places), np.full(places, 2.0), places).any() for _ in range(2000)]
    assert 0.03 < np.mean(scenes) < 0.07
    assert is_real(np.array([-20.0]), np.array([2.0]), places).all()


def test_change_is_stale_after_either_epoch_is_made_anew(tmp_path: Path) -> None:
    before, after = town_pair(tmp_path, changed=False).workspaces
    options = ChangeOptions(before=before.root, stable_auto=True)

    def known() -> dict[str, str]:
        return fingerprints(after, CHANGE, options, {}).hashes

    hashes = known()
    (before.root / CLOUD).parent.mkdir()
    for path in (before.root / "raster/dsm.tif", after.root / "raster/dsm.tif", before.root / CLOUD):
        path.write_bytes((path.read_bytes() if path.exists() else b"") + b"anew")
        earlier, hashes = hashes, known()
        assert changed_inputs(hashes, earlier)
    (before.root / "raster/notes.tif").touch()
    assert known() == hashes


def test_rasters_older_than_their_survey_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, after = town_pair(tmp_path, changed=False).workspaces
    (out := tmp_path / "out").mkdir()

    def state(workspace: Workspace) -> list[StageState]:
        return [StageState("export-raster", "stale" if workspace == before else "current", "init-sim3 is stale")]

    monkeypatch.setattr("pipelines.change.stage.status", state)
    summary = run(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=True))
    (told,) = summary.warnings
    assert told.code == "epoch-stale"
    assert told.sentence.startswith("The rasters of spring are stale (init-sim3 is stale).")
    assert "The rasters of spring are stale" in (out / "change.html").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("shift_m", [0.03, 0.5])
def test_a_shifted_base_is_found_or_within_sigma_or_told(tmp_path: Path, shift_m: float) -> None:
    """A wrong base: found on unchanged ground; without registration, within the datum's σ, or told."""
    before, after = town_pair(tmp_path, changed=False, shift_m=shift_m).workspaces
    found = {}
    for registered in (True, False):
        (out := tmp_path / f"registered_{registered}").mkdir()
        summary = run(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=registered))
        change = load_json(Change, out / "change.json")
        classes = read_cells(out / "significant.tif")[0]
        found[registered] = change.registration, float((classes > 1).mean()), [one.code for one in summary.warnings]
    registration, false_alarms, told = found[True]
    assert abs(registration.shift_m[2] - shift_m) < 3 * registration.sigma_shift_m[2] < 0.02
    assert registration.applied and false_alarms <= 0.05 and not told
    registration, false_alarms, told = found[False]
    within = shift_m < 1.96 * registration.datum_sigma_v_m
    # Not within, tie points contradict the surface as well, since the rasters alone were lifted.
    assert [one for one in told if one != "surface-contradicted"] == ([] if within else ["epochs-shifted"])
    assert not within or false_alarms <= 0.05
