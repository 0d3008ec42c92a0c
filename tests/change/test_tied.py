"""Change between epochs that points in common tie: without registration, by the σ of their difference."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.affinity

from pipelines.change.datum import load_epoch
from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run
from pipelines.change.tied import Contradicted, Surfaces, Tied, contradicted, tied_by
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import COMMON_POINTS, MODEL, SURVEY
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.formats.geotiff import read_cells
from pipelines.geodesy.crs import parse_crs
from pipelines.survey.change_report import Change, ChangedRegion
from pipelines.survey.common_points import CommonPoints
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import TrainedModel, read_sfm, read_solution
from pipelines.survey.survey import Survey
from pipelines.view.page_scene import changed_regions
from pipelines.view.pictures import frame_of
from tests.change_pairs import TownPair, nudge_first_camera, tie, town_pair
from tests.refusals import refused
from tests.trained_workspaces import trained_workspace

pytestmark = pytest.mark.usefixtures("one_thread")


def test_steps_add_up(tmp_path: Path) -> None:
    spring, summer, autumn, winter = (trained_workspace(tmp_path / name)[1] for name in ("a", "b", "c", "d"))
    tie(summer, spring)
    tie(autumn, summer)
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


def test_two_flights_of_one_day_show_no_change(tmp_path: Path) -> None:
    made = town_pair(tmp_path, changed=False)
    tie(made.workspaces[1], made.workspaces[0])
    change, summary = compared(*made.workspaces, tmp_path / "out")
    assert change.common is not None
    assert change.regions == ()
    assert not summary.warnings
    assert change.significant_share <= 0.01


@pytest.mark.parametrize(("twice", "code"), [(2, "photographs-in-both"), (None, "same-photographs")])
def test_one_flight_trained_twice_is_no_second_date(tmp_path: Path, twice: int | None, code: str) -> None:
    """The surfaces differ by noise, as those of two trainings do; the photographs are the same, all or two."""
    made = town_pair(tmp_path, changed=False)
    for workspace, of in zip(made.workspaces, "ab", strict=True):
        survey = load_json(Survey, workspace.path(SURVEY))
        images = [
            image.model_copy(update={"sha256": f"{index}" if twice is None or index < twice else f"{of}{index}"})
            for index, image in enumerate(survey.images)
        ]
        save_json(survey.model_copy(update={"images": tuple(images)}), workspace.root / SURVEY)
    if twice is None:
        with refused(code):
            compared(*made.workspaces, tmp_path / "out")
        return
    (told,) = [one for one in compared(*made.workspaces, tmp_path / "out")[1].warnings if one.code == code]
    assert told.sentence.startswith("2 photographs")


def region_of(name: str, net_m3: float, area_m2: float = 100.0) -> ChangedRegion:
    return ChangedRegion(
        name=name,
        area_m2=area_m2,
        cut_m3=max(-net_m3, 0.0),
        fill_m3=max(net_m3, 0.0),
        net_m3=net_m3,
        sigma_m3=1.0,
        lowest_m=0.0,
        highest_m=0.5,
    )


def test_points_that_stand_still_contradict_a_region(tmp_path: Path) -> None:
    """Surfaces that differ by 0.4 m, around points that lie where they lay, to millimetres."""
    spring, autumn = (trained_workspace(tmp_path / name)[1] for name in ("spring", "autumn"))
    tie(autumn, spring)
    tied, _ = tied_by((load_epoch(spring), load_epoch(autumn)), (spring, autumn))
    assert tied is not None
    crs = parse_crs("EPSG:32632")
    plan = crs.xyz_from_lla(tied.lla())[:, :2]
    around = shapely.MultiPoint(plan).convex_hull.buffer(1.0)
    aside = shapely.affinity.translate(around, xoff=1000.0)

    def judged(
        net_m3: float, polygon: object = around, *, risen_m: float = 0.4, length_m: float = 20.0, of: object = tied
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        surfaces = Surfaces(crs, lambda places: np.full(len(places), risen_m), length_m)
        found = contradicted(of, (region_of("R1", net_m3),), (polygon,), surfaces)  # type: ignore[arg-type]
        return found.whole, found.part

    assert judged(40.0) == ((0,), ())
    assert judged(-40.0, risen_m=-0.4) == ((0,), ())
    assert judged(40.0, aside) == ((), ())
    # Points at the faint rim of a change of 0.4 m say nothing of it.
    assert judged(40.0, risen_m=0.1) == ((), ())
    assert judged(40.0, risen_m=np.nan) == ((), ())
    # Errors over a tenth of a metre: each point speaks for itself alone.
    assert judged(40.0, length_m=0.1) == ((), (0,))
    assert (
        contradicted(
            tied, (region_of("P1", 40.0),), (around,), Surfaces(crs, lambda at: np.full(len(at), 0.4), 20.0)
        )
        == Contradicted()
    )
    # Most points have moved with the surface, whether they tie the dates or not.
    (step,) = tied.steps
    missed = step.relative.missed_m.copy()
    missed[: 2 * len(missed) // 3, 2] = 0.4
    moved = replace(step, relative=replace(step.relative, missed_m=missed, used=missed[:, 2] < 0.2))
    assert judged(40.0, of=Tied((moved,))) == ((), ())
    # The change may have happened in the step in which they moved.
    assert judged(40.0, of=Tied((step, moved))) == ((), ())
    assert judged(40.0, of=Tied((step, step))) == ((0,), ())


@pytest.mark.slow
def test_a_doubtful_region_is_no_change(pair: TownPair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The largest of four regions is contradicted, the next in a part: names, sums, classes and files follow."""
    before, after = pair.workspaces
    monkeypatch.setattr("pipelines.change.stage.contradicted", lambda *_: Contradicted())
    every, _ = compared(before, after, tmp_path / "every")
    monkeypatch.setattr("pipelines.change.stage.contradicted", lambda *_: Contradicted((0,), (1,)))
    change, summary = compared(before, after, tmp_path / "out")
    assert [region.name for region in change.regions] == ["R1", "R2", "R3"]
    assert [(region.name, region.reason) for region in change.doubtful] == [("D1", "region-contradicted")]
    assert [region.net_m3 for region in (*change.doubtful, *change.regions)] == [
        region.net_m3 for region in every.regions
    ]
    assert change.found.net_m3 == pytest.approx(sum(region.net_m3 for region in change.regions))
    classes = [read_cells(tmp_path / name / "significant.tif")[0] for name in ("every", "out")]
    moved = classes[1] == 4
    assert moved.any()
    assert np.isin(classes[0][moved], (2, 3)).all()
    np.testing.assert_array_equal(classes[0][~moved], classes[1][~moved])
    assert 0 < change.doubtful_share < 1
    assert change.significant_share == pytest.approx((1 - change.doubtful_share) * every.significant_share)
    told = {remark.code: remark.sentence for remark in summary.warnings}
    assert "D1" in told["region-contradicted"]
    assert "R1" in told["region-partly-contradicted"]
    assert summary.values["doubtful_regions"] == 1
    for name, names in (("doubtful", ["D1"]), ("regions", ["R1", "R2", "R3"])):
        features = json.loads((tmp_path / f"out/{name}.geojson").read_text("utf-8"))["features"]
        assert [one["properties"]["name"] for one in features] == names
    (tmp_path / "out").rename(after.root / "change")
    frame = frame_of(solution := read_solution(after), read_sfm(after, solution))
    drawn = {
        one["text"].partition(":")[0]: one["doubtful"] for one in changed_regions(after, load_survey(after), frame)
    }
    assert drawn == {"R1": False, "R2": False, "R3": False, "D1": True}
    out = after.root / "change"
    assert 'id="region-D1"' in (out / "change.html").read_text("utf-8")


