"""Change between epochs that points in common tie: without registration, by the σ of their difference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.affinity

from pipelines.adjust.relative import Solved
from pipelines.change.datum import load_epoch
from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run
from pipelines.change.tied import contradicted, tied_by
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import COMMON_POINTS, MODEL, SIM3
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.formats.geotiff import read_cells
from pipelines.geodesy.crs import parse_crs
from pipelines.survey.adjustment import InitialSimilarity
from pipelines.survey.change_report import Change, ChangedRegion
from pipelines.survey.common_points import CommonPoints, solution_hash
from pipelines.survey.trained_model import TrainedModel
from tests.change_pairs import TownPair, town_pair
from tests.trained_workspaces import trained_workspace, write_adjustment

pytestmark = pytest.mark.usefixtures("one_thread")


def tie(after: Workspace, before: Workspace) -> None:
    """Adjust an epoch onto another, all points of which it has in common."""
    epoch = load_epoch(before)
    date = Solved(epoch.posterior, epoch.survey.origin_on_earth)
    ids = epoch.posterior.sparse.point_id
    position, cov = date.placed(ids)
    similarity, pivot = date.similarity_in_ecef
    CommonPoints(
        point_id=ids,
        earlier_point_id=ids,
        matches=np.full(len(ids), 3),
        position_in_ecef=position,
        cov_in_ecef=cov,
        sigma_m=date.sigma_m,
        cov_similarity=similarity,
        pivot_in_ecef=pivot,
        spread=np.asarray(1.0),
        found=np.asarray(len(ids)),
        factor=np.asarray(1.0),
        checked=np.asarray(True),
        earlier=str(before.root),
        solution=solution_hash(before),
    ).save(after.root / COMMON_POINTS)
    initial = load_json(InitialSimilarity, after.path(SIM3))
    save_json(initial.model_copy(update={"tied": True}), after.root / SIM3)
    write_adjustment(after)


def test_steps_add_up(tmp_path: Path) -> None:
    spring, summer, autumn, winter = (trained_workspace(tmp_path / name)[1] for name in ("a", "b", "c", "d"))
    tie(summer, spring)
    tie(autumn, summer)
    model = load_json(TrainedModel, winter.path(MODEL))  # all four are alike: one more iteration tells it apart
    save_json(model.model_copy(update={"iterations": model.iterations + 1}), winter.root / MODEL)
    tie(winter, spring)
    crs, plan = parse_crs("EPSG:32632"), np.array([[403000.0, 5094500.0]])

    def variance(before: Workspace, after: Workspace) -> tuple[int, np.ndarray]:
        tied, _ = tied_by((load_epoch(before), load_epoch(after)), (before, after))
        assert tied is not None
        return tied.common.steps, tied.variance_at(crs, plan)

    one, two, aside = variance(spring, summer), variance(summer, autumn), variance(spring, winter)
    assert (one[0], two[0], aside[0]) == (1, 1, 1)
    # A chain, and two dates that were both tied to a third.
    for (before, after), parts in (((spring, autumn), (one, two)), ((autumn, winter), (one, two, aside))):
        steps, total = variance(before, after)
        assert steps == len(parts)
        np.testing.assert_allclose(total, sum(part[1] for part in parts), rtol=1e-6)


def compared(before: Workspace, after: Workspace, out: Path) -> tuple[Change, Summary]:
    out.mkdir()
    summary = run(StageRun(after, out), ChangeOptions(before=before.root))
    return load_json(Change, out / "change.json"), summary


@pytest.fixture
def pair(tmp_path: Path) -> TownPair:
    made = town_pair(tmp_path, changed=True)
    tie(made.workspaces[1], made.workspaces[0])
    return made


def test_tied_epochs_need_no_registration(pair: TownPair, tmp_path: Path) -> None:
    before, after = pair.workspaces
    change, summary = compared(before, after, tmp_path / "out")
    assert change.common is not None
    assert not change.registration.applied
    assert not change.registration.contradicts
    # Of eighty points whose marks are right to 0.3 px, of 5 cm on the ground, a place has that of its neighbours.
    assert 0.001 < change.common.sigma_v_m < 0.02
    assert change.registration.datum_sigma_v_m == pytest.approx(change.common.sigma_v_m, rel=0.5)
    classes = read_cells(tmp_path / "out/significant.tif")[0]
    changed, marked = np.abs(pair.risen_m), classes > 1
    assert (changed[marked] > 0.05).mean() >= 0.95
    assert marked[(changed > 0.2) & (classes > 0)].mean() >= 0.9
    places = json.loads((tmp_path / "out/common_points.geojson").read_text("utf-8"))["features"]
    assert len(places) == change.common.points
    assert sum(place["properties"]["used"] for place in places) == change.common.used
    assert "<circle" in (tmp_path / "out/change.html").read_text("utf-8")
    assert summary.values["common"] == change.common.model_dump()


def test_points_that_stand_still_contradict_a_region(tmp_path: Path) -> None:
    spring, autumn = (trained_workspace(tmp_path / name)[1] for name in ("spring", "autumn"))
    tie(autumn, spring)
    tied, _ = tied_by((load_epoch(spring), load_epoch(autumn)), (spring, autumn))
    assert tied is not None
    crs = parse_crs("EPSG:32632")
    plan = crs.xyz_from_lla(tied.lla())[:, :2]
    around = shapely.MultiPoint(plan).convex_hull.buffer(1.0)
    aside = shapely.affinity.translate(around, xoff=1000.0)
    region = ChangedRegion(
        name="R1", area_m2=100.0, cut_m3=0.0, fill_m3=40.0, net_m3=40.0, sigma_m3=1.0, lowest_m=0.0, highest_m=0.5
    )
    flat = region.model_copy(update={"name": "R2", "fill_m3": 0.01, "net_m3": 0.01})
    given = region.model_copy(update={"name": "P1"})
    regions, polygons = (region, region.model_copy(update={"name": "R3"}), given), (around, aside, around)
    assert contradicted(tied, regions, polygons, crs) == ["R1"]
    # The points' own noise, of centimetres, says nothing of a change of a tenth of a millimetre.
    up = abs(float(np.median(tied.missed_m[tied.used, 2])))
    assert contradicted(tied, (flat,), (around,), crs) == (["R2"] if up < 5e-5 else [])


def test_either_order_is_recognised_and_another_solution_is_not(pair: TownPair, tmp_path: Path) -> None:
    before, after = pair.workspaces
    forwards = load_epoch(after).posterior.solution.earlier
    assert forwards is not None
    assert forwards.workspace == str(before.root)
    backwards, _ = compared(after, before, tmp_path / "backwards")
    assert backwards.common is not None
    path = before.root / MODEL
    path.write_text(path.read_text("utf-8") + "\n", "utf-8")  # solved again, by its bytes
    change, summary = compared(before, after, tmp_path / "again")
    assert change.common is None
    assert "earlier-solved-again" in {remark.code for remark in summary.warnings}
