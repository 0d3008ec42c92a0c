"""Section of the change: figures of a comparison that is current, and a word on one that is not."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import CHANGE_FIGURES
from pipelines.core.workspace import StageRun, Workspace
from pipelines.report.page import Page, Section, render_page, signed_volume, volume
from pipelines.report.record import RecordFacts, change_facts, record_facts
from pipelines.survey.change_report import Change, DateOfChange, DoubtfulRegion, RegionAtDate
from pipelines.survey.navigation import load_survey
from tests.change_pairs import town_pair


def section(workspace: Workspace, record: RecordFacts) -> str:
    facts = change_facts(workspace, record)
    assert facts is not None
    html = render_page(
        Page("", "", {}, (Section("change", "Change", "change.html", facts),), {}), "pipelines.report"
    )
    assert (facts.change is None) != ('href="../change/change.html"' in html)
    return re.sub(r"[ \n]+", " ", re.sub(r"<[^>]+>", " ", html))


@pytest.mark.slow
def test_the_report_has_the_volumes_of_a_change_that_is_current(tmp_path: Path) -> None:
    before, after = town_pair(tmp_path, changed=True).workspaces
    survey = load_survey(after)
    assert change_facts(after, record_facts(after, survey)) is None
    (out := after.root / "change").mkdir()
    run(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=True))
    record = record_facts(after, survey)
    text, change = section(after, record), load_json(Change, after.root / CHANGE_FIGURES)
    assert len(change.regions) == 4
    for region in change.regions:
        assert f"{region.name} {signed_volume(region.net_m3)} ± {volume(region.sigma_m3)} " in text
    assert "taken out. Maps and profiles" in text and "not taken out" not in text
    doubtful = DoubtfulRegion(**change.regions[0].model_dump() | {"name": "D1"}, reason="region-contradicted")
    volume_then = RegionAtDate(
        name="all", net_m3=12.3, sigma_m3=0.4, since_previous_m3=-4.5, sigma_since_previous_m3=0.6
    )
    date = DateOfChange(name="summer", taken_on="2026-07-01", sigma_v_m=0.004, regions=(volume_then,))
    of_chain = change.model_copy(update={"doubtful": (doubtful,), "by_date": (date,)})
    save_json(of_chain, after.root / CHANGE_FIGURES)
    text = section(after, record)
    assert "1 more region is doubtful" in text
    assert f"summer 2026-07-01 all {signed_volume(12.3)} ± {volume(0.4)} {signed_volume(-4.5)} ±" in text
    stale = tuple(replace(one, state="stale") if one.name == "change" else one for one in record.stages)
    text = section(after, replace(record, stages=stale))
    assert "out of date" in text and "R1" not in text