def test_points_of_another_sfm_are_stale(pair: TownPair, tmp_path: Path) -> None:
    before, after = pair.workspaces
    common = CommonPoints.load(after.path(COMMON_POINTS))
    for name in ("point_id", "earlier_point_id"):
        replace(common, **{name: getattr(common, name) + 1000}).save(after.root / COMMON_POINTS)
        with refused("common-points-stale"):
            compared(before, after, tmp_path / name)


@pytest.mark.slow
def test_either_order_is_recognised_and_another_solution_is_not(pair: TownPair, tmp_path: Path) -> None:
    before, after = pair.workspaces
    forwards = load_epoch(after).posterior.solution.earlier
    assert forwards is not None
    assert forwards.workspace == str(before.root)
    backwards, _ = compared(after, before, tmp_path / "backwards")
    assert backwards.common is not None
    model = load_json(TrainedModel, before.path(MODEL))  # trained again, with the cameras as they were
    save_json(model.model_copy(update={"iterations": model.iterations + 1}), before.root / MODEL)
    assert compared(before, after, tmp_path / "trained")[0].common is not None
    nudge_first_camera(before, 1)
    change, summary = compared(before, after, tmp_path / "again")
    assert change.common is None
    assert "earlier-solved-again" in {remark.code for remark in summary.warnings}
