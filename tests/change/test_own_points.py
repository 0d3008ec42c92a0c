"""A date's own tie points decide whether a surface has changed, or lies beside what its photographs show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from pipelines.adjust.relative import Solved
from pipelines.change.datum import load_epoch
from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run
from pipelines.core.products import load_json
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.geotiff import raster_frame, sampled_raster
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_lla, enu_from_ecef, lla_from_enu
from pipelines.survey.change_report import Change
from tests.change_pairs import town_pair

pytestmark = pytest.mark.usefixtures("one_thread")

LIFTED_M = 0.6


def put_on(raster: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the tie points of every date lie on the surface of a raster, as they do where nothing has changed."""
    tracks = Solved.tracks
    crs = parse_crs(raster_frame(raster).wkt)

    def on_surface(self: Solved, ids: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
        place, *rays = tracks(self, ids)
        xyz = crs.xyz_from_lla(lla_from_enu(place, self.origin))
        on_raster = sampled_raster(raster, xyz[:, :2])
        xyz[:, 2] = np.where(np.isfinite(on_raster), on_raster, xyz[:, 2])
        return (enu_from_ecef(ecef_from_lla(crs.lla_from_xyz(xyz)), self.origin), *rays)

    monkeypatch.setattr(Solved, "tracks", on_surface)


def tie_points(workspace: Workspace) -> FloatArray:
    """Return the tie points of a date in the plan of its rasters (K, 2)."""
    epoch = load_epoch(workspace)
    solved = Solved(epoch.posterior, epoch.survey.origin_on_earth)
    lla = lla_from_enu(solved.point_in_geo, epoch.survey.origin_on_earth)
    return parse_crs(raster_frame(workspace.root / "raster/dsm.tif").wkt).xyz_from_lla(lla)[:, :2]


@pytest.mark.parametrize(("known", "reach_m"), [(True, 10.0), (False, 5.0)])
def test_a_surface_beside_its_points_has_not_changed(
    tmp_path: Path, known: bool, reach_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disc of the later surface lies 0.6 m too high: doubtful where tie points know better, else found."""
    before, after = town_pair(tmp_path, changed=False).workspaces
    place = tie_points(after)
    put_on(before.root / "raster/dsm.tif", monkeypatch)
    with rasterio.open(after.root / "raster/dsm.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as raster:
        row, column = np.indices(raster.shape)
        east, north = raster.transform * (column + 0.5, row + 0.5)
        cells = np.stack([east, north], axis=-1)
        heights = raster.read(1)
        window = 2 * round(1.5 * reach_m / raster.transform.a) + 1
        level = maximum_filter(heights, window) - minimum_filter(heights, window) < 1.0  # walls hide a change
        candidates = cells[level & (np.abs(cells - cells.mean(axis=(0, 1))).max(axis=-1) < 30.0)]
        count = np.array([len(near) for near in cKDTree(place).query_ball_point(candidates, reach_m - 1.0)])
        middle = candidates[count.argmax() if known else count.argmin()]
        assert count.max() >= 3 if known else count.min() == 0
        lifted = np.linalg.norm(cells - middle, axis=-1) < reach_m
        raster.write(np.where(lifted, heights + LIFTED_M, heights).astype(heights.dtype), 1)
    (out := tmp_path / "out").mkdir()
    summary = run(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=True))
    change = load_json(Change, out / "change.json")
    told = [remark.code for remark in summary.warnings]
    if known:
        assert [(region.name, region.reason) for region in change.doubtful] == [("D1", "surface-contradicted")]
        assert not change.regions
        assert "surface-contradicted" in told
        return
    (region,) = change.regions
    assert region.net_m3 == pytest.approx(LIFTED_M * np.pi * reach_m**2, rel=0.1)
    assert not change.doubtful
    assert "surface-contradicted" not in told
